"""Air in the chambers: one pump for all of them, and valves that answer late.

A chamber holds ideal gas at constant temperature, p V = n R T. The amount n is counted as the volume it has
at atmospheric pressure, so that a pump of so many litres per minute delivers just that. With the bellows'
effective area A = area + slope (l - rest), its volume is V = area l + slope (l - rest)^2 / 2: V' = A, so
that a closed chamber gives back as mechanical work exactly what was put into it.

Each chamber's regulator asks for the flow that would bring its pressure to the commanded one within the
valve's switching time. Where together they ask for more than the pump gives, all get the same share of what
they asked for. Air that leaves a chamber is counted like air that enters: one pump makes both pressure
and vacuum, and nothing vents past it.
"""

from __future__ import annotations

from collections import deque

import numpy as np

ATMOSPHERE_KPA = 101.325
PUMP_M3_PER_S = 12e-3 / 60.0  # paper: 12 L/min
VALVE_S = 0.010  # paper: valves switch within 10 ms; dead time, and time constant of the regulator


class Pneumatics:
    """Pressures of n chambers, stepped in time."""

    def __init__(
        self, area_m2: np.ndarray, slope_m: np.ndarray, rest_m: float, length_m: np.ndarray, timestep_s: float
    ):
        """Start at atmospheric pressure, all valves closed on it.

        Args:
            area_m2 (n,) [m^2]: effective areas at the length `rest_m`.
            slope_m (n,) [m]: d area / d length.
            rest_m: length at which the areas are given.
            length_m (n,) [m]: lengths now.
            timestep_s: of `step`; the dead time is rounded to whole steps.
        """
        self._area_m2, self._slope_m, self._rest_m = area_m2, slope_m, rest_m
        self._timestep_s = timestep_s
        self._gas_m3 = self.volume_m3(length_m)
        self.pressure_kpa = np.zeros(len(length_m))
        self._commanded_kpa = np.zeros(len(length_m))
        steps = round(VALVE_S / timestep_s)
        self._under_way = deque([self._commanded_kpa] * (steps + 1), steps + 1)

    def volume_m3(self, length_m: np.ndarray) -> np.ndarray:
        """Return volumes (n,) of chambers of lengths (n,)."""
        return self._area_m2 * length_m + 0.5 * self._slope_m * (length_m - self._rest_m) ** 2

    def command(self, pressure_kpa: np.ndarray) -> None:
        """Set what the pressures (n,) [kPa, relative to the atmosphere] are regulated to."""
        self._commanded_kpa = np.array(pressure_kpa, float)

    def step(self, length_m: np.ndarray) -> np.ndarray:
        """Take a time step in chambers (n,) [m] long; return pressures (n,) [kPa] above the atmosphere's."""
        self._under_way.append(self._commanded_kpa)
        volume_m3 = self.volume_m3(length_m)
        wanted_m3 = volume_m3 * (1.0 + self._under_way[0] / ATMOSPHERE_KPA)
        flow = (wanted_m3 - self._gas_m3) / VALVE_S
        total = np.abs(flow).sum()
        if total > PUMP_M3_PER_S:
            flow *= PUMP_M3_PER_S / total
        self._gas_m3 = self._gas_m3 + flow * self._timestep_s
        self.pressure_kpa = ATMOSPHERE_KPA * (self._gas_m3 / volume_m3 - 1.0)
        return self.pressure_kpa
