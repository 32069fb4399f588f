"""Pressures and poses that take an arm over its workspace. NumPy alone: they drive a real arm, too."""

from __future__ import annotations

import numpy as np

from mjx_softarm.spec import ArmSpec

CIRCLE_DIAMETER_MM, CIRCLE_HEIGHT_MM = 160.0, -575.0  # of an arm of 600 mm, the paper's
N_GROWING = 10  # poses from a first small motion to the full range


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


def circle_poses(spec: ArmSpec, n: int = 40) -> np.ndarray:
    """Return poses (n, 6) [mm, deg] along a horizontal circle below the base, the tip hanging straight down.

    It is the paper's, as many times as large as the arm is longer. The paper gives diameter and number of
    points but no height; at ours, its arm reaches every point with 2 kPa to spare in each chamber.
    """
    angle, zero, size = 2 * np.pi * np.arange(n) / n, np.zeros(n), spec.length_m / 0.6
    radius, height = 0.5 * CIRCLE_DIAMETER_MM * size, np.full(n, CIRCLE_HEIGHT_MM * size)
    columns = [radius * np.cos(angle), radius * np.sin(angle), height, zero, zero, zero]
    return np.stack(columns, axis=-1).astype(np.float32)


def growing(pressure_kpa: np.ndarray) -> np.ndarray:
    """Scale the first of some sets of pressures (n_poses, n) [kPa], from a tenth to all of each."""
    share = np.minimum(1.0, np.arange(1, len(pressure_kpa) + 1) / N_GROWING)
    return share[:, None] * pressure_kpa
