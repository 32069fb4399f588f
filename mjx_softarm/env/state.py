"""State of one arm of the environment, and the random numbers of its episode."""

from __future__ import annotations

from typing import NamedTuple

import jax
from jax import Array

from mjx_softarm.mechanics.dynamics import Motion
from mjx_softarm.sensing.sensors import SENSORS

for _sensor in SENSORS.values():
    jax.tree_util.register_dataclass(_sensor)  # numbers are traced, the kind is static


class EpisodeNoise(NamedTuple):
    """Random numbers that fix one episode: start, goal, payload, stiffness, sensor bias, damping, delay."""

    uniform: Array  # (3 + n_chambers,) from 0 to 1: start, goal, payload, stiffness of each chamber
    normal: Array  # (n_chambers,) standard normal: bias of each spring's reading
    moving: Array | None  # (2,) from 0 to 1: damping, delay; None for arms at rest


class ArmState(NamedTuple):
    """One arm between two actions."""

    payload_kg: Array  # () payload of this episode
    chamber_stiffness: Array  # (n_chambers,) [N/m] stiffnesses of this episode
    sensor_offset_m: Array  # (n_chambers,) reading less true length, in this episode
    damping: Array  # () factor of all dampers in this episode
    delay_s: Array  # () dead time of the valves in this episode
    motion: Motion  # joint coordinates, velocities, pressures
    pose: Array  # (6,) [mm, deg] as observed: the real arm's where there is a sim-to-real network
    spring_m: Array  # (n_chambers,) true lengths
    pressure_kpa: Array  # (n_chambers,)
    sensed: Array | None  # (k,) `observe_motion`; None where pose and goal are all that is observed
    goal: Array  # (6,) [mm, deg]
    n_steps: Array  # () actions taken in this episode
