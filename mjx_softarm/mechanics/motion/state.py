"""State and observables of an arm in motion, shared by the engines that move it."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_softarm import control, pneumatics
from mjx_softarm._support.errors import Result
from mjx_softarm._support.mjx import mjx
from mjx_softarm.mechanics.kinematics import Frames
from mjx_softarm.mechanics.params import ArmParams

CREEP_M_PER_S = 0.005  # rate of a chamber's length below which its dry friction fades
LONGEST_M = 1.0  # spring length that only a diverging simulation reaches


class MotionResult(Result):
    """Results of a motion."""

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
    tip_position_m: Array  # (t, 3)
    tip_rotation: Array  # (t, 3, 3)

    @classmethod
    def at(cls, frames: Frames, spring_m: Array) -> Path:
        """Return the observables of one instant, without the axis of time."""
        plates = frames.plate_position, frames.plate_rotation
        return cls(spring_m, *plates, frames.tip_position, frames.tip_rotation)


class MotionEnd(NamedTuple):
    """Observables of an arm at the end of a motion, and its path there."""

    pressure_kpa: Array  # (n_chambers,) in the chambers
    spring_m: Array  # (n_chambers,) spring lengths
    tip_position_m: Array  # (3,)
    tip_rotation: Array  # (3, 3)
    path: Path
    result: Array  # () int32, a `MotionResult`

    @classmethod
    def of(cls, motion: Motion, seen: Path, path: Path) -> MotionEnd:
        """Return the end of a path with state `motion`, observed as `seen`, and its result."""
        finite = jnp.all(jnp.isfinite(motion.q)) & jnp.all(jnp.isfinite(motion.velocity))
        finite &= jnp.all(jnp.isfinite(motion.pressure_kpa))
        short = jnp.all(seen.spring_m < LONGEST_M)
        result = jnp.where(short, MotionResult.FINITE.value, MotionResult.DIVERGED.value)
        result = jnp.where(finite, result, MotionResult.NOT_FINITE.value).astype(jnp.int32)
        tip = seen.tip_position_m, seen.tip_rotation
        return cls(motion.pressure_kpa, seen.spring_m, *tip, path, result)


class MotionParams(NamedTuple):
    """Parameters of an arm that only affect motion."""

    damping: Array | float = 1.0  # () factor of all dampers
    delay_s: Array | float = pneumatics.VALVE_S  # () dead time of the valves, at most a control period
    friction_n: Array | float = 0.0  # () dry friction of each chamber


class MovingArm(NamedTuple):
    """Model and parameters of an arm in motion."""

    model: mjx.Model  # from `mjx_softarm.mechanics.mjcf`
    data: mjx.Data  # of the model, at its reference pose
    params: ArmParams
    own: MotionParams

    def loaded_model(self) -> mjx.Model:
        """Return the model with the masses of `params`."""
        mass = jnp.concatenate([jnp.zeros(1), self.params.link_mass_kg, self.params.tool_mass_kg])
        scale = jnp.where(self.model.body_mass > 0, mass / jnp.maximum(self.model.body_mass, 1e-9), 0.0)
        return self.model.replace(body_mass=mass, body_inertia=self.model.body_inertia * scale[:, None])


def friction_damping(friction_n: Array | float, rate: Array) -> Array:
    """Return dampers (...) [N s/m] of chambers whose lengths change at a rate (...) [m/s].

    Dry friction F at a rate l' is a damper F / sqrt(l'^2 + w^2) with a small w: a force F where the arm
    moves, which does not hold an arm at rest.
    """
    return friction_n / jnp.sqrt(rate**2 + CREEP_M_PER_S**2)
