"""Pressures and poses that take an arm over its workspace. NumPy alone, since they drive a real arm, too."""

from __future__ import annotations

import numpy as np

from mjx_softarm.posture import turned_poses
from mjx_softarm.spec import ArmSpec

CIRCLE_DIAMETER_MM, CIRCLE_HEIGHT_MM = 160.0, -575.0  # on the paper's arm of 600 mm
N_GROWING = 10  # poses from a first small motion to the full range


def random_pressures(spec: ArmSpec, n_poses: int, seed: int | np.random.Generator) -> np.ndarray:
    """Draw pressures (n_poses, n) [kPa] by the arcsine law between the arm's limits.

    It favours the extremes, where the workspace ends.

    Args:
        spec: the arm.
        n_poses: how many sets.
        seed: seed of the draw, or a generator.
    """
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    swing = np.cos(np.random.default_rng(seed).uniform(0.0, np.pi, (n_poses, spec.n_chambers)))
    return low + (high - low) * 0.5 * (1.0 + swing)


def circle_poses(spec: ArmSpec, n: int = 40) -> np.ndarray:
    """Return poses (n, 6) [mm, deg] on a circle around the straight arm's axis, the tip along the axis.

    The circle of the paper is horizontal below a hanging arm; it is scaled with the length of the arm, and
    turned with its posture. The paper gives diameter and number of points but no height; at ours, its arm
    reaches every point with 2 kPa to spare in each chamber.
    """
    angle, size = 2 * np.pi * np.arange(n) / n, spec.length_m / 0.6
    radius, height = 0.5 * CIRCLE_DIAMETER_MM * size, np.full(n, CIRCLE_HEIGHT_MM * size)
    at = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
    return turned_poses(spec, at).astype(np.float32)


def growing(pressure_kpa: np.ndarray) -> np.ndarray:
    """Scale the first ten of pressures (n_poses, n) [kPa] by 0.1 to 1, so that motions begin small."""
    share = np.minimum(1.0, np.arange(1, len(pressure_kpa) + 1) / N_GROWING)
    return share[:, None] * pressure_kpa
