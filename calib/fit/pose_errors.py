"""Distances between poses: what the fits to static poses are judged by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjx_softarm.sensing.s2r import correction_between


@dataclass(frozen=True)
class PoseErrors:
    """Distances of n poses from measured ones: means and 95th percentiles; NaN if n is 0."""

    n: int
    translation_mean_mm: float
    translation_95_mm: float
    rotation_mean_deg: float
    rotation_95_deg: float


def errors_of(distance_mm: np.ndarray, angle_deg: np.ndarray) -> PoseErrors:
    """Sum up errors of n poses.

    Args:
        distance_mm (n,): distances of the tips.
        angle_deg (n,): angles between the tips' axes.
    """
    numbers = [
        f(x) if len(x) else np.nan
        for x in (distance_mm, angle_deg)
        for f in (np.mean, lambda x: np.percentile(x, 95.0))
    ]
    return PoseErrors(len(distance_mm), *map(float, numbers))


def pose_errors(pose: np.ndarray, real: np.ndarray) -> PoseErrors:
    """Compare poses (n, 6) [mm, deg] with real ones."""
    return change_errors(correction_between(pose, real))


def change_errors(change: np.ndarray) -> PoseErrors:
    """Sum up changes (n, 6) of poses: [mm] and Gibbs vectors, as `correction_between` returns them."""
    angle_deg = 2.0 * np.rad2deg(np.arctan(np.linalg.norm(change[:, 3:], axis=1)))
    return errors_of(np.linalg.norm(change[:, :3], axis=1), angle_deg)
