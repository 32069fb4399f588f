"""State and observables of an arm in motion, shared by the engines that move it."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm import control
from mjx_softarm._support.errors import Result
from mjx_softarm._support.lazy import mjx
from mjx_softarm.mechanics.kinematics import Frames
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.pneumatics import PAPER_PUMP, Actuators, Pump, Regulator

CREEP_M_PER_S = 0.005  # rate of a chamber's length below which its dry friction fades
LONGEST_M = 1.0  # spring length that only a diverging simulation reaches

# A pump's numbers are static: XLA folds them. A regulator's are traced: they differ between episodes.
jax.tree_util.register_dataclass(Pump, [], [item.name for item in dataclasses.fields(Pump)])
jax.tree_util.register_dataclass(Regulator)


class MotionResult(Result):
    """Results of a motion."""

    FINITE = 0, "every joint coordinate and velocity is finite"
    NOT_FINITE = 1, "a joint coordinate or velocity is not a finite number"
    DIVERGED = 2, f"a spring is longer than {LONGEST_M:g} m: the time step is too long for this arm"


class Motion(NamedTuple):
    """State of a moving arm between two instants."""

    q: Array  # (nv,) [m, rad, rad]
    velocity: Array  # (nv,) [m/s, rad/s, rad/s]
    law: control.LawState
    pressure_kpa: Array  # (n_chambers,) in the chambers
    command_kpa: Array  # (n_chambers,) command of the last control period
    earlier_kpa: Array | None = None  # (k, n_chambers) commands before it, newest first; see `n_earlier`

    @classmethod
    def at_rest(
        cls,
        q: Array,
        pressure_kpa: Array,
        spring_m: Array,
        n_earlier: int = 0,
        offset_kpa: Array | float = 0.0,
    ) -> Motion:
        """Return the state of an arm at rest at q (nv,), pressures (n_chambers,) and lengths (n_springs,).

        The offset, () or (n_chambers,), is that of pressures at rest from their commands.
        """
        command = pressure_kpa - offset_kpa
        earlier = jnp.tile(command, (n_earlier, 1)) if n_earlier else None
        law = control.LawState.at_rest(command, spring_m)
        return cls(q, jnp.zeros_like(q), law, pressure_kpa, command, earlier)

    def commanded(self, command_kpa: Array) -> Motion:
        """Return the state with a newer command (n_chambers,)."""
        earlier = self.earlier_kpa
        if earlier is not None:
            earlier = jnp.concatenate([self.command_kpa[None], earlier[:-1]])
        return self._replace(command_kpa=command_kpa, earlier_kpa=earlier)

    def in_force(
        self, command_kpa: Array, k: Array | int, h: float, delay_s: Array | float, period_s: float
    ) -> Array:
        """Return the mean command (n_chambers,) that actuators act on in an interval of a control period.

        Args:
            command_kpa (n_chambers,): command of this control period; the state has those before.
            k: index of the interval.
            h: length of the interval, no longer than a control period.
            delay_s () or (n_chambers,): dead time.
            period_s: control period.
        """
        # Share of the interval after the dead time, in which the new command is in force
        new = jnp.clip(k + 1.0 - delay_s / h, 0.0, 1.0)
        if self.earlier_kpa is None:
            return self.command_kpa + new * (command_kpa - self.command_kpa)

        # Each command is in force from its dead time on; the oldest one was before all others
        line = jnp.concatenate([command_kpa[None], self.command_kpa[None], self.earlier_kpa])
        age_s = period_s * jnp.arange(len(line) - 1, dtype=float).reshape(-1, *[1] * command_kpa.ndim)
        left_s = jnp.broadcast_to(delay_s, command_kpa.shape)[None] - age_s
        share = jnp.clip(k + 1.0 - left_s / h, 0.0, 1.0)  # (n commands, n_chambers)
        return line[-1] + jnp.sum(share * (line[:-1] - line[1:]), axis=0)


class Path(NamedTuple):
    """Observables of an arm at the start of each of t control periods."""

    spring_m: Array  # (t, n_springs) spring lengths
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
    spring_m: Array  # (n_springs,) spring lengths
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
    delay_s: Array | float = PAPER_PUMP.delay_s  # () or (n_chambers,) dead time of the actuators
    friction_n: Array | float = 0.0  # () dry friction of each chamber
    actuators: Actuators = PAPER_PUMP


class MovingArm(NamedTuple):
    """Model and parameters of an arm in motion."""

    model: mjx.Model  # from `mjx_softarm.mechanics.mjcf`
    data: mjx.Data  # of the model, at its reference pose
    params: ArmParams
    own: MotionParams


def n_earlier(delay_s: float, period_s: float) -> int:
    """Return the number of commands before the last one that a dead time of up to delay_s keeps waiting."""
    return max(math.ceil(delay_s / period_s - 1e-6) - 1, 0)


def friction_damping(friction_n: Array | float, rate: Array) -> Array:
    """Return dampers (...) [N s/m] of chambers whose lengths change at a rate (...) [m/s].

    Dry friction F at a rate l' is a damper F / sqrt(l'^2 + w^2) with a small w: a force F where the arm
    moves, which does not hold an arm at rest.
    """
    return friction_n / jnp.sqrt(rate**2 + CREEP_M_PER_S**2)
