"""The twin's chambers as they fill; see `mjx_softarm.pneumatics`."""

from __future__ import annotations

from collections import deque

import numpy as np

from mjx_softarm import pneumatics


class Pneumatics:
    """Pressures of n chambers, stepped in time."""

    def __init__(
        self,
        area_m2: np.ndarray,
        slope_m: np.ndarray,
        rest_m: np.ndarray | float,
        length_m: np.ndarray,
        timestep_s: float,
    ):
        """Start at atmospheric pressure, all valves closed on it.

        Args:
            area_m2 (n,) [m^2]: effective areas at the lengths `rest_m`.
            slope_m (n,) [m]: d area / d length.
            rest_m (n,) [m], or one number: lengths of the effective areas.
            length_m (n,) [m]: lengths at the start.
            timestep_s: duration of a `step`; the dead time is rounded to whole steps.
        """
        self._bellows = area_m2, slope_m, rest_m
        self._timestep_s = timestep_s
        self.pressure_kpa = self._commanded_kpa = np.zeros(len(length_m))
        self._gas_m3 = pneumatics.gas_at(self.pressure_kpa, self.volume_m3(length_m))
        steps = round(pneumatics.VALVE_S / timestep_s)
        self._under_way = deque([self._commanded_kpa] * (steps + 1), steps + 1)

    def volume_m3(self, length_m: np.ndarray) -> np.ndarray:
        """Return volumes (n,) [m^3] of chambers with lengths (n,) [m]."""
        return pneumatics.volume_m3(length_m, *self._bellows)

    def command(self, pressure_kpa: np.ndarray) -> None:
        """Command pressures (n,) [kPa], relative to the atmosphere."""
        self._commanded_kpa = np.array(pressure_kpa, float)

    def step(self, length_m: np.ndarray) -> np.ndarray:
        """Take a time step at lengths (n,) [m]; return pressures (n,) [kPa], relative to the atmosphere."""
        self._under_way.append(self._commanded_kpa)
        volume, command_kpa = self.volume_m3(length_m), self._under_way[0]
        self._gas_m3 = pneumatics.regulated(self._gas_m3, volume, command_kpa, self._timestep_s)
        self.pressure_kpa = pneumatics.pressure_of(self._gas_m3, volume)
        return self.pressure_kpa
