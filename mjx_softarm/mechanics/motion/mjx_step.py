"""The engine "mjx-step": `mjx.step` of the compiled model, with nothing of ours in the arm.

Tendons, springs, dampers, actuators, masses and the integrator are those of `mjx_softarm.mechanics.mjcf`. An
episode's payload, stiffness and damping are fields of its model. The law stands outside the model, as for a
real arm. So does the air of the chambers (`mjx_softarm.pneumatics`), which sets the actuators' pressures at
the start of each time step.

Dry friction enters as damping of the chambers' tendons, set at each step from the rates of their lengths
(`friction_damping`). MuJoCo's own `frictionloss` would need the constraint solver. A force would need steps
of less than a millisecond; the integrator takes dampers implicitly.

MuJoCo's implicitfast integrator is of first order. The paper's arm with 2 or 4 links a section is stable at
steps of 20 ms. Against C MuJoCo at 0.25 ms, over 2 s of random references, its tip is then off by a median of
5.5 mm (95 %: 11 mm); at 10 ms 2.2 (4.8), at 5 ms 1.1 (2.3), at 2 ms 0.4 (0.9). MuJoCo's Euler integrator is
stable from 2.5 ms with 2 links, from 2 ms with 4.

Source: MuJoCo's documentation, "Computation", numerical integration.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm import control, pneumatics
from mjx_softarm._support.lazy import mjx
from mjx_softarm.mechanics.kinematics import frames_of
from mjx_softarm.mechanics.mjcf import chamber_lengths, episode_model, spring_lengths
from mjx_softarm.mechanics.motion.state import Motion, MotionEnd, MovingArm, Path, friction_damping


def advance(
    arm: MovingArm,
    motion: Motion,
    reference_m: Array,
    gains: control.Gains,
    duration_s: float,
    period_s: float,
    step_s: float,
) -> tuple[Motion, MotionEnd]:
    """Run the arm for a while under the law; arguments and results are those of `midpoint.advance`."""
    n_steps = math.ceil(period_s / step_s - 1e-9)
    h = period_s / n_steps
    model, own = _episode_model(arm, h), arm.own

    def run_period(state: tuple[Motion, Array], _: None) -> tuple[tuple[Motion, Array], Path]:
        """Run one control period: observe, let the law command pressures, take the time steps."""
        motion, gas_m3 = state
        data, spring_m, _volume = _at(arm, model, motion.q, motion.velocity)
        command, law = control.pressures(reference_m, spring_m, motion.law, gains, period_s)

        def step(moving: tuple[Array, Array, Array], k: Array) -> tuple[tuple[Array, Array, Array], None]:
            """Fill the chambers by the commands whose dead time is over, then take MJX's own step."""
            q, velocity, gas_m3 = moving
            # `mjx.step` computes the lengths again, and it is not measured whether XLA merges the two
            data, _, volume = _at(arm, model, q, velocity)
            in_force_kpa = motion.in_force(command, k, h, own.delay_s, period_s)
            gas_m3 = own.actuators.fill(gas_m3, volume, in_force_kpa, h)
            data = data.replace(ctrl=pneumatics.pressure_of(gas_m3, volume))
            data = mjx.step(_with_friction(arm, model, data), data)
            return (data.qpos, data.qvel, gas_m3), None

        moving = motion.q, motion.velocity, gas_m3
        (q, velocity, gas_m3), _ = jax.lax.scan(step, moving, jnp.arange(n_steps))
        end = motion._replace(q=q, velocity=velocity, law=law).commanded(command)
        return (end, gas_m3), Path.at(frames_of(model, data), spring_m)

    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        _, _, volume = _at(arm, model, motion.q, motion.velocity)
        start = motion, pneumatics.gas_at(motion.pressure_kpa, volume)
        n_periods = round(duration_s / period_s)
        (motion, gas_m3), path = jax.lax.scan(run_period, start, None, length=n_periods)
        data, spring_m, volume = _at(arm, model, motion.q, motion.velocity)
    motion = motion._replace(pressure_kpa=pneumatics.pressure_of(gas_m3, volume))
    return motion, MotionEnd.of(motion, Path.at(frames_of(model, data), spring_m), path)


def _episode_model(arm: MovingArm, h: float) -> mjx.Model:
    """Return the model with time step h [s] and the arm's own masses, stiffnesses and dampers."""
    model = episode_model(arm.model, arm.params)
    return model.replace(
        tendon_damping=arm.own.damping * model.tendon_damping,
        dof_damping=arm.own.damping * model.dof_damping,
        opt=model.opt.replace(timestep=jnp.float32(h)),
    )


def _at(arm: MovingArm, model: mjx.Model, q: Array, velocity: Array) -> tuple[mjx.Data, Array, Array]:
    """Return data at q and velocity (nv,), spring lengths (n_springs,) [m] and chamber volumes, as felt."""
    data = mjx.com_pos(model, mjx.kinematics(model, arm.data.replace(qpos=q, qvel=velocity)))
    data, n_chambers = mjx.tendon(model, data), len(arm.params.area)
    volume = arm.params.volume_m3(chamber_lengths(data, n_chambers))
    spring_m = spring_lengths(data, n_chambers, len(arm.params.spring_rest_m))
    return data, spring_m, arm.own.actuators.felt(volume)


def _with_friction(arm: MovingArm, model: mjx.Model, data: mjx.Data) -> mjx.Model:
    """Return the model with the chambers' dry friction in the damping of their tendons."""
    n_chambers = len(arm.params.area)  # their tendons come first
    rate = data._impl.ten_J[:n_chambers] @ data.qvel  # (n_chambers,) [m/s]
    friction = friction_damping(arm.own.friction_n, rate)
    return model.replace(tendon_damping=model.tendon_damping.at[:n_chambers].add(friction))
