"""Parts that twins of all kinds share: sessions, noise, and the commands that they refuse."""

from __future__ import annotations

import numpy as np

from mjx_softarm.spec import ArmSpec

# An S2R network belongs to one arm, so its data come from the same twin as the evaluation, but from another
# session, whose noise is another, and from other motions.
S2R_SESSION, EVALUATION_SESSION = 0, 1

PRESSURE_NOISE_KPA = 0.05
CAPTURE_NOISE_M = 2e-4
CAPTURE_NOISE_DEG = 0.1
SPRING_NOISE_M = 2**0.5 * CAPTURE_NOISE_M  # between two markers
PRESSURE_TOLERANCE_KPA = 1e-3  # a float32 limit is not yet beyond the limit
MARKERS_PER_SECTION = 3
WIDEST_DRAW = 2.0  # standard deviations; a part further off would not have been mounted


def checked_pressures(pressure_kpa: np.ndarray, spec: ArmSpec) -> np.ndarray:
    """Return commanded pressures (n,) [kPa], rounding errors clipped.

    Raises:
        ValueError: a wrong shape, or a pressure beyond the arm's limits.
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
    """Return a payload.

    Raises:
        ValueError: a mass that is negative or not finite.
    """
    if not (np.isfinite(payload_kg) and payload_kg >= 0.0):
        raise ValueError(f"payload_kg: got {payload_kg!r}, expected a number >= 0")
    return payload_kg
