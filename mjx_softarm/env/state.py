"""State of one arm of the environment, and the random numbers of its episode."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm.env.config import Randomisation
from mjx_softarm.mechanics.motion.state import Motion, MotionParams
from mjx_softarm.mechanics.workspace import Pool
from mjx_softarm.pneumatics import VALVE_S
from mjx_softarm.sensing.sensors import SENSORS

for _sensor in SENSORS.values():
    jax.tree_util.register_dataclass(_sensor)  # its numbers are traced

PAYLOAD_SHARE = 2  # index in `EpisodeNoise.uniform`


class EpisodeNoise(NamedTuple):
    """Random numbers that fix one episode."""

    uniform: Array  # (3 + n_chambers,) from 0 to 1: start, goal, payload, stiffness of each chamber
    normal: Array  # (n_chambers,) standard normal: bias of each spring's reading
    moving: Array | None  # (3,) from 0 to 1: damping, delay, friction; None for arms at rest


class ArmState(NamedTuple):
    """State of one arm between two actions."""

    payload_kg: Array  # () payload of this episode
    chamber_stiffness: Array  # (n_chambers,) [N/m] stiffnesses of this episode
    sensor_offset_m: Array  # (n_chambers,) error of each spring's reading in this episode
    moving: MotionParams  # parameters of motion in this episode
    motion: Motion  # joint coordinates, velocities, pressures
    pose: Array  # (6,) [mm, deg] observed pose: the real arm's if there is a sim-to-real network
    spring_m: Array  # (n_chambers,) true lengths
    pressure_kpa: Array  # (n_chambers,)
    sensed: Array | None  # (k,) observations besides pose and goal; None if there are none
    goal: Array  # (6,) [mm, deg]
    n_steps: Array  # () actions taken in this episode


def at_rest(equilibrium: Pool) -> dict[str, Any]:
    """Return the fields of `ArmState` that an equilibrium, a row of a pool, fixes."""
    return {
        "motion": Motion.at_rest(equilibrium.q, equilibrium.pressure_kpa, equilibrium.spring_m),
        "pose": equilibrium.pose,
        "spring_m": equilibrium.spring_m,
        "pressure_kpa": equilibrium.pressure_kpa,
    }


def motion_params(spread: Randomisation, share: Array | None) -> MotionParams:
    """Return the parameters that `EpisodeNoise.moving` fixes; None gives the nominal ones."""
    damping, delay, friction = jnp.array([0.5, 0.0, 0.0]) if share is None else share
    return MotionParams(
        damping=1.0 + spread.damping_spread * (2.0 * damping - 1.0),
        delay_s=VALVE_S + spread.delay_max_s * delay,
        friction_n=spread.friction_max_n * friction,
    )
