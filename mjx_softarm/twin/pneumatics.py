"""A twin's chambers as they fill; see `mjx_softarm.pneumatics`."""

from __future__ import annotations

import numpy as np

from mjx_softarm import pneumatics
from mjx_softarm.pneumatics import PAPER_PUMP, Actuators


class Pneumatics:
    """Pressures of n chambers, stepped in time."""

    def __init__(
        self,
        area_m2: np.ndarray,
        slope_m: np.ndarray,
        rest_m: np.ndarray | float,
        length_m: np.ndarray,
        timestep_s: float,
        actuators: Actuators = PAPER_PUMP,
    ):
        """Start at atmospheric pressure, all actuators at rest on it.

        Args:
            area_m2 (n,) [m^2]: effective areas at the lengths `rest_m`.
            slope_m (n,) [m]: d area / d length.
            rest_m (n,) [m], or one number: lengths of the effective areas.
            length_m (n,) [m]: lengths at the start.
            timestep_s: duration of a `step`; dead times are rounded to whole steps.
            actuators: pumps or regulators.
        """
        self._bellows = area_m2, slope_m, rest_m
        self._timestep_s, self._actuators = timestep_s, actuators
        self._chamber = np.arange(len(length_m))
        delay_s = np.full(len(length_m), actuators.delay_s)
        self._wait = np.round(delay_s / timestep_s).astype(int)  # (n,) steps
        self.hold(np.zeros(len(length_m)), length_m)

    def hold(self, pressure_kpa: np.ndarray, length_m: np.ndarray) -> None:
        """Be at rest at pressures (n,) [kPa] and lengths (n,) [m], under the commands that hold them."""
        self.pressure_kpa = np.array(pressure_kpa, float)
        self._gas_m3 = pneumatics.gas_at(self.pressure_kpa, self.volume_m3(length_m))
        offset_kpa = self._actuators.rest_offset_kpa
        self._commanded_kpa = self.pressure_kpa - (0.0 if offset_kpa is None else offset_kpa)
        self._line = np.tile(self._commanded_kpa, (self._wait.max() + 1, 1))  # commands, newest first

    def volume_m3(self, length_m: np.ndarray) -> np.ndarray:
        """Return volumes (n,) [m^3] of chambers with lengths (n,) [m]."""
        return pneumatics.volume_m3(length_m, *self._bellows)

    def command(self, pressure_kpa: np.ndarray) -> None:
        """Command pressures (n,) [kPa], relative to the atmosphere."""
        self._commanded_kpa = np.array(pressure_kpa, float)

    def step(self, length_m: np.ndarray) -> np.ndarray:
        """Take a time step at lengths (n,) [m]; return pressures (n,) [kPa], relative to the atmosphere."""
        self._line[1:] = self._line[:-1]
        self._line[0] = self._commanded_kpa
        volume, command_kpa = self.volume_m3(length_m), self._line[self._wait, self._chamber]
        self._gas_m3 = self._actuators.fill(self._gas_m3, volume, command_kpa, self._timestep_s)
        self.pressure_kpa = pneumatics.pressure_of(self._gas_m3, volume)
        return self.pressure_kpa
