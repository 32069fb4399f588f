"""Poses of the arm's tip, in the convention of this project.

    pose (..., 6) = x, y, z [mm], yaw, pitch, roll [deg]

in the base frame, whose z axis points up: an arm hangs towards -z, unless its base is turned
(`mjx_softarm.posture`). The angles are intrinsic Z-Y-X, so the tip's axes are the columns of
R = Rz(yaw) Ry(pitch) Rx(roll), and all three are zero where the arm hangs straight. Yaw and roll lie in
[-180, 180], pitch in [-90, 90].

In gimbal lock (|pitch| = 90) yaw and roll turn about the same axis. There yaw is 0, its gradient is 0, and
roll takes the whole turn; the pose still gives the rotation back. Close by, yaw and roll and their gradients
change as fast as 1 / cos(pitch).
"""

from __future__ import annotations

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace

_LOCKED_COS = 1e-6  # cos(pitch) below this is gimbal lock

# A quaternion q turns a vector v into q v q*: the matrices of these two products, as indices of (q, -q).
_LEFT = np.array([[1, 0, 7, 2], [2, 3, 0, 5], [3, 6, 1, 0]])
_RIGHT = np.array([[1, 2, 3], [0, 7, 2], [3, 0, 5], [6, 1, 0]])


def pose_from_frame(position_m: Array, rotation: Array) -> Array:
    """Return the pose (..., 6) [mm, deg] of a frame with an origin (..., 3) [m] and axes (..., 3, 3)."""
    xp = array_namespace(position_m, rotation)
    rows = ([rotation[..., row, column] for column in range(3)] for row in range(3))
    (r00, r01, r02), (r10, r11, r12), (r20, _, _) = rows
    locked = r00**2 + r10**2 < _LOCKED_COS**2
    yaw = xp.atan2(xp.where(locked, 0.0, r10), xp.where(locked, 1.0, r00))
    # Without its yaw the rotation is Ry(pitch) Rx(roll), whose entries are never all zero.
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    pitch = xp.atan2(-r20, cos * r00 + sin * r10)
    roll = xp.atan2(sin * r02 - cos * r12, cos * r11 - sin * r01)
    angles_deg = xp.rad2deg(xp.stack([yaw, pitch, roll], axis=-1))
    return xp.concat([1000.0 * position_m, angles_deg], axis=-1)


def pose_from_quaternion(position_m: Array, quaternion: Array) -> Array:
    """Return the pose (..., 6) [mm, deg] of a frame with an origin (..., 3) [m], as from motion capture.

    A small error of the length of its quaternion (..., 4), w, x, y, z, does not matter.
    """
    return pose_from_frame(position_m, rotation_from_quaternion(quaternion))


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Return the matrix (..., 3, 3) of quaternions (..., 4) w, x, y, z; scales with their squared length."""
    xp = array_namespace(quaternion)
    signed = xp.concat([quaternion, -quaternion], axis=-1)  # (..., 8)
    return signed[..., _LEFT] @ signed[..., _RIGHT]


def quaternion_from_pose(pose: Array) -> Array:
    """Return the quaternion (..., 4) w, x, y, z of the angles of a pose (..., 6) [mm, deg]."""
    xp = array_namespace(pose)
    half = xp.deg2rad(0.5 * pose[..., 3:])
    (cy, cp, cr), (sy, sp, sr) = ([f(half[..., k]) for k in range(3)] for f in (xp.cos, xp.sin))
    w, x = cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr
    y, z = cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr
    return xp.stack([w, x, y, z], axis=-1)


def frame_from_pose(pose: Array) -> tuple[Array, Array]:
    """Return origin (..., 3) [m] and axes (..., 3, 3) of a pose (..., 6); inverse of `pose_from_frame`."""
    xp = array_namespace(pose)
    angles = xp.deg2rad(pose[..., 3:])
    (cy, cp, cr), (sy, sp, sr) = ([f(angles[..., k]) for k in range(3)] for f in (xp.cos, xp.sin))
    rows = (
        *(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        *(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        *(-sp, cp * sr, cp * cr),
    )
    return 0.001 * pose[..., :3], xp.stack(rows, axis=-1).reshape(*pose.shape[:-1], 3, 3)


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return the quaternions (..., 4) w, x, y, z of rotations (..., 3, 3). NumPy only."""
    return quaternion_from_pose(pose_from_frame(np.zeros(rotation.shape[:-1]), rotation))


def rotation_about(vector_rad: np.ndarray) -> np.ndarray:
    """Return the rotations (..., 3, 3) about vectors (..., 3) by their lengths [rad]. NumPy only."""
    half = 0.5 * np.linalg.norm(vector_rad, axis=-1, keepdims=True)
    sine = 0.5 * np.sinc(half / np.pi) * np.asarray(vector_rad, float)
    return rotation_from_quaternion(np.concatenate([np.cos(half), sine], axis=-1))


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,) [rad] of a rotation (3, 3); inverse of `rotation_about`."""
    w, *axis = quaternion_from_rotation(rotation)
    sine = np.linalg.norm(axis)
    angle = 2.0 * np.arctan2(sine, abs(w)) * np.sign(w)  # the shorter way round
    return angle / max(sine, np.finfo(float).tiny) * np.array(axis)


def share_of_turn(rotation: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return shares (...,) of a turn (3, 3), about its own axis: matrices (..., 3, 3). NumPy only."""
    return rotation_about(np.multiply.outer(share, rotation_vector(rotation)))


def pose_error(pose: Array, goal: Array) -> Array:
    """Return pose - goal, both (..., 6) [mm, deg], with angle differences wrapped into [-180, 180)."""
    xp = array_namespace(pose, goal)
    error = pose - goal
    angles = error[..., 3:]
    wrapped = angles - 360.0 * xp.floor((angles + 180.0) / 360.0)
    return xp.concat([error[..., :3], wrapped], axis=-1)


def seen_error(tip_m: np.ndarray, tip_quaternion: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the mean error (6,) [mm, deg] of the tips (k, 3) [m], (k, 4) that were seen; NaN if none was."""
    seen = np.isfinite(tip_m).all(axis=-1)
    if not seen.any():
        return np.full(6, np.nan)
    return pose_error(pose_from_quaternion(tip_m[seen], tip_quaternion[seen]), goal).mean(axis=0)
