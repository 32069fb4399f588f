"""Test of whether a goal lies within the workspace, by poses that the simulated arm reached."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.sensing.pose import frame_from_pose

_CHUNK = 256  # poses whose distances to all others are computed at once


class Reachable(NamedTuple):
    """Reachable poses, in the measure of the reward: millimetres and degrees by their weights."""

    pose: np.ndarray  # (m, 6) [mm, deg]
    position: np.ndarray  # (m, 3) weighted
    rotation: np.ndarray  # (m, 9)
    weight_per_deg: float
    limit: float  # no pose is further from the nearest other one

    @classmethod
    def from_poses(cls, pose: np.ndarray, reward: RewardConfig) -> Reachable:
        """Make it from poses (m, 6) [mm, deg] spread over the workspace, two thousand or more."""
        pose = np.asarray(pose, np.float64)
        position_m, rotation = frame_from_pose(pose)
        flat = rotation.reshape(len(pose), 9)
        found = cls(pose, 1e3 * reward.weight_per_mm * position_m, flat, reward.weight_per_deg, 0.0)
        nearest = []
        for start in range(0, len(pose), _CHUNK):
            rows = np.arange(start, min(start + _CHUNK, len(pose)))
            distance = _distances(found, found.position[rows], flat[rows])  # (rows, m)
            distance[np.arange(len(rows)), rows] = np.inf
            nearest.append(distance.min(axis=1))
        return found._replace(limit=float(np.concatenate(nearest).max()))


def nearest(reachable: Reachable, goal: np.ndarray, reward: RewardConfig) -> tuple[np.ndarray, float]:
    """Return the reachable pose (6,) [mm, deg] nearest to a goal (6,), and its distance over the limit."""
    position_m, rotation = frame_from_pose(np.asarray(goal, np.float64))
    position = 1e3 * reward.weight_per_mm * position_m
    distance = _distances(reachable, position[None], rotation.reshape(1, 9))[0]  # (m,)
    index = int(np.argmin(distance))
    return reachable.pose[index], float(distance[index] / reachable.limit)


def _distances(reachable: Reachable, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return distances (k, m) of positions (k, 3) and rotations (k, 9) to the poses, turns by their angle."""
    squares = np.sum(position**2, axis=1)[:, None] + np.sum(reachable.position**2, axis=1)
    away = np.maximum(squares - 2.0 * position @ reachable.position.T, 0.0)
    cos = np.clip(0.5 * (rotation @ reachable.rotation.T - 1.0), -1.0, 1.0)
    return np.sqrt(away + (reachable.weight_per_deg * np.degrees(np.arccos(cos))) ** 2)
