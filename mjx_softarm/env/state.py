"""State of one arm of the environment, and the random numbers of its episode."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support.lazy import brax_envs
from mjx_softarm.env.config import EnvConfig
from mjx_softarm.mechanics.motion.state import Motion, MotionParams, n_earlier
from mjx_softarm.mechanics.workspace import Pool
from mjx_softarm.pneumatics import Regulator
from mjx_softarm.sensing.sensors import SENSORS
from mjx_softarm.spec import ArmSpec

for _sensor in SENSORS.values():
    jax.tree_util.register_dataclass(_sensor)  # its numbers are traced


PAYLOAD_SHARE = 2  # index in `EpisodeNoise.uniform`


class EpisodeNoise(NamedTuple):
    """Random numbers that fix one episode."""

    uniform: Array  # (3 + n_chambers,) from 0 to 1: start, goal, payload, stiffness of each chamber
    moving: Array | None  # (EpisodeMotion.n_draws,) from 0 to 1; None for arms at rest


class ArmState(NamedTuple):
    """State of one arm between two actions."""

    payload_kg: Array  # () payload of this episode
    chamber_stiffness: Array  # (n_chambers,) [N/m] stiffnesses of this episode
    moving: MotionParams  # parameters of motion in this episode
    motion: Motion  # joint coordinates, velocities, pressures
    pose: Array  # (6,) [mm, deg] observed pose: the real arm's if there is a sim-to-real network
    spring_m: Array  # (n_springs,) true lengths
    pressure_kpa: Array  # (n_chambers,)
    sensed: Array | None  # (k,) observations besides pose and goal; None if there are none
    goal: Array  # (6,) [mm, deg]
    n_steps: Array  # () actions taken in this episode


@flax.struct.dataclass
class State(brax_envs.State):
    """State of an environment: brax's, with an arm in the place of brax's pipeline state."""

    pipeline_state: ArmState
    obs: Array

    if TYPE_CHECKING:  # flax adds it, unknown to type checkers

        def replace(self, **fields: Any) -> State: ...


class EpisodeMotion:
    """Parameters and states at rest of the arms of a configuration, which may be in motion."""

    def __init__(self, spec: ArmSpec, config: EnvConfig):
        self._spread, actuators = config.randomisation, spec.actuators.per_chamber(spec.n_chambers)
        self._regulated = isinstance(actuators, Regulator)
        self._actuators: Any = jax.device_put(jax.tree.map(np.float32, actuators))
        self.n_draws = 6 if self._regulated else 3  # random numbers of an episode

        # Commands that wait at a time, and those of an arm at rest; an arm that is always at rest needs none
        spread = 1.0 + self._spread.regulator_spread * self._regulated
        longest_s = spread * float(np.max(actuators.delay_s)) + self._spread.delay_max_s
        self.n_earlier = n_earlier(longest_s, 1.0 / spec.control.rate_hz) if config.in_motion else 0
        self._offset_kpa = self._actuators.rest_offset_kpa if config.in_motion else 0.0

    def params(self, share: Array | None) -> MotionParams:
        """Return the parameters of an episode.

        Args:
            share (n_draws,): random numbers from 0 to 1: damping, delay and friction, then lag, dead time and
                rates of regulators. None gives the nominal parameters.
        """
        spread, actuators = self._spread, self._actuators
        damping, delay, friction = jnp.array([0.5, 0.0, 0.0]) if share is None else share[:3]
        delay_s = actuators.delay_s
        if self._regulated and share is not None:
            lag, dead_time, rate = 1.0 + spread.regulator_spread * (2.0 * share[3:] - 1.0)
            rates = {name: rate * getattr(actuators, name) for name in ("fill_kpa_per_s", "vent_kpa_per_s")}
            actuators = dataclasses.replace(actuators, lag_s=lag * actuators.lag_s, **rates)
            delay_s = dead_time * delay_s
        return MotionParams(
            damping=1.0 + spread.damping_spread * (2.0 * damping - 1.0),
            delay_s=delay_s + spread.delay_max_s * delay,
            friction_n=spread.friction_max_n * friction,
            actuators=actuators,
        )

    def at_rest(self, equilibrium: Pool) -> dict[str, Any]:
        """Return the fields of `ArmState` that an equilibrium, a row of a pool, fixes."""
        rest = equilibrium.q, equilibrium.pressure_kpa, equilibrium.spring_m
        return {
            "motion": Motion.at_rest(*rest, self.n_earlier, self._offset_kpa),
            "pose": equilibrium.pose,
            "spring_m": equilibrium.spring_m,
            "pressure_kpa": equilibrium.pressure_kpa,
        }
