"""The engine "chain" in motion: MJX's equation of motion, stepped at the control rate.

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

import math

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm import control, pneumatics
from mjx_softarm._support.lazy import mjx
from mjx_softarm._support.small_matrices import block_diagonal, products, solve_approximate_gradient
from mjx_softarm.mechanics.kinematics import Frames, chain_kinematics
from mjx_softarm.mechanics.motion.state import (
    Motion,
    MotionEnd,
    MovingArm,
    Path,
    friction_damping,
    in_force,
    pushed,
)
from mjx_softarm.mechanics.params import N_PER_KPA_M2, ArmParams
from mjx_softarm.mechanics.statics import Tendons, all_tendons, chambers_and_springs, joined, statics_of


def advance(
    arm: MovingArm,
    motion: Motion,
    reference_m: Array,
    gains: control.Gains,
    duration_s: float,
    period_s: float,
    step_s: float,
) -> tuple[Motion, MotionEnd]:
    """Run the arm for a while under the law.

    The gradient ignores the derivatives of each step's matrix and of c. It then takes half the time, and its
    direction is within 5 degrees of the exact one, 1.5 degrees in the median (64 arms, two actions of half a
    second).

    Args:
        arm: numbers of the arm.
        motion: state at the start.
        reference_m (n_springs,): spring lengths that the law tracks.
        gains: numbers of the law.
        duration_s: a whole number of control periods.
        period_s: control period of the model's specification.
        step_s: time step at most; a control period has a whole number of them.

    Returns:
        State and observables at the end.
    """
    # The episode's arm
    n_steps = math.ceil(period_s / step_s - 1e-9)
    model = arm.loaded_model()
    weightless = model.opt.replace(gravity=jnp.zeros(3))  # the weights are in V
    arm = arm._replace(model=model.replace(opt=weightless))

    def tick(motion: Motion, _):
        """Run one control period: observe, let the law command pressures, take the time steps."""
        frames, lines = _at(arm.params, motion.q)
        _, springs = chambers_and_springs(lines, arm.params)
        spring_m = springs.length
        command, law = control.pressures(reference_m, spring_m, motion.law, gains, period_s)
        motion = motion._replace(law=law)
        for k in range(n_steps):
            motion = _step(arm, motion, command, k, period_s / n_steps, period_s)
        earlier = pushed(motion.earlier_kpa, motion.command_kpa)
        return motion._replace(command_kpa=command, earlier_kpa=earlier), Path.at(frames, spring_m)

    # All control periods, then a last look
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        tick = jax.checkpoint(tick, prevent_cse=False)  # a gradient recomputes each tick to save memory
        end, path = jax.lax.scan(tick, motion, None, length=round(duration_s / period_s))
        frames, lines = _at(arm.params, end.q)
        _, springs = chambers_and_springs(lines, arm.params)
    return end, MotionEnd.of(end, Path.at(frames, springs.length), path)


@jax.jit  # traced once for its three callers
def _at(params: ArmParams, q: Array) -> tuple[Frames, Tendons]:
    """Return the frames at joint coordinates (nv,), and both kinds of tendons as `all_tendons` does."""
    frames = chain_kinematics(params)(q)
    return frames, all_tendons(frames, params)


def _step(arm: MovingArm, motion: Motion, command_kpa: Array, k: int, h: float, period_s: float) -> Motion:
    """Take the k-th step, of length h [s], of a control period with commanded pressures (n_chambers,)."""
    # Middle of the step, as the velocity at its start predicts it
    v, params = motion.velocity, arm.params
    half_way = 0.5 * h * v  # (nv,)
    middle = motion._replace(q=motion.q + half_way)
    frames, lines = _at(params, middle.q)
    chambers, _ = chambers_and_springs(lines, params)

    def volume_m3(displacement: Array) -> Array:
        """Return the chambers' volumes (n_chambers,) at joint displacements (nv,) from the middle."""
        along = products(chambers.jacobian, displacement.reshape(params.n_sections, -1, 1)).reshape(-1)
        area = params.area / N_PER_KPA_M2, params.area_slope / N_PER_KPA_M2
        return pneumatics.volume_m3(chambers.length + along, *area, params.free_length_m)

    def fill(gas_m3: Array, volume: Array, half: int) -> Array:
        """Return the gas (n_chambers,) after a half step, counted from the start of the control period."""
        line = command_kpa, motion.command_kpa, motion.earlier_kpa
        command = in_force(*line, half, 0.5 * h, arm.own.delay_s, period_s)
        return arm.own.actuators.fill(gas_m3, volume, command, 0.5 * h)

    # Pressures in the middle of the step
    gas_m3 = pneumatics.gas_at(motion.pressure_kpa, volume_m3(-half_way))
    middle_m3 = volume_m3(0.0 * v)
    gas_m3 = fill(gas_m3, middle_m3, 2 * k)
    pressure_kpa = pneumatics.pressure_of(gas_m3, middle_m3)

    # Forces in the middle and their derivatives
    mass, bias = jax.lax.stop_gradient(_inertia(arm, frames, middle))
    potential = statics_of(lines, frames, middle.q, pressure_kpa, params)
    damping, stiffness = _dampers(arm, lines.jacobian, v), potential.hessian.dense()
    # Stiffness of each closed chamber's gas (n_chambers,) [N/m], area^2 dp/dV
    gas = pneumatics.ATMOSPHERE_KPA / N_PER_KPA_M2 * gas_m3 * (potential.area / middle_m3) ** 2
    pull = chambers.jacobian * gas.reshape(params.n_sections, -1, 1)
    stiffness_of_gas = block_diagonal(products(jnp.swapaxes(chambers.jacobian, 1, 2), pull))

    # The linearised midpoint rule
    force = potential.gradient + bias + damping @ v
    matrix = mass + 0.5 * h * damping + 0.25 * h**2 * (stiffness + stiffness_of_gas)
    dv = solve_approximate_gradient(matrix, -h * force[:, None])[:, 0]
    dq = h * (v + 0.5 * dv)

    # Pressures at the end of the step
    end_m3 = volume_m3(dq - half_way)
    gas_m3 = fill(gas_m3, end_m3, 2 * k + 1)
    return motion._replace(
        q=motion.q + dq, velocity=v + dv, pressure_kpa=pneumatics.pressure_of(gas_m3, end_m3)
    )


