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
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm import control, pneumatics
from mjx_softarm._support.lazy import mjx
from mjx_softarm.mechanics.kinematics import frames_of
from mjx_softarm.mechanics.mjcf import chamber_lengths, episode_model, spring_lengths
from mjx_softarm.mechanics.motion.state import (
    Motion,
    MotionEnd,
    MovingArm,
    Path,
    friction_damping,
    in_force,
    pushed,
)
from mjx_softarm.mechanics.params import N_PER_KPA_M2


class _Moving(NamedTuple):
    """State between two time steps."""

    q: Array  # (nv,)
    velocity: Array  # (nv,)
    gas_m3: Array  # (n_chambers,) in the chambers, at atmospheric pressure
    law: control.LawState
    before_kpa: Array  # (n_chambers,) command of the control period before
    command_kpa: Array  # (n_chambers,) command of this control period
    earlier_kpa: Array | None  # (k, n_chambers) commands before those, newest first


def advance(
    arm: MovingArm,
    motion: Motion,
    reference_m: Array,
    gains: control.Gains,
    duration_s: float,
    period_s: float,
    step_s: float,
) -> tuple[Motion, MotionEnd]:
    """Run the arm for a while under the law; arguments and results are those of `midpoint.advance`.

    The scan runs over time steps rather than control periods, so that `mjx.step` is compiled once.
    """
    n_steps = math.ceil(period_s / step_s - 1e-9)
    h = period_s / n_steps
    model = _episode_model(arm, h)

    def step(now: _Moving, k: Array) -> tuple[_Moving, Path]:
        """Take the k-th time step of a control period: observe, command, fill the chambers, step."""
        # Lengths at the start of the step; `mjx.step` computes them again, and it is not measured whether XLA
        # merges the two
        data, spring_m, volume = _at(arm, model, now.q, now.velocity)

        # The law commands pressures at the start of a control period
        command, law = control.pressures(reference_m, spring_m, now.law, gains, period_s)
        earlier = pushed(now.earlier_kpa, now.before_kpa)
        line = {"before_kpa": now.command_kpa, "command_kpa": command, "earlier_kpa": earlier}
        new = now._replace(law=law, **line)
        now = jax.tree.map(lambda x, y: jnp.where(k == 0, x, y), new, now)

        # The actuators act on the commands whose dead time is over
        told_kpa = in_force(now.command_kpa, now.before_kpa, now.earlier_kpa, k, h, arm.own.delay_s, period_s)
        gas_m3 = arm.own.actuators.fill(now.gas_m3, volume, told_kpa, h)

        # MJX's own step
        data = data.replace(ctrl=pneumatics.pressure_of(gas_m3, volume))
        data = mjx.step(_with_friction(arm, model, data), data)
        now = now._replace(q=data.qpos, velocity=data.qvel, gas_m3=gas_m3)
        return now, Path.at(frames_of(model, data), spring_m)  # the data's frames are those of the start

    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        _, _, volume = _at(arm, model, motion.q, motion.velocity)
        gas_m3 = pneumatics.gas_at(motion.pressure_kpa, volume)
        before, earlier = motion.command_kpa, motion.earlier_kpa
        if earlier is not None:  # the first control period shifts them by one
            before, earlier = earlier[0], jnp.concatenate([earlier[1:], earlier[-1:]])
        start = _Moving(*motion[:2], gas_m3, motion.law, before, motion.command_kpa, earlier)
        of_period = jnp.tile(jnp.arange(n_steps), round(duration_s / period_s))
        end, path = jax.lax.scan(step, start, of_period)
        data, spring_m, volume = _at(arm, model, end.q, end.velocity)
    pressure_kpa = pneumatics.pressure_of(end.gas_m3, volume)
    line = end.command_kpa, pushed(end.earlier_kpa, end.before_kpa)
    motion = Motion(end.q, end.velocity, end.law, pressure_kpa, *line)
    path = jax.tree.map(lambda x: x[::n_steps], path)
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
    data, params = mjx.tendon(model, data), arm.params
    area = params.area / N_PER_KPA_M2, params.area_slope / N_PER_KPA_M2
    volume = pneumatics.volume_m3(chamber_lengths(data, len(params.area)), *area, params.free_length_m)
    spring_m = spring_lengths(data, len(params.area), len(params.spring_rest_m))
    return data, spring_m, arm.own.actuators.felt(volume)


def _with_friction(arm: MovingArm, model: mjx.Model, data: mjx.Data) -> mjx.Model:
    """Return the model with the chambers' dry friction in the damping of their tendons."""
    n_chambers = len(arm.params.area)  # their tendons come first
    rate = data._impl.ten_J[:n_chambers] @ data.qvel  # (n_chambers,) [m/s]
    friction = friction_damping(arm.own.friction_n, rate)
    return model.replace(tendon_damping=model.tendon_damping.at[:n_chambers].add(friction))
