"""The engine "mjx" in motion: MJX's equation of motion, stepped at the control rate.

    M(q) dv/dt + c(q, v) + D v + dV/dq = 0,    dq/dt = v

The mass matrix M and the bias c of the velocities are MJX's (`mjx.crb`, `mjx.rne`), at the chain's frames.
The potential V at the chambers' pressures, its Hessian K, and the dampers D have the closed form of
`mjx_softarm.mechanics.statics`.

A step of length h takes the implicit midpoint rule, linearised about the predicted middle q + h/2 v. The rule
is of second order, and stable however stiff a link is. With all functions of q at the middle,

    (M + h/2 D + h^2/4 K) dv = -h (dV/dq + D v + c),    q' = q + h (v + dv / 2)

Chambers fill as in `mjx_softarm.pneumatics`, in half steps. A step takes the pressures in its middle, and its
K includes the stiffness of the gas. The gradient is approximate: it takes the matrix of a step and c as
constants (see `advance`).

Source: Hairer, Wanner, "Solving Ordinary Differential Equations II", 1996, IV.7 (linearly implicit methods).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm import control, pneumatics
from mjx_softarm._support import xla
from mjx_softarm._support.lazy import mjx
from mjx_softarm._support.small_matrices import products
from mjx_softarm.mechanics.chain_hessian import ChainHessian, solve_approximate_gradient
from mjx_softarm.mechanics.kinematics import Frames, chain_kinematics
from mjx_softarm.mechanics.mjcf import loaded
from mjx_softarm.mechanics.motion.state import (
    Motion,
    MotionEnd,
    MotionParams,
    MovingArm,
    Path,
    friction_damping,
)
from mjx_softarm.mechanics.params import N_PER_KPA_M2, ArmParams
from mjx_softarm.mechanics.statics import (
    Statics,
    Tendons,
    all_tendons,
    chambers_and_springs,
    joined,
    statics_of,
    stretching,
)


def advance(
    arm: MovingArm,
    motion: Motion,
    reference_m: Array,
    gains: control.Gains,
    duration_s: float,
    period_s: float,
    step_s: float,
    n_at_once: int | None = None,
) -> tuple[Motion, MotionEnd]:
    """Run the arm for a while under the law; return state and observables at the end.

    The gradient is by `motion` and `reference_m`; numbers of the arm count as constants. It ignores the
    derivatives of each step's matrix and of c. It then takes half the time, and its direction is within 5
    degrees of the exact one, 1.5 degrees in the median (64 arms, two actions of half a second).

    Args:
        arm: numbers of the arm.
        motion: state at the start.
        reference_m (n_springs,): spring lengths that the law tracks.
        gains: numbers of the law.
        duration_s: a whole number of control periods.
        period_s: control period of the model's specification.
        step_s: time step at most; a control period has a whole number of them.
        n_at_once: arms of a `jax.vmap` that move at once, from `settle.arms_at_once`; None is all of them.
    """
    n_ticks, n_steps = round(duration_s / period_s), math.ceil(period_s / step_s - 1e-9)
    tick = functools.partial(_tick, arm, n_steps, period_s)
    forward, back = (
        xla.rows_last(function, n_at_once)
        for function in (functools.partial(_run, tick, n_ticks), functools.partial(_run_back, tick))
    )
    run = jax.custom_vjp(lambda start, constants: forward(start, constants)[0])

    def forward_keeping(start: tuple[Motion, Array], constants: _Constants) -> tuple[Any, Any]:
        results, kept = forward(start, constants)
        return results, (kept, constants)

    run.defvjp(forward_keeping, lambda given, change: (back(change, *given), None))
    end, last, path = run((motion, reference_m), _Constants(gains, arm.params, arm.own))
    return end, MotionEnd.of(end, last, path)


class _Constants(NamedTuple):
    """Numbers without a gradient."""

    gains: control.Gains
    params: ArmParams
    own: MotionParams


_Kept = tuple[Motion, Array, Array]  # state before each control period, last joint coordinates, reference


def _run(
    tick: Callable, n_ticks: int, start: tuple[Motion, Array], constants: _Constants
) -> tuple[tuple[Motion, Path, Path], _Kept]:
    """Return state and observables at the end, the path there, and what the gradient needs; arms are last."""
    motion, reference_m = start

    def go_on(motion: Motion, _: None) -> tuple[Motion, tuple[Path, Motion]]:
        after, seen = tick(constants, motion, reference_m)
        return after, (seen, motion)

    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        end, (path, before) = jax.lax.scan(go_on, motion, None, length=n_ticks)
        return (end, _look(constants.params, end.q), path), (before, end.q, reference_m)


def _run_back(
    tick: Callable, change: tuple[Motion, Path, Path], kept: _Kept, constants: _Constants
) -> tuple[Motion, Array]:
    """Return the gradient by state and reference at the start, from that by the results of `_run`.

    Each control period is computed again, which takes less time than to store its numbers.
    """
    before, end_q, reference_m = kept
    d_end, d_last, d_path = jax.lax.optimization_barrier(change)  # XLA would fold zeros, for seconds

    def go_back(d_after: tuple[Motion, Array], at: tuple[Motion, Path]) -> tuple[tuple[Motion, Array], None]:
        motion, d_seen = at
        _, pull_back = jax.vjp(functools.partial(tick, constants), motion, reference_m)
        d_motion, d_reference = pull_back((d_after[0], d_seen))
        return (d_motion, d_after[1] + d_reference), None

    with jax.default_matmul_precision("highest"):
        (d_q,) = jax.vjp(functools.partial(_look, constants.params), end_q)[1](d_last)
        d_end = d_end._replace(q=d_end.q + d_q), jnp.zeros_like(reference_m)
        return jax.lax.scan(go_back, d_end, (before, d_path), reverse=True)[0]


def _tick(
    arm: MovingArm, n_steps: int, period_s: float, constants: _Constants, motion: Motion, reference_m: Array
) -> tuple[Motion, Path]:
    """Run one control period: observe, let the law command pressures, take the time steps."""
    gains, params, own = constants
    seen, arms = _look(params, motion.q), reference_m.ndim - 1

    # The law takes arms first
    law_inputs: Any = reference_m, seen.spring_m, motion.law, gains
    law_inputs = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), law_inputs) if arms else law_inputs
    command, law = control.pressures(*law_inputs, dt_s=period_s)
    command, law = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), (command, law)) if arms else (command, law)

    motion, arm = motion._replace(law=law), arm._replace(params=params, own=own)
    for k in range(n_steps):
        motion = _step(arm, motion, command, k, period_s / n_steps, period_s)
    return motion.commanded(command), seen


def _look(params: ArmParams, q: Array) -> Path:
    """Return the observables at joint coordinates (nv, *arms)."""
    lines = _at(params, jax.lax.stop_gradient(q))[1]
    springs = chambers_and_springs(_sloped(Tendons.changed, lines, q, lines), params)[1]
    return Path.at(chain_kinematics(params)(q), springs.length)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _sloped(change: Callable, value: Any, x: Any, context: Any) -> Any:
    """Return a value whose derivative along dx is `change(context, dx)`, whatever it was computed from."""
    return value


_sloped.defjvp(lambda change, primals, tangents: (primals[0], change(primals[2], tangents[1])))


@jax.jit  # traced once for its three callers
def _at(params: ArmParams, q: Array) -> tuple[Frames, Tendons]:
    """Return the frames at joint coordinates (nv, *arms), and both kinds of tendons as `all_tendons` does."""
    frames = chain_kinematics(params)(q)
    return frames, all_tendons(frames, params)


@functools.partial(jax.jit, static_argnames=("k", "h", "period_s"))  # traced once for all of its callers
def _step(arm: MovingArm, motion: Motion, command_kpa: Array, k: int, h: float, period_s: float) -> Motion:
    """Take the k-th step, of length h [s], of a control period; it commands pressures (n_chambers, *arms)."""
    # Middle of the step, as the velocity at its start predicts it
    v, params = motion.velocity, arm.params
    half_way = 0.5 * h * v  # (nv, *arms)
    q = motion.q + half_way
    frames, tendons = _at(params, jax.lax.stop_gradient(q))
    lines = _sloped(Tendons.changed, tendons, q, tendons)
    chambers, _ = chambers_and_springs(lines, params)
    n_sections, arms = len(lines.length), v.shape[1:]

    def volume_m3(displacement: Array) -> Array:
        """Return the chambers' volumes (n_chambers, *arms) at displacements (nv, *arms) from the middle."""
        along = _rates(chambers.jacobian, displacement).reshape(chambers.length.shape)
        return params.volume_m3(chambers.length + along)

    def fill(gas_m3: Array, volume: Array, half: int) -> Array:
        """Return the gas (n_chambers, *arms) after a half step, counted from the start of the period."""
        command = motion.in_force(command_kpa, half, 0.5 * h, arm.own.delay_s, period_s)
        return actuators.fill(gas_m3, volume, command, 0.5 * h)

    # Pressures in the middle of the step
    actuators = arm.own.actuators
    gas_m3 = pneumatics.gas_at(motion.pressure_kpa, actuators.felt(volume_m3(-half_way)))
    middle_m3 = volume_m3(0.0 * v)
    felt_m3 = actuators.felt(middle_m3)
    gas_m3 = fill(gas_m3, felt_m3, 2 * k)
    pressure_kpa = pneumatics.pressure_of(gas_m3, felt_m3)

    # Forces in the middle: of the potential, of dampers and of inertia
    constant = jax.lax.stop_gradient((tendons, frames, q, pressure_kpa))
    potential, (mass, bias) = statics_of(*constant, params), inertia(arm, frames, jax.lax.stop_gradient(v))
    gradient = _sloped(Statics.changed, potential.gradient, (q, pressure_kpa), potential)
    rate = _rates(lines.jacobian, v)
    damping, of_joints = _dampers(arm, rate)
    pull = jnp.sum((damping * rate)[:, :, None] * lines.jacobian, axis=1)  # (n_sections, n, *arms)
    force = gradient + bias + pull.reshape(v.shape) + of_joints * v

    # The linearised midpoint rule; each closed chamber's gas has a stiffness [N/m], area^2 dp/dV
    gas = (
        pneumatics.ATMOSPHERE_KPA / N_PER_KPA_M2 * actuators.gas_stiffness(gas_m3, middle_m3, potential.area)
    )
    of_gas = gas.reshape(n_sections, -1, *arms)
    slope = (0.5 * h * damping).at[:, : of_gas.shape[1]].add(0.25 * h**2 * of_gas)
    matrix = mass.plus(potential.hessian, 0.25 * h**2).plus_diagonal(0.5 * h * of_joints)
    matrix = matrix._replace(own=matrix.own + stretching(slope, lines.jacobian))
    dv = solve_approximate_gradient(matrix, -h * force.reshape(n_sections, -1, 1, *arms)).reshape(v.shape)
    dq = h * (v + 0.5 * dv)

    # Pressures at the end of the step
    end_m3 = actuators.felt(volume_m3(dq - half_way))
    gas_m3 = fill(gas_m3, end_m3, 2 * k + 1)
    return motion._replace(
        q=motion.q + dq, velocity=v + dv, pressure_kpa=pneumatics.pressure_of(gas_m3, end_m3)
    )


