"""Reachability of goals: by the nearest stored pose, within a tick; by a search with the policy's models.

Stored poses lie some 15 mm apart. The search is sharper, and takes longer than a tick. It runs over the
pressures between their limits: pressures give spring lengths, spring lengths give the tip pose. It takes
Levenberg-Marquardt steps from several starts at once, and holds a pressure at its limit if a step would leave
the range. Poses that the arm reaches in simulation are reached to about 0.4 mm.
`begin`, `improve` and `nearest_of` take NumPy arrays and the symbols of `mjx_softarm.export`.

Source: Kanzow, Yamashita, Fukushima, "Levenberg-Marquardt methods with strong local convergence properties
for solving nonlinear equations with convex constraints", J. Comput. Appl. Math. 172, 2004.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace, solve
from mjx_softarm.control import at_chambers, planes
from mjx_softarm.mdp.rewards import RewardConfig, weighted_angles, weighted_error, weighted_position
from mjx_softarm.policy.file import Policy
from mjx_softarm.sensing.estimator import estimate_frame, expected_springs
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_frame, share_of_turn
from mjx_softarm.sensing.s2r import corrected

N_STARTS = 4
N_STEPS = 20
_DIFFERENCE = 1e-3  # step of the finite differences, as a share of the range of pressures
_EASE = 0.2
_STIFFEN = 8.0  # factors of the damping after a step that helped, and after a step that did not
_LEAST_DAMPING = 1e-6
_FIRST_DAMPING = 1e-3
_MOST_DAMPING = 1e3
_CHUNK = 256  # number of poses whose distances to all others are computed at once
_INSIDE = 0.99  # distance over the limit of a goal that was brought back into the workspace
_STAYING = 1e-4  # weight of a chamber that does not follow; chambers that follow have 1


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
        poses = cls(pose, position, flat, reward, 0.0)
        nearest = []
        for rows in np.split(np.arange(len(pose)), range(_CHUNK, len(pose), _CHUNK)):
            distance = _distances(poses, poses.position[rows], flat[rows])  # (rows, m)
            distance[np.arange(len(rows)), rows] = np.inf
            nearest.append(distance.min(axis=1))
        return poses._replace(limit=float(np.concatenate(nearest).max()))


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


def nearest_poses(policy: Policy, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest poses (k, 6) [mm, deg] to goals (k, 6), and their weighted errors (k,)."""
    goal = np.asarray(goal, float)
    search = begin(policy, len(goal))
    for _ in range(N_STEPS):
        search = improve(policy, goal, search)
    return nearest_of(policy, goal, search)


def begin(policy: Policy, k: int) -> np.ndarray:
    """Return the start of a search for k goals (k * N_STARTS, n + 1): shares of the pressures, damping."""
    start = np.random.default_rng(0).uniform(0.2, 0.8, (N_STARTS, policy.spec.n_chambers))
    return np.tile(np.concat([start, np.full((N_STARTS, 1), _FIRST_DAMPING)], axis=1), (k, 1))


def improve(policy: Policy, goal: Array, search: Array) -> Array:
    """Take one Levenberg-Marquardt step of a search (k * N_STARTS, n + 1) towards goals (k, 6) [mm, deg]."""
    # Error of each row and its slope by finite differences.
    xp = array_namespace(goal, search)
    n = policy.spec.n_chambers
    share, damping = search[:, :n], search[:, n]
    target = _target(policy, goal)  # (rows, f)
    error = _features(policy, *_tip(policy, share)) - target
    beside = _features(policy, *_tip(policy, share[:, None] + _DIFFERENCE * np.eye(n)))  # (rows, n, f)
    beside = beside - target[:, None]
    slope = (beside - error[:, None]) / _DIFFERENCE
    gradient = xp.sum(slope * error[:, None], axis=-1)  # (rows, n)
    # Pressures at a limit that would leave their range do not move.
    free = ~(((share <= 0.0) & (gradient > 0.0)) | ((share >= 1.0) & (gradient < 0.0)))
    slope, gradient = xp.where(free[..., None], slope, 0.0), xp.where(free, gradient, 0.0)
    # Take the step where it helps; else only raise the damping.
    curvature = slope @ xp.swapaxes(slope, 1, 2) + damping[:, None, None] * np.eye(n)
    tried = xp.clip(share - solve(curvature, gradient), 0.0, 1.0)
    left = _features(policy, *_tip(policy, tried)) - target
    helped = xp.sum(left**2, axis=-1) < xp.sum(error**2, axis=-1)
    damping = xp.clip(damping * xp.where(helped, _EASE, _STIFFEN), _LEAST_DAMPING, _MOST_DAMPING)
    return xp.concat([xp.where(helped[:, None], tried, share), damping[:, None]], axis=1)


