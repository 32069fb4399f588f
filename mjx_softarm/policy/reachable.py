"""Workspace test of a goal: its distance to poses that the simulated arm reached."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.mdp.rewards import RewardConfig, weighted_angles, weighted_position
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_frame, share_of_turn

_CHUNK = 256  # number of poses whose distances to all others are computed at once
_INSIDE = 0.99  # distance over the limit of a goal that was brought back into the workspace


class Reachable(NamedTuple):
    """Reachable poses, in the measure of the reward: millimetres and degrees by their weights."""

    pose: np.ndarray  # (m, 6) [mm, deg]
    position: np.ndarray  # (m, 3) weighted; (m, 9) with the angles, where their weights differ
    rotation: np.ndarray  # (m, 9)
    reward: RewardConfig
    limit: float  # largest distance of a pose to its nearest neighbour

    @classmethod
    def from_poses(cls, pose: np.ndarray, reward: RewardConfig) -> Reachable:
        """Compare poses (m, 6) [mm, deg] spread over the workspace, two thousand or more."""
        pose = np.asarray(pose, np.float64)
        position, flat = _weighted(reward, pose)
        found = cls(pose, position, flat, reward, 0.0)
        nearest = []
        for start in range(0, len(pose), _CHUNK):
            rows = np.arange(start, min(start + _CHUNK, len(pose)))
            distance = _distances(found, found.position[rows], flat[rows])  # (rows, m)
            distance[np.arange(len(rows)), rows] = np.inf
            nearest.append(distance.min(axis=1))
        return found._replace(limit=float(np.concatenate(nearest).max()))


def nearest(reachable: Reachable, goal: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the reachable pose (6,) [mm, deg] nearest to a goal (6,), and its distance over the limit."""
    distance = distances(reachable, np.asarray(goal, np.float64))
    index = int(np.argmin(distance))
    return reachable.pose[index], float(distance[index])


def distances(reachable: Reachable, goal: Array) -> Array:
    """Return the distances (m,) of a goal (6,) [mm, deg] to the reachable poses, over the limit."""
    return _distances(reachable, *_weighted(reachable.reward, goal[None]))[0] / reachable.limit


def clamped(reachable: Reachable, goal: np.ndarray) -> np.ndarray:
    """Return a goal (6,) [mm, deg] within the limit: itself, or on the way to it from the nearest pose."""
    goal = np.asarray(goal, np.float64)
    pose, away = nearest(reachable, goal)
    if away <= 1.0:
        return goal
    share = _INSIDE / away
    (from_m, from_rotation), (to_m, to_rotation) = frame_from_pose(pose), frame_from_pose(goal)
    rotation = share_of_turn(to_rotation @ from_rotation.T, np.array(share)) @ from_rotation
    return pose_from_frame(from_m + share * (to_m - from_m), rotation)


def _weighted(reward: RewardConfig, pose: Array) -> tuple[Array, Array]:
    """Return `Reachable.position` and `Reachable.rotation` of poses (k, 6) [mm, deg]."""
    position_m, rotation = frame_from_pose(pose)
    position = weighted_position(position_m, reward)
    if reward.turn_weight_per_deg is None:
        position = array_namespace(pose).concat([position, weighted_angles(rotation, reward)], axis=-1)
    return position, rotation.reshape(-1, 9)


def _distances(reachable: Reachable, position: Array, rotation: Array) -> Array:
    """Return distances (k, m) of `_weighted` positions and rotations to the poses, turns by their angle."""
    xp = array_namespace(position, rotation)
    squares = xp.sum(position**2, axis=1)[:, None] + np.sum(reachable.position**2, axis=1)
    away = xp.maximum(squares - 2.0 * position @ reachable.position.T, 0.0)
    if not reachable.reward.turn_weight_per_deg:
        return xp.sqrt(away)
    cos = xp.clip(0.5 * (rotation @ reachable.rotation.T - 1.0), -1.0, 1.0)
    return xp.sqrt(away + (reachable.reward.turn_weight_per_deg * xp.rad2deg(xp.acos(cos))) ** 2)
