"""State of one arm of the environment, and the parameters of its motion in an episode."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support.lazy import brax_envs
from mjx_softarm.env.config import Randomisation
from mjx_softarm.mechanics.motion.state import Motion, MotionParams
from mjx_softarm.pneumatics import Actuators, Regulator
from mjx_softarm.sensing.sensors import SENSORS

for _sensor in SENSORS.values():
    jax.tree_util.register_dataclass(_sensor)  # its numbers are traced


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


def nominal_share(actuators: Actuators) -> Array:
    """Return the `share` of `motion_params` that gives the nominal parameters."""
    regulated = [0.5] * 3 if isinstance(actuators, Regulator) else []
    return jnp.array([0.5, 0.0, 0.0, *regulated])


def motion_params(actuators: Actuators, spread: Randomisation, share: Array) -> MotionParams:
    """Return the parameters of an arm's motion in an episode.

    Args:
        actuators: the nominal ones.
        spread: differences between episodes.
        share (k,): random numbers from 0 to 1: damping, delay and friction, then lag, dead time and rates of
            regulators.
    """
    damping, delay, friction, *others = share
    delay_s = actuators.delay_s
    if isinstance(actuators, Regulator):
        lag, dead_time, rate = (1.0 + spread.regulator_spread * (2.0 * x - 1.0) for x in others)
        rates = {name: rate * getattr(actuators, name) for name in ("fill_kpa_per_s", "vent_kpa_per_s")}
        actuators = dataclasses.replace(actuators, lag_s=lag * actuators.lag_s, **rates)
        delay_s = dead_time * delay_s
    return MotionParams(
        damping=1.0 + spread.damping_spread * (2.0 * damping - 1.0),
        delay_s=delay_s + spread.delay_max_s * delay,
        friction_n=spread.friction_max_n * friction,
        actuators=actuators,
    )
