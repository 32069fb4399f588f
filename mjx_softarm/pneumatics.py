"""Air in the chambers: one pump per chamber, and valves with a delay. NumPy and JAX.

A chamber holds ideal gas at constant temperature, p V = n R T. The amount n is counted as its volume at
atmospheric pressure, the unit of a pump's flow. With the bellows' effective area A = area + slope (l - rest),
the volume is V = area l + slope (l - rest)^2 / 2. So V' = A, and a closed chamber conserves mechanical work.

Each chamber's regulator asks for the flow that brings the pressure to the command with the valve's switching
time as time constant. The pump limits this flow in both directions: it makes both pressure and vacuum. A
command takes effect after the valve's switching time.

Source: the paper's section on the hardware: each chamber is controlled by a pump unit of 12 L/min, whose
valves switch within 10 ms.
"""

from __future__ import annotations

import math

from mjx_softarm._support.xp import Array, array_namespace

ATMOSPHERE_KPA = 101.325
PUMP_M3_PER_S = 12e-3 / 60.0  # paper: 12 L/min for each chamber
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
    """Return the gas (...) [m^3 at atmospheric pressure] in volumes (...) at gauge pressures (...) [kPa]."""
    return volume_m3 * (1.0 + pressure_kpa / ATMOSPHERE_KPA)


def pressure_of(gas_m3: Array, volume_m3: Array) -> Array:
    """Return the gauge pressures (...) [kPa] of gas (...) in volumes (...)."""
    return ATMOSPHERE_KPA * (gas_m3 / volume_m3 - 1.0)


def regulated(gas_m3: Array, volume_m3: Array, command_kpa: Array, dt_s: float) -> Array:
    """Return the gas (...) after a time dt_s in which the regulators had commands (...) [kPa]."""
    limit_m3 = PUMP_M3_PER_S * dt_s
    missing_m3 = gas_at(command_kpa, volume_m3) - gas_m3
    xp = array_namespace(missing_m3)
    return gas_m3 + xp.clip(-math.expm1(-dt_s / VALVE_S) * missing_m3, -limit_m3, limit_m3)
