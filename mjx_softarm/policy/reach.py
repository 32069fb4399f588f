"""Nearest poses that an arm can take to goals, by the policy file's models of the arm.

The nearest pose to a goal is searched over the pressures between their limits: pressures give springs, these
the tip. Levenberg-Marquardt steps, from several starts at once; pressures at a limit that would leave it are
held there. Poses that the arm reaches in simulation are found to about 0.4 mm.

Source: Kanzow, Yamashita, Fukushima, "Levenberg-Marquardt methods with strong local convergence properties
for solving nonlinear equations with convex constraints", J. Comput. Appl. Math. 172, 2004.
"""

from __future__ import annotations

import numpy as np

from mjx_softarm.mdp.rewards import scaled_error
from mjx_softarm.policy.file import Policy
from mjx_softarm.sensing.estimator import estimate_frame, expected_springs
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_frame
from mjx_softarm.sensing.s2r import apply_correction, correction, inputs

N_STARTS, N_STEPS = 4, 20
_DIFFERENCE = 1e-3  # of the range of pressures
_EASE, _STIFFEN = 0.2, 8.0  # factors of the damping after a step that helped, and after one that did not


def nearest_poses(policy: Policy, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest poses (k, 6) [mm, deg] to goals (k, 6), and their weighted errors (k,)."""
    k, n = len(goal), policy.spec.n_chambers
    low, high = policy.gains.pressure_min_kpa, policy.gains.pressure_max_kpa
    target = np.repeat(_features(policy, *frame_from_pose(goal)), N_STARTS, axis=0)  # (rows, 12)

    def offset(x: np.ndarray) -> np.ndarray:
        at = _features(policy, *_tip(policy, low + (high - low) * x))
        return at - target.reshape(len(target), *[1] * (x.ndim - 2), 12)

    start = np.random.default_rng(0).uniform(0.2, 0.8, (N_STARTS, n))
    x = np.tile(start, (k, 1))  # (rows, n) pressures within their range
    error, damping = offset(x), np.full(len(x), 1e-3)
    for _ in range(N_STEPS):
        slope = (offset(x[:, None] + _DIFFERENCE * np.eye(n)) - error[:, None]) / _DIFFERENCE  # (rows, n, 12)
        gradient = np.einsum("rnm,rm->rn", slope, error)
        free = ~(((x <= 0.0) & (gradient > 0.0)) | ((x >= 1.0) & (gradient < 0.0)))
        slope, gradient = slope * free[..., None], gradient * free
        curvature = slope @ np.swapaxes(slope, 1, 2) + damping[:, None, None] * np.eye(n)
        tried = np.clip(x - np.linalg.solve(curvature, gradient[..., None])[..., 0], 0.0, 1.0)
        left = offset(tried)
        helped = np.sum(left**2, axis=1) < np.sum(error**2, axis=1)
        x, error = np.where(helped[:, None], tried, x), np.where(helped[:, None], left, error)
        damping = np.clip(damping * np.where(helped, _EASE, _STIFFEN), 1e-9, 1e3)
    best = np.argmin(np.sum(error**2, axis=1).reshape(k, N_STARTS), axis=1) + N_STARTS * np.arange(k)
    pose = pose_from_frame(*_tip(policy, low + (high - low) * x[best])).astype(float)
    return pose, np.linalg.norm(scaled_error(pose, goal, policy.reward), axis=1)


def _tip(policy: Policy, pressure_kpa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip's position (..., 3) [m] and axes (..., 3, 3) at pressures (..., n) [kPa]."""
    spring_m = expected_springs(policy.spring_model, pressure_kpa)
    frame = estimate_frame(policy.estimator, spring_m)
    if policy.s2r is None:
        return frame
    return apply_correction(frame, correction(policy.s2r, inputs(frame, spring_m)))


def _features(policy: Policy, position_m: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return 12 numbers (..., 12) whose differences are weighted errors, of a turn as its angle if small."""
    axes = axes / np.linalg.norm(axes, axis=-2, keepdims=True)
    turn = policy.reward.weight_per_deg * np.degrees(1.0) / np.sqrt(2.0) * axes
    position = 1e3 * policy.reward.weight_per_mm * position_m
    return np.concatenate([position, turn.reshape(*turn.shape[:-2], 9)], axis=-1, dtype=float)
