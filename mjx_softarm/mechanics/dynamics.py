"""Transients: MJX's equation of motion under the sensor-space law, stepped at the control rate.

    M(q) dv/dt + c(q, v) + D v + dV/dq = 0,    dq/dt = v

The mass matrix M and the bias c of the velocities are MJX's (`mjx.crb`, `mjx.rne`). The potential V at the
chambers' pressures, its Hessian K, and the dampers D have the closed form of `mjx_softarm.mechanics.statics`.

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
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm import control, pneumatics
from mjx_softarm._support.errors import Result
from mjx_softarm._support.mjx import mjx
from mjx_softarm._support.small_matrices import block_diagonal, products, solve_approximate_gradient
from mjx_softarm.mechanics.kinematics import Frames, Kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.statics import Tendons, all_tendons, statics_of

N_PER_KPA_M2 = 1e3
CREEP_M_PER_S = 0.005  # rate of a chamber's length below which its dry friction fades
LONGEST_M = 1.0  # spring length that only a diverging simulation reaches


class MotionResult(Result):
    """Results of `advance`."""

    FINITE = 0, "every joint coordinate and velocity is finite"
    NOT_FINITE = 1, "a joint coordinate or velocity is not a finite number"
    DIVERGED = 2, f"a spring is longer than {LONGEST_M:g} m: the time step is too long for this arm"


class Motion(NamedTuple):
    """State of a moving arm between two instants."""

    q: Array  # (nv,) [m, rad, rad]
    velocity: Array  # (nv,) [m/s, rad/s, rad/s]
    law: control.LawState  # (n_chambers,) each
    pressure_kpa: Array  # (n_chambers,) in the chambers
    command_kpa: Array  # (n_chambers,) that the valves act on

    @classmethod
    def at_rest(cls, q: Array, pressure_kpa: Array, spring_m: Array) -> Motion:
        """Return the state of an arm at rest at joint coordinates (nv,), with its pressures and springs."""
        law = control.LawState.at_rest(pressure_kpa, spring_m)
        return cls(q, jnp.zeros_like(q), law, pressure_kpa, pressure_kpa)


class Path(NamedTuple):
    """Observables of an arm at the start of each of t control periods."""

    spring_m: Array  # (t, n_chambers) spring lengths
    plate_position_m: Array  # (t, L + 1, 3), as in `kinematics.Frames`
    plate_rotation: Array  # (t, L + 1, 3, 3)
    tip_position_m: Array  # (t, 3) of the tip as mounted, which need not be the last plate's
    tip_rotation: Array  # (t, 3, 3)


class MotionEnd(NamedTuple):
    """Observables of an arm at the end of a motion, and its path there."""

    pressure_kpa: Array  # (n_chambers,) in the chambers
    spring_m: Array  # (n_chambers,) spring lengths
    tip_position_m: Array  # (3,)
    tip_rotation: Array  # (3, 3)
    path: Path
    result: Array  # () int32, a `MotionResult`


class MotionParams(NamedTuple):
    """Parameters of an arm that only affect motion."""

    damping: Array | float = 1.0  # () factor of all dampers
    delay_s: Array | float = pneumatics.VALVE_S  # () dead time of the valves, at most a control period
    friction_n: Array | float = 0.0  # () dry friction of each chamber


class MovingArm(NamedTuple):
    """Model, kinematics and parameters of an arm in motion."""

    model: mjx.Model  # from `mjx_softarm.mechanics.mjcf`
    kinematics: Kinematics  # of either engine
    params: ArmParams
    own: MotionParams

    @classmethod
    def of(cls, model: mjx.Model, kinematics: Kinematics, params: ArmParams, own: MotionParams) -> MovingArm:
        """Return an arm with the masses and stiffnesses of `params`, and the dampers of a `mjcf` model."""
        mass = jnp.concatenate([jnp.zeros(1), params.link_mass_kg, params.tool_mass_kg])
        scale = jnp.where(model.body_mass > 0, mass / jnp.maximum(model.body_mass, 1e-9), 0.0)
        model = model.replace(
            body_mass=mass,
            body_inertia=model.body_inertia * scale[:, None],
            opt=model.opt.replace(gravity=jnp.zeros(3)),  # the weights are in V
        )
        return cls(model, kinematics, params, own)


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
        reference_m (n_chambers,): spring lengths that the law tracks.
        gains: numbers of the law.
        duration_s: a whole number of control periods.
        period_s: control period of the model's specification.
        step_s: time step at most; a control period has a whole number of them.

    Returns:
        State and observables at the end.
    """
    n_steps = math.ceil(period_s / step_s - 1e-9)

    def tick(motion: Motion, _):
        """Run one control period: observe, let the law command pressures, take the time steps."""
        frames, lines = _at(arm, motion.q)
        spring_m = lines.length[1]
        plates, tip = (
            (frames.plate_position, frames.plate_rotation),
            (frames.tip_position, frames.tip_rotation),
        )
        seen = Path(spring_m, *plates, *tip)
        command, law = control.pressures(reference_m, spring_m, motion.law, gains, period_s)
        motion = motion._replace(law=law)
        for k in range(n_steps):
            motion = _step(arm, motion, command, k, period_s / n_steps)
        return motion._replace(command_kpa=command), seen

    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        tick = jax.checkpoint(tick, prevent_cse=False)  # a gradient recomputes each tick to save memory
        end, path = jax.lax.scan(tick, motion, None, length=round(duration_s / period_s))
        frames, lines = _at(arm, end.q)
        spring_m = lines.length[1]

    # Result: finite numbers, of an arm that has not diverged
    finite = jnp.all(jnp.isfinite(end.q)) & jnp.all(jnp.isfinite(end.velocity))
    finite &= jnp.all(jnp.isfinite(end.pressure_kpa))
    result = jnp.where(jnp.all(spring_m < LONGEST_M), MotionResult.FINITE.value, MotionResult.DIVERGED.value)
    result = jnp.where(finite, result, MotionResult.NOT_FINITE.value)
    return end, MotionEnd(
        pressure_kpa=end.pressure_kpa,
        spring_m=spring_m,
        tip_position_m=frames.tip_position,
        tip_rotation=frames.tip_rotation,
        path=path,
        result=result.astype(jnp.int32),
    )


