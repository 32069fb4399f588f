"""Sessions, noise and checks of commands that all kinds of twins share."""

from __future__ import annotations

import numpy as np

from mjx_softarm.spec import ArmSpec

# Data for a sim-to-real network and for its evaluation come from the same twin, but from different sessions:
# with other noise and other motions.
S2R_SESSION, EVALUATION_SESSION = 0, 1

PRESSURE_NOISE_KPA = 0.05
CAPTURE_NOISE_M = 2e-4
CAPTURE_NOISE_DEG = 0.1
SPRING_NOISE_M = 2**0.5 * CAPTURE_NOISE_M  # noise of the distance between two markers
PRESSURE_TOLERANCE_KPA = 1e-3  # tolerance beyond the limits, for rounding to float32
MARKERS_PER_SECTION = 3
WIDEST_DRAW = 2.0  # largest deviation of a part, in standard deviations; a worse part is not mounted


def checked_pressures(pressure_kpa: np.ndarray, spec: ArmSpec) -> np.ndarray:
    """Return commanded pressures (n,) [kPa], clipped to the limits.

    Raises:
        ValueError: the shape is wrong, or a pressure is beyond the arm's limits.
    """
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    command = np.asarray(pressure_kpa, float)
    if command.shape != (spec.n_chambers,):
        raise ValueError(f"pressure_kpa: got shape {command.shape}, expected ({spec.n_chambers},)")
    within = (command >= low - PRESSURE_TOLERANCE_KPA) & (command <= high + PRESSURE_TOLERANCE_KPA)
    if not within.all():
        chamber = int(np.flatnonzero(~within)[0])
        text = f"got {command[chamber]:g}, expected {low:g} to {high:g} kPa"
        raise ValueError(f"pressure_kpa[{chamber}]: {text}")
    return np.clip(command, low, high)


def checked_payload(payload_kg: float) -> float:
    """Return a payload [kg].

    Raises:
        ValueError: the mass is negative or not finite.
    """
    if not (np.isfinite(payload_kg) and payload_kg >= 0.0):
        raise ValueError(f"payload_kg: got {payload_kg!r}, expected a number >= 0")
    return payload_kg
