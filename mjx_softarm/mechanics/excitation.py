"""Pressures and poses that take an arm over its workspace. NumPy alone, since they drive a real arm, too."""

from __future__ import annotations

import numpy as np

from mjx_softarm.control import planes
from mjx_softarm.posture import turned_poses
from mjx_softarm.spec import ArmSpec

CIRCLE_DIAMETER_MM, CIRCLE_HEIGHT_MM = 160.0, -575.0  # on the paper's arm of 600 mm
WITHOUT_VACUUM = 1.17  # depth of the circle in lengths of an arm whose chambers only lengthen it
N_GROWING = 10  # poses from a first small motion to the full range


def random_pressures(spec: ArmSpec, n_poses: int, seed: int | np.random.Generator) -> np.ndarray:
    """Draw pressures (n_poses, n_chambers) [kPa] by the arcsine law between the arm's limits.

    It favours the extremes, where the workspace ends. More than three independent chambers seldom push one
    way together. So every second set of such an arm has, in each section, a plane through the pressures of
    three directions; the other sets distinguish the chambers.
    """
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    rng = np.random.default_rng(seed)
    n = spec.structure.chambers_per_section
    swing = np.cos(rng.uniform(0.0, np.pi, (n_poses, spec.n_chambers)))
    if n > 3:
        swing[::2] = _plane_swings(n, len(swing[::2]) * spec.structure.n_sections, rng).reshape(
            -1, spec.n_chambers
        )
    return low + (high - low) * 0.5 * (1.0 + swing)


def _plane_swings(n: int, k: int, rng: np.random.Generator) -> np.ndarray:
    """Draw swings (k, n) in [-1, 1] of k sections of n chambers, each a plane through three directions."""
    # Mean, and slopes along x and y (k, 3)
    three = np.cos(rng.uniform(0.0, np.pi, (k, 3))) @ np.linalg.pinv(planes(3)).T
    angle = 2 * np.pi * np.arange(n) / n + rng.uniform(0.0, 2 * np.pi, (k, 1))
    swing = three[:, :1] + three[:, 1:2] * np.cos(angle) + three[:, 2:] * np.sin(angle)
    return np.clip(swing, -1.0, 1.0)


def circle_poses(spec: ArmSpec, n: int = 40) -> np.ndarray:
    """Return poses (n, 6) [mm, deg] on a circle around the straight arm's axis, the tip along the axis.

    The circle of the paper is horizontal below a hanging arm; it is scaled with the length of the arm, and
    turned with its posture. The paper gives diameter and number of points but no height; at ours, its arm
    reaches every point with 2 kPa to spare in each chamber. An arm without vacuum is seldom shorter than at
    rest, so its circle is lower; those that ship then have 8 kPa to spare.
    """
    angle = 2 * np.pi * np.arange(n) / n
    size = spec.length_m / 0.6
    evacuated = spec.chambers.pressure_min_kpa < 0.0
    height_mm = CIRCLE_HEIGHT_MM * size if evacuated else -1e3 * WITHOUT_VACUUM * spec.length_m
    radius = 0.5 * CIRCLE_DIAMETER_MM * size
    height = np.full(n, height_mm)
    place_mm = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
    return turned_poses(spec, place_mm).astype(np.float32)


def growing(pressure_kpa: np.ndarray) -> np.ndarray:
    """Scale the first ten of pressures (n_poses, n) [kPa] by 0.1 to 1, so that motions begin small."""
    share = np.minimum(1.0, np.arange(1, len(pressure_kpa) + 1) / N_GROWING)
    return share[:, None] * pressure_kpa