def _at(arm: MovingArm, q: Array) -> tuple[Frames, Tendons]:
    """Return the frames at joint coordinates (nv,), and both kinds of tendons as `all_tendons` does."""
    frames = arm.kinematics(q)
    return frames, all_tendons(frames, arm.params)


def _step(arm: MovingArm, motion: Motion, command_kpa: Array, k: int, h: float) -> Motion:
    """Take the k-th step, of length h [s], of a control period with commanded pressures (n_chambers,)."""
    # Middle of the step, as the velocity at its start predicts it
    v, params = motion.velocity, arm.params
    half_way = 0.5 * h * v  # (nv,)
    middle = motion._replace(q=motion.q + half_way)
    frames, lines = _at(arm, middle.q)
    jacobian = lines.jacobian  # (2, n_sections, 3, n)

    def volume_m3(displacement: Array) -> Array:
        """Return the chambers' volumes (n_chambers,) at joint displacements (nv,) from the middle."""
        along = products(jacobian[0], displacement.reshape(params.n_sections, -1, 1)).reshape(-1)
        area = params.area / N_PER_KPA_M2, params.area_slope / N_PER_KPA_M2
        return pneumatics.volume_m3(lines.length[0] + along, *area, params.section_length_m)

    def fill(gas_m3: Array, volume: Array, half: int) -> Array:
        """Return the gas (n_chambers,) after a half step, counted from the start of the control period."""
        # Share of the half step after the valves' dead time, in which the new command is in force
        new = jnp.clip(half + 1.0 - arm.own.delay_s / (0.5 * h), 0.0, 1.0)
        command = motion.command_kpa + new * (command_kpa - motion.command_kpa)
        return pneumatics.regulated(gas_m3, volume, command, 0.5 * h)

    # Pressures in the middle of the step
    gas_m3 = pneumatics.gas_at(motion.pressure_kpa, volume_m3(-half_way))
    middle_m3 = volume_m3(0.0 * v)
    gas_m3 = fill(gas_m3, middle_m3, 2 * k)
    pressure_kpa = pneumatics.pressure_of(gas_m3, middle_m3)

    # Forces in the middle and their derivatives
    mass, bias = jax.lax.stop_gradient(_inertia(arm.model, frames, params, middle))
    potential = statics_of(lines, frames, middle.q, pressure_kpa, params)
    damping, stiffness = _dampers(arm, jacobian, v), potential.hessian.dense()
    # Stiffness of each closed chamber's gas (n_chambers,) [N/m], area^2 dp/dV
    gas = pneumatics.ATMOSPHERE_KPA / N_PER_KPA_M2 * gas_m3 * (potential.area / middle_m3) ** 2
    pushed = jacobian[0] * gas.reshape(params.n_sections, -1, 1)
    stiffness_of_gas = block_diagonal(products(jnp.swapaxes(jacobian[0], 1, 2), pushed))

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
    """Return the matrix (nv, nv) of all dampers and of dry friction, with Jacobians (2, n_sections, 3, n)."""
    # Dampers of chambers and springs
    tendon = arm.model.tendon_damping.reshape(jacobian.shape[1], -1, 2)  # (n_sections, 3, 2)
    rows = jnp.concatenate(list(jacobian), axis=1)  # (n_sections, 6, n)
    scaled = jnp.concatenate([tendon[..., :1] * jacobian[0], tendon[..., 1:] * jacobian[1]], axis=1)
    own = block_diagonal(products(jnp.swapaxes(rows, 1, 2), scaled))

    # Dry friction F at a chamber's rate l' is a damper F / sqrt(l'^2 + w^2) with a small w: a force F where
    # the arm moves, which does not hold an arm at rest
    rate = products(jacobian[0], v.reshape(len(tendon), -1, 1))  # (n_sections, 3, 1) [m/s]
    secant = arm.own.friction_n / jnp.sqrt(rate**2 + CREEP_M_PER_S**2)
    friction = block_diagonal(products(jnp.swapaxes(jacobian[0], 1, 2), secant * jacobian[0]))
    return arm.own.damping * (own + jnp.diag(arm.model.dof_damping)) + friction


def _inertia(model: mjx.Model, frames: Frames, params: ArmParams, motion: Motion) -> tuple[Array, Array]:
    """Return MJX's mass matrix (nv, nv), and its bias (nv,) of the velocities."""
    # MJX takes the frames of the engine, so it need not run its own kinematics
    last = frames.plate_rotation[-1]
    tools = frames.plate_position[-1] - params.tool_offset_m[:, None] * last[:, 2]
    position = jnp.concatenate([jnp.zeros((1, 3)), frames.anchor, tools])  # bodies: world, links, tools
    rotation = jnp.concatenate([frames.plate_rotation, last[None], last[None]])
    data = mjx.make_data(model).replace(
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