def nearest_of(policy: Policy, goal: Array, search: Array) -> tuple[Array, Array]:
    """Return a search's nearest poses (k, 6) [mm, deg] to goals (k, 6), and their weighted errors (k,)."""
    xp = array_namespace(goal, search)
    share = search[:, : policy.spec.n_chambers]
    tip = _tip(policy, share)
    error = _features(policy, *tip) - _target(policy, goal)
    square = xp.sum(error**2, axis=-1).reshape(-1, N_STARTS)
    pose = pose_from_frame(*tip).reshape(-1, N_STARTS, 6)
    best, least = pose[:, 0], square[:, 0]
    for start in range(1, N_STARTS):
        better = square[:, start] < least
        best = xp.where(better[:, None], pose[:, start], best)
        least = xp.where(better, square[:, start], least)
    return best, weighted_error(best, goal, policy.reward)


def _tip(policy: Policy, share: Array) -> tuple[Array, Array]:
    """Return the tip's position (..., 3) [m] and axes (..., 3, 3) at shares (..., n) of the pressures."""
    low, high = policy.gains.pressure_min_kpa, policy.gains.pressure_max_kpa
    spring_m = expected_springs(policy.spring_model, low + (high - low) * share)
    frame = estimate_frame(policy.estimator, spring_m, policy.spec.mass.payload_kg)
    if policy.s2r is None:
        return frame
    return corrected(policy.s2r, frame, spring_m)


def _target(policy: Policy, goal: Array) -> Array:
    """Return the `_features` (k * N_STARTS, f) of goals (k, 6), each repeated for its starts."""
    return _features(policy, *frame_from_pose(goal))[np.repeat(np.arange(len(goal)), N_STARTS)]


def _features(policy: Policy, position_m: Array, axes: Array) -> Array:
    """Return numbers (..., f) of poses; the norm of a difference is the weighted error, for small turns."""
    xp = array_namespace(position_m, axes)
    position = weighted_position(position_m, policy.reward)
    weight = policy.reward.turn_weight_per_deg
    axes = axes / xp.sqrt(xp.sum(axes**2, axis=-2))[..., None, :]
    if weight is None:
        return xp.concat([position, weighted_angles(axes, policy.reward)], axis=-1)
    turn = weight * np.degrees(1.0) / np.sqrt(2.0) * axes
    return xp.concat([position, turn.reshape(*turn.shape[:-2], 9)], axis=-1)


def followed(reference_m: Array, mean_m: Array, asked_m: Array, saturated: Array, policy: Policy) -> Array:
    """Return the lengths (n_springs,) [m] that an arm at rest takes for new references. NumPy and symbols.

    Saturated chambers that are asked for more do not follow: their springs keep their lengths. With redundant
    chambers, each section takes the plane that fits the chambers which follow; the others only decide what
    these leave open.

    Args:
        reference_m (n_springs,) [m]: new references.
        mean_m (n_springs,) [m]: lengths at rest on the last references.
        asked_m (n_springs,) [m]: the last references.
        saturated (n_chambers,): bool.
    """
    # Motion and error of each chamber
    xp = array_namespace(reference_m, mean_m)
    allocation = policy.gains.allocation
    move_m = at_chambers(reference_m - mean_m, allocation)
    stays = saturated & (move_m * at_chambers(asked_m - mean_m, allocation) > 0.0)
    if allocation is None:
        return xp.where(stays, mean_m, reference_m)

    # Planes by weighted least squares, at the springs
    n_sections = policy.spec.structure.n_sections
    n = policy.spec.structure.chambers_per_section
    weight = xp.where(stays, _STAYING, 1.0).reshape(n_sections, 1, n)
    across = planes(n).T
    along_m = xp.where(stays, 0.0, move_m).reshape(n_sections, 1, n)
    normal = xp.sum((weight * across)[:, :, None] * across, axis=-1)  # (n_sections, 3, 3)
    plane = solve(normal, xp.sum(weight * across * along_m, axis=-1))  # (n_sections, 3)
    return mean_m + xp.sum(plane[:, None] * planes(policy.spec.springs_per_section), axis=-1).reshape(-1)