def _rates(jacobian: Array, velocity: Array) -> Array:
    """Return the rates (n_sections, t, *arms) of tendons at velocities (nv, *arms)."""
    return products(jacobian, velocity.reshape(len(jacobian), -1, 1, *velocity.shape[1:]))[:, :, 0]


def _dampers(arm: MovingArm, rate: Array) -> tuple[Array, Array]:
    """Return dampers of tendons with these rates, both (n_sections, t, *arms), and of joints (nv, *arms)."""
    of_tendons, of_joints = (
        arm.own.damping * x.reshape(-1, *[1] * (rate.ndim - 2))
        for x in (arm.model.tendon_damping, arm.model.dof_damping)
    )
    n_sections, n_chambers = len(rate), len(arm.params.area)
    n_both = n_chambers + len(arm.params.spring_rest_m)
    damping = joined(of_tendons[:n_chambers], of_tendons[n_chambers:n_both], n_sections)
    damping = jnp.broadcast_to(damping, rate.shape)

    # Dry friction is the chambers' alone
    friction = friction_damping(arm.own.friction_n, rate[:, : n_chambers // n_sections])
    return damping.at[:, : friction.shape[1]].add(friction), of_joints


def inertia(arm: MovingArm, frames: Frames, v: Array) -> tuple[ChainHessian, Array]:
    """Return MJX's mass matrix, and its bias (nv, *arms) of velocities v (nv, *arms)."""
    params, arms, last = arm.params, v.shape[1:], frames.plate_rotation[-1]

    def of_one(link_kg: Array, tool_kg: Array, v: Array, poses: dict[str, Array]) -> tuple[Array, ...]:
        """Return the twist of each joint's unit velocity, the momentum that it gives, and the bias."""
        model = loaded(arm.model, link_kg, tool_kg)
        model = model.replace(opt=model.opt.replace(gravity=jnp.zeros(3)))  # the weights are in V
        data = arm.data.replace(qvel=v, xipos=poses["xpos"], ximat=poses["xmat"], **poses)
        data = mjx.crb(model, mjx.com_pos(model, data))
        momentum = jax.vmap(mjx._src.math.inert_mul)(data._impl.crb[model.dof_bodyid], data.cdof)
        return data.cdof, momentum, mjx.rne(model, mjx.com_vel(model, data)).qfrc_bias

    # MJX takes the frames of the chain, so it need not run its own kinematics. Bodies: world, links, tools
    tools = frames.plate_position[-1] - params.tool_offset_m[:, None] * last[:, 2]
    poses = {
        "xpos": jnp.concatenate([jnp.zeros((1, 3, *arms)), frames.anchor, tools]),
        "xmat": jnp.concatenate([frames.plate_rotation, last[None], last[None]]),
        "xaxis": frames.axis.reshape(-1, 3, *arms),
        "xanchor": jnp.repeat(frames.anchor, frames.axis.shape[1], axis=0),
    }
    masses = [jnp.broadcast_to(x, (len(x), *arms)) for x in (params.link_mass_kg, params.tool_mass_kg)]
    each: Any = jax.vmap(of_one, in_axes=-1, out_axes=-1) if arms else of_one
    *factors, bias = each(*masses, v, poses)
    twist, momentum = (x.reshape(params.n_sections, -1, 6, *arms) for x in factors)
    return ChainHessian.of_factors(twist, momentum), bias
