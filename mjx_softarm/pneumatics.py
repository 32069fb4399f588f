"""Air in the chambers: a pump for each of them, and valves that answer late. NumPy and JAX.

A chamber holds ideal gas at constant temperature, p V = n R T. The amount n is counted as the volume it has
at atmospheric pressure, so that a pump of so many litres per minute delivers just that. With the bellows'
effective area A = area + slope (l - rest), its volume is V = area l + slope (l - rest)^2 / 2: V' = A, so
that a closed chamber gives back as mechanical work exactly what was put into it.

Each chamber's regulator asks for the flow that brings its pressure to the commanded one with the valve's
switching time as time constant, and gets at most what its pump gives. Air that leaves a chamber is counted
like air that enters: the pump makes both pressure and vacuum, and nothing vents past it. A command takes
effect after the valve's switching time.

Source: the paper's section on the hardware: each chamber is controlled by a pump unit of 12 L/min, whose
valves switch within 10 ms.
"""

from __future__ import annotations

import math

from mjx_softarm._support.xp import Array, array_namespace

ATMOSPHERE_KPA = 101.325
PUMP_M3_PER_S = 12e-3 / 60.0  # paper: 12 L/min, each chamber's own
VALVE_S = 0.010  # paper: valves switch within 10 ms; dead time, and time constant of the regulator


def volume_m3(length_m: Array, area_m2: Array, slope_m: Array, rest_m: Array | float) -> Array:
    """Return volumes (...) of chambers.

    Args:
        length_m (...) [m]: lengths.
        area_m2 (...) [m^2]: effective areas at the length `rest_m`.
        slope_m (...) [m]: d area / d length.
        rest_m: length at which the areas are given.
    """
    return area_m2 * length_m + 0.5 * slope_m * (length_m - rest_m) ** 2


def gas_at(pressure_kpa: Array, volume_m3: Array) -> Array:
    """Return the gas (...) [m^3 at atmospheric pressure] of volumes (...) at pressures (...) above it."""
    return volume_m3 * (1.0 + pressure_kpa / ATMOSPHERE_KPA)


def pressure_of(gas_m3: Array, volume_m3: Array) -> Array:
    """Return the pressures (...) [kPa above the atmosphere's] of gas (...) in volumes (...)."""
    return ATMOSPHERE_KPA * (gas_m3 / volume_m3 - 1.0)


def regulated(gas_m3: Array, volume_m3: Array, command_kpa: Array, dt_s: float) -> Array:
    """Return the gas (...) after a time in which the regulators had commands (...) [kPa]."""
    most_m3 = PUMP_M3_PER_S * dt_s
    wanted_m3 = gas_at(command_kpa, volume_m3) - gas_m3
    xp = array_namespace(wanted_m3)
    return gas_m3 + xp.clip(-math.expm1(-dt_s / VALVE_S) * wanted_m3, -most_m3, most_m3)
