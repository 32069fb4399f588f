"""Random pressures that take an arm all over its workspace. NumPy alone: they drive a real arm, too."""

from __future__ import annotations

import numpy as np

from mjx_softarm.spec import ArmSpec


def random_pressures(spec: ArmSpec, n_poses: int, seed: int | np.random.Generator) -> np.ndarray:
    """Draw pressures (n_poses, n) [kPa] by the arcsine law between the arm's limits.

    It favours the extremes, where the workspace ends.

    Args:
        spec: the arm.
        n_poses: how many sets.
        seed: of the draw, or what draws it.
    """
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    swing = np.cos(np.random.default_rng(seed).uniform(0.0, np.pi, (n_poses, spec.n_chambers)))
    return low + (high - low) * 0.5 * (1.0 + swing)