def _dampers(arm: MovingArm, jacobian: Array, v: Array) -> Array:
    """Return the matrix (nv, nv) of dampers and dry friction; the Jacobian is (n_sections, c + s, n)."""
    # Dampers of chambers and springs
    n_sections, n_chambers = len(jacobian), len(arm.params.area)
    of_chambers, of_springs = jnp.split(arm.model.tendon_damping, [n_chambers])
    damping = joined(of_chambers, of_springs, n_sections)[..., None]
    own = block_diagonal(products(jnp.swapaxes(jacobian, 1, 2), damping * jacobian))

    # Dry friction
    chambers = jacobian[:, : n_chambers // n_sections]
    rate = products(chambers, v.reshape(n_sections, -1, 1))  # (n_sections, c, 1) [m/s]
    secant = friction_damping(arm.own.friction_n, rate)
    friction = block_diagonal(products(jnp.swapaxes(chambers, 1, 2), secant * chambers))
    return arm.own.damping * (own + jnp.diag(arm.model.dof_damping)) + friction


def _inertia(arm: MovingArm, frames: Frames, motion: Motion) -> tuple[Array, Array]:
    """Return MJX's mass matrix (nv, nv), and its bias (nv,) of the velocities."""
    # MJX takes the frames of the chain, so it need not run its own kinematics
    model, params, last = arm.model, arm.params, frames.plate_rotation[-1]
    tools = frames.plate_position[-1] - params.tool_offset_m[:, None] * last[:, 2]
    position = jnp.concatenate([jnp.zeros((1, 3)), frames.anchor, tools])  # bodies: world, links, tools
    rotation = jnp.concatenate([frames.plate_rotation, last[None], last[None]])
    data = arm.data.replace(
        qpos=motion.q,
        qvel=motion.velocity,
        xpos=position,
        xmat=rotation,
        xipos=position,
        ximat=rotation,
        xaxis=frames.axis.reshape(-1, 3),
        xanchor=jnp.repeat(frames.anchor, frames.axis.shape[1], axis=0),
    )
    data = mjx.crb(model, mjx.com_pos(model, data))
    return mjx.full_m(model, data), mjx.rne(model, mjx.com_vel(model, data)).qfrc_bias
