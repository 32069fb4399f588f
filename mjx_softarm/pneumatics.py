"""Air in the chambers, and the actuators that set its pressure. NumPy and JAX; `Pneumatics` NumPy only.

A chamber holds ideal gas at constant temperature, p V = n R T. The amount n is counted as its volume at
atmospheric pressure, the unit of a pump's flow. With the bellows' effective area A = area + slope (l - rest),
the volume is V = area l + slope (l - rest)^2 / 2. So V' = A, and a closed chamber conserves mechanical work.

Each chamber has an actuator, a pump or a regulator, which acts on a command after a dead time. An actuator
changes the amount of gas; a chamber that changes its length changes its pressure at once. A stiff regulator
makes up for some of that: a share s of the change of volume counts, as if the chamber had the volume V^s.

Source: the paper's section on the hardware: each chamber is controlled by a pump unit of 12 L/min, whose
valves switch within 10 ms. Regulators: step responses in the logs of ASU-RISE-Lab/4-chamber-softarm-control.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mjx_softarm._support.fields import PerChamber, anything, positive, rule_of
from mjx_softarm._support.xp import Array, array_namespace

ATMOSPHERE_KPA = 101.325
LONGEST_DELAY_S = 2.0  # longest dead time; the state of an arm in motion holds the commands of this time


def volume_m3(length_m: Array, area_m2: Array, slope_m: Array, rest_m: Array | float) -> Array:
    """Return volumes (...) [m^3] of chambers; their effective areas are `area_m2` (...) at lengths `rest_m`.

    `slope_m` (...) is d area / d length.
    """
    return area_m2 * length_m + 0.5 * slope_m * (length_m - rest_m) ** 2


def gas_at(pressure_kpa: Array, volume_m3: Array) -> Array:
    """Return the gas (...) [m^3 at atmospheric pressure] in volumes (...) at gauge pressures (...) [kPa]."""
    return volume_m3 * (1.0 + pressure_kpa / ATMOSPHERE_KPA)


def pressure_of(gas_m3: Array, volume_m3: Array) -> Array:
    """Return the gauge pressures (...) [kPa] of gas (...) in volumes (...)."""
    return ATMOSPHERE_KPA * (gas_m3 / volume_m3 - 1.0)


@dataclass(frozen=True)
class Actuators:
    """One kind of actuator, one for each of n chambers: the table `[actuators]` of a specification.

    `mjx_softarm.mechanics.motion.state` registers the kinds as pytrees.
    """

    kind: ClassVar[str]  # `kind` in the specification

    @property
    def delay_s(self) -> Array | float:
        """Dead time () or (n,) of a command."""
        raise NotImplementedError

    @property
    def rest_offset_kpa(self) -> Array | float:
        """Pressure at rest less its command, () or (n,)."""
        return 0.0

    def felt(self, volume_m3: Array) -> Array:
        """Return volumes (..., n), as gas and pressures depend on volumes (..., n) [m^3] of the chambers."""
        return volume_m3

    def gas_stiffness(self, gas_m3: Array, volume_m3: Array, area_m2: Array) -> Array:
        """Return the stiffness (..., n) of closed chambers by their length, over the atmosphere's pressure.

        It has the unit of `area_m2` (..., n), the effective areas V', squared over that of a volume.
        """
        return gas_m3 * (area_m2 / volume_m3) ** 2

    def fill(self, gas_m3: Array, volume_m3: Array, command_kpa: Array, dt_s: float) -> Array:
        """Return the gas (..., n) [m^3 at atmospheric pressure] after a time dt_s, from that at its start.

        Volumes (..., n) are as `felt`; commands (..., n) are in force, their dead time over.
        """
        raise NotImplementedError

    def per_chamber(self, n: int) -> Actuators:
        """Return the actuators with an array (n,), float64, for each field that has a number per chamber."""
        names = [item.name for item in dataclasses.fields(self) if rule_of(item).per]
        return dataclasses.replace(self, **{name: np.full(n, getattr(self, name), float) for name in names})


@dataclass(frozen=True)
class Pump(Actuators):
    """A pump for each chamber, for pressure and for vacuum, behind valves.

    It asks for the flow that brings the pressure to the command with the valves' switching time as time
    constant. Its greatest flow limits both directions.
    """

    kind: ClassVar[str] = "pump"

    flow_l_per_min: float = positive()
    valve_s: float = positive()  # switching time of the valves: dead time, and time constant

    @property
    def delay_s(self) -> float:
        return self.valve_s

    def fill(self, gas_m3: Array, volume_m3: Array, command_kpa: Array, dt_s: float) -> Array:
        limit_m3 = self.flow_l_per_min / 60e3 * dt_s
        missing_m3 = gas_at(command_kpa, volume_m3) - gas_m3
        xp = array_namespace(missing_m3)
        return gas_m3 + xp.clip(-math.expm1(-dt_s / self.valve_s) * missing_m3, -limit_m3, limit_m3)


@dataclass(frozen=True)
class Regulator(Actuators):
    """A pressure regulator for each chamber.

    It brings the pressure p to the command c, with e = c + offset - p, d the deadband and T the lag:

        p' = clip((e - clip(e, -d, d)) / T, -vent, fill)

    Within the deadband the chamber is closed. `volume_share` is 0 for a regulator so fast inside that the
    chamber's volume does not matter; the lag is then that of its command.
    """

    kind: ClassVar[str] = "regulator"

    lag_s: PerChamber | Array = positive(per="chambers")  # time constant
    dead_time_s: PerChamber | Array = anything(per="chambers", low=0.0, high=LONGEST_DELAY_S)
    fill_kpa_per_s: PerChamber | Array = positive(per="chambers")  # greatest rate of a rising pressure
    vent_kpa_per_s: PerChamber | Array = positive(per="chambers")  # greatest rate of a falling pressure
    deadband_kpa: PerChamber | Array = anything(per="chambers", low=0.0)
    offset_kpa: PerChamber | Array = anything(default=0.0, per="chambers")
    volume_share: Array | float = anything(default=1.0, low=0.0, high=1.0)

    @property
    def delay_s(self) -> Array | float:
        return self.dead_time_s

    @property
    def rest_offset_kpa(self) -> Array | float:
        return self.offset_kpa

    def felt(self, volume_m3: Array) -> Array:
        return volume_m3**self.volume_share

    def gas_stiffness(self, gas_m3: Array, volume_m3: Array, area_m2: Array) -> Array:
        return self.volume_share * gas_m3 / self.felt(volume_m3) * area_m2**2 / volume_m3

    def fill(self, gas_m3: Array, volume_m3: Array, command_kpa: Array, dt_s: float) -> Array:
        numbers: Any = self  # numbers are () or (n,)
        xp = array_namespace(gas_m3, volume_m3, command_kpa, *vars(self).values())
        missing_kpa = command_kpa + numbers.offset_kpa - pressure_of(gas_m3, volume_m3)
        outside_kpa = missing_kpa - xp.clip(missing_kpa, -numbers.deadband_kpa, numbers.deadband_kpa)
        share = -xp.expm1(-dt_s / numbers.lag_s)
        change_kpa = xp.clip(
            share * outside_kpa, -dt_s * numbers.vent_kpa_per_s, dt_s * numbers.fill_kpa_per_s
        )
        return gas_m3 + volume_m3 * change_kpa / ATMOSPHERE_KPA


ACTUATORS: dict[str, type[Actuators]] = {cls.kind: cls for cls in (Pump, Regulator)}
PAPER_PUMP = Pump(flow_l_per_min=12.0, valve_s=0.010)  # paper; actuators of a file without the table


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
        """Start at lengths (n,) and atmospheric pressure, all actuators at rest on it.

        The bellows are those of `volume_m3`. Dead times are rounded to whole time steps.
        """
        self._bellows = area_m2, slope_m, rest_m
        self._timestep_s = timestep_s
        self._actuators = actuators
        self._chamber = np.arange(len(length_m))
        delay_s = np.full(len(length_m), actuators.delay_s)
        self._wait = np.round(delay_s / timestep_s).astype(int)  # (n,) steps
        self.hold(np.zeros(len(length_m)), length_m)

    def hold(self, pressure_kpa: np.ndarray, length_m: np.ndarray) -> None:
        """Be at rest at pressures (n,) [kPa] and lengths (n,) [m], under the commands that hold them."""
        self.pressure_kpa = np.array(pressure_kpa, float)
        self._gas_m3 = gas_at(self.pressure_kpa, self.volume_m3(length_m))
        self._commanded_kpa = self.pressure_kpa - self._actuators.rest_offset_kpa
        self._line = np.tile(self._commanded_kpa, (self._wait.max() + 1, 1))  # commands, newest first

    def volume_m3(self, length_m: np.ndarray) -> np.ndarray:
        """Return volumes (n,) [m^3] of chambers with lengths (n,) [m], as the actuators feel them."""
        return self._actuators.felt(volume_m3(length_m, *self._bellows))

    def command(self, pressure_kpa: np.ndarray) -> None:
        """Command pressures (n,) [kPa], relative to the atmosphere."""
        self._commanded_kpa = np.array(pressure_kpa, float)

    def step(self, length_m: np.ndarray) -> np.ndarray:
        """Take a time step at lengths (n,) [m]; return pressures (n,) [kPa], relative to the atmosphere."""
        self._line[1:] = self._line[:-1]
        self._line[0] = self._commanded_kpa
        volume = self.volume_m3(length_m)
        command_kpa = self._line[self._wait, self._chamber]
        self._gas_m3 = self._actuators.fill(self._gas_m3, volume, command_kpa, self._timestep_s)
        self.pressure_kpa = pressure_of(self._gas_m3, volume)
        return self.pressure_kpa
