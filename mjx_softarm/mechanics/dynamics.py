"""Transients: MJX stepped in time under the sensor-space law at the control rate."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm import control
from mjx_softarm._support.mjx import mjx
from mjx_softarm.mechanics.mjcf import spring_lengths, steps_per_period
from mjx_softarm.mechanics.settle import Result
from mjx_softarm.mechanics.statics import ArmParams


class MotionResult(Result):
    """Results of `advance`."""

    FINITE = 0, "every joint coordinate and velocity is finite"
    NOT_FINITE = 1, "a joint coordinate or velocity is not a finite number"


class Motion(NamedTuple):
    """State of a moving arm between two instants."""

    q: Array  # (nv,) [m, rad, rad]
    velocity: Array  # (nv,) [m/s, rad/s, rad/s]
    integral_kpa: Array  # (n_chambers,) integral part of the sensor-space law


class Moved(NamedTuple):
    """Observables of an arm at the end of a motion."""

    pressure_kpa: Array  # (n_chambers,) at the end
    spring_m: Array  # (n_chambers,) spring lengths
    tip_position_m: Array  # (3,)
    tip_rotation: Array  # (3, 3)
    result: Array  # () int32, a `MotionResult`


def with_params(model: mjx.Model, params: ArmParams) -> mjx.Model:
    """Return the model with the masses and stiffnesses of `params`; damping and geometry stay the model's."""
    stiffness = jnp.stack([params.chamber_stiffness, params.spring_stiffness], axis=1).reshape(-1)
    mass = jnp.concatenate([jnp.zeros(1), params.link_mass_kg, params.tool_mass_kg])
    scale = jnp.where(model.body_mass > 0, mass / jnp.maximum(model.body_mass, 1e-9), 0.0)
    return model.replace(
        body_mass=mass,
        body_inertia=model.body_inertia * scale[:, None],
        jnt_stiffness=params.joint_stiffness,
        tendon_stiffness=stiffness,
    )


def advance(
    model: mjx.Model,
    motion: Motion,
    reference_m: Array,
    gains: control.Gains,
    duration_s: float,
    period_s: float,
) -> tuple[Motion, Moved]:
    """Run the arm for a while under the law.

    Args:
        model: the arm, from `mjx_softarm.mechanics.mjcf`.
        motion: state at the start.
        reference_m (n_chambers,): spring lengths that the law tracks.
        gains: of the law.
        duration_s: a whole number of control periods.
        period_s: control period of the model's specification.

    Returns:
        State and observables at the end.
    """
    data = mjx.make_data(model).replace(qpos=motion.q, qvel=motion.velocity)
    data = mjx.tendon(model, mjx.com_pos(model, mjx.kinematics(model, data)))

    def tick(carry, _):
        data, integral = carry
        pressure, integral = control.pressures(reference_m, spring_lengths(data), integral, gains, period_s)
        data = data.replace(ctrl=pressure)
        data = jax.lax.fori_loop(0, steps_per_period(period_s), lambda _, d: mjx.step(model, d), data)
        data = mjx.tendon(model, mjx.com_pos(model, mjx.kinematics(model, data)))
        return (data, integral), None

    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        (data, integral), _ = jax.lax.scan(
            tick, (data, motion.integral_kpa), None, length=round(duration_s / period_s)
        )
    end = Motion(data.qpos, data.qvel, integral)
    finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
    result = jnp.where(finite, MotionResult.FINITE.value, MotionResult.NOT_FINITE.value)
    return end, Moved(
        pressure_kpa=data.ctrl,
        spring_m=spring_lengths(data),
        tip_position_m=data.site_xpos[-1],
        tip_rotation=data.site_xmat[-1],
        result=result.astype(jnp.int32),
    )
