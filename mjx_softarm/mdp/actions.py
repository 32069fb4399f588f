"""Map between actions and spring lengths: an action in [-1, 1] is a sensor reading, scaled linearly.

    reading = low + (action + 1) / 2 (high - low)

low and high are the readings of the shortest and the longest spring that may be commanded.

Source: the paper's action space, whose readings are the coils' frequencies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import ArmSpec

N_ACTIONS = 4  # actions towards each goal, in evaluations and on the arm
# Largest shift (6,) [mm, deg] of the goal that a policy is given to correct an error; by hand
SHIFT_LIMIT = np.repeat([25.0, 5.0], 3)


class ActionMap(NamedTuple):
    """Map between the actions of n springs, their readings and their lengths."""

    sensor: Sensor
    low: Array  # (n,) readings that the action -1 asks for
    high: Array  # (n,) readings that the action 1 asks for

    @classmethod
    def from_spec(cls, spec: ArmSpec) -> ActionMap:
        """Return the map of an arm, in float64."""
        sensor = spec.spring_sensor
        limits_m = spec.springs.length_min_m, spec.springs.length_max_m
        return cls(sensor, *(sensor.readings(spec.at_springs(limit_m)) for limit_m in limits_m))

    def readings(self, action: Array) -> Array:
        """Return the readings (..., n) that actions (..., n) ask for; an action beyond [-1, 1] is clipped."""
        xp = array_namespace(action, self.low)
        return self.low + 0.5 * (xp.clip(action, -1.0, 1.0) + 1.0) * (self.high - self.low)

    def lengths(self, action: Array) -> Array:
        """Return the spring lengths (..., n) [m] that actions (..., n) ask for."""
        return self.sensor.lengths(self.readings(action)).length_m

    def from_readings(self, readings: Array) -> Array:
        """Return the actions (..., n) that ask for readings (..., n), clipped to [-1, 1]."""
        xp = array_namespace(readings, self.low)
        return xp.clip(2.0 * (readings - self.low) / (self.high - self.low) - 1.0, -1.0, 1.0)

    def from_lengths(self, length_m: Array) -> Array:
        """Return the actions (..., n) that ask for spring lengths (..., n) [m], clipped to [-1, 1]."""
        return self.from_readings(self.sensor.readings(length_m))
