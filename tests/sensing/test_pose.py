"""Poses against SciPy's rotations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_softarm.sensing.pose import (
    frame_from_pose,
    pose_error,
    pose_from_frame,
    pose_from_quaternion,
    quaternion_from_pose,
    share_of_turn,
)

pytestmark = pytest.mark.usefixtures("strict")

RNG = np.random.default_rng(0)
ROTATIONS = Rotation.random(500, random_state=1)
POSITIONS_M = RNG.uniform(-1.0, 1.0, (500, 3))


def angle_deg(a, b):
    """Angle of the rotation between two rotation matrices (..., 3, 3)."""
    return np.rad2deg(Rotation.from_matrix(np.swapaxes(a, -1, -2) @ b).magnitude())


def test_poses_of_frames_and_quaternions_are_scipy_s_intrinsic_zyx():
    """A quaternion has its scalar first, and its length does not matter."""
    expected = np.concatenate([1000.0 * POSITIONS_M, ROTATIONS.as_euler("ZYX", degrees=True)], axis=1)
    pose = pose_from_frame(POSITIONS_M, ROTATIONS.as_matrix())
    np.testing.assert_allclose(pose, expected, atol=1e-9)
    quaternion = ROTATIONS.as_quat(scalar_first=True) * RNG.uniform(0.9, 1.1, (500, 1))
    np.testing.assert_allclose(pose_from_quaternion(POSITIONS_M, quaternion), expected, atol=1e-9)


def test_frames_and_quaternions_of_poses_are_scipy_s_intrinsic_zyx():
    pose = np.concatenate([1000.0 * POSITIONS_M, RNG.uniform(-400.0, 400.0, (500, 3))], axis=-1)
    position_m, rotation = frame_from_pose(pose)
    np.testing.assert_allclose(position_m, POSITIONS_M)
    expected = Rotation.from_euler("ZYX", pose[:, 3:], degrees=True).as_matrix()
    np.testing.assert_allclose(rotation, expected, atol=1e-12)
    quaternion = Rotation.from_quat(quaternion_from_pose(pose), scalar_first=True)
    np.testing.assert_allclose(quaternion.as_matrix(), expected, atol=1e-12)
    again = pose_from_frame(position_m, rotation)  # with angles in their ranges
    np.testing.assert_allclose(frame_from_pose(again)[1], rotation, atol=1e-12)
    assert np.all(np.abs(again[:, 3:]) <= [180.0, 90.0, 180.0])


@pytest.mark.parametrize("pitch", [90.0, -90.0, 90.0 - 1e-7, 90.0 - 1e-4, -90.0 + 1e-4, 89.9, -89.9])
def test_rotation_survives_gimbal_lock_in_float32(pitch):
    yaw, roll = RNG.uniform(-180.0, 180.0, (2, 100))
    angles = np.stack([yaw, np.full(100, pitch), roll], axis=-1)
    rotation = np.float32(Rotation.from_euler("ZYX", angles, degrees=True).as_matrix())
    pose = jax.vmap(pose_from_frame)(jnp.zeros((100, 3)), jnp.asarray(rotation))
    assert np.isfinite(pose).all()
    assert np.abs(pose[:, 4] - pitch).max() < 1e-3
    _, back = jax.vmap(frame_from_pose)(pose)
    assert np.max(angle_deg(np.float64(rotation), np.float64(back))) < 1e-3


def test_gradients_are_finite_everywhere():
    angles = [(0, 90, 0), (0, -90, 0), (20, 90, 50), (180, 0, 0), (0, 0, 180), (0, 0, 0)]
    exact = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix().round(6)  # true zeros at the lock
    of_rotation = jax.vmap(jax.jacobian(pose_from_frame, argnums=1))
    jacobian = of_rotation(jnp.zeros((len(angles), 3)), jnp.asarray(np.float32(exact)))
    assert np.isfinite(jacobian).all()
    assert np.any(jacobian[:, 3], axis=(1, 2)).tolist() == [abs(pitch) != 90 for _, pitch, _ in angles]


def test_gradient_equals_the_difference_quotient():
    _, rotation = frame_from_pose(np.array([0.0, 0.0, 0.0, 40.0, -70.0, 110.0]))
    with jax.enable_x64(True):
        jacobian = jax.jacobian(pose_from_frame, argnums=1)(jnp.zeros(3), jnp.asarray(rotation))
    step = 1e-6
    changes = step * np.eye(9).reshape(3, 3, 3, 3)
    back, ahead = (pose_from_frame(np.zeros((3, 3, 3)), rotation + sign * changes) for sign in (-1, 1))
    np.testing.assert_allclose(np.moveaxis(jacobian, 0, 2), (ahead - back) / (2 * step), atol=1e-5)


def test_pose_error_wraps_angles_only():
    pose = np.array([400.0, 0.0, -600.0, 179.0, -170.0, 90.0])
    goal = np.array([0.0, 0.0, 0.0, -179.0, 170.0, -90.0])
    np.testing.assert_allclose(pose_error(pose, goal), [400.0, 0.0, -600.0, -2.0, 20.0, -180.0])
    np.testing.assert_allclose(pose_error(goal, pose)[3:], [2.0, -20.0, -180.0])
    turned = pose + [0.0, 0.0, 0.0, 360.0, -720.0, 1800.0]
    np.testing.assert_allclose(pose_error(turned, goal), pose_error(pose, goal))


def test_jax_gives_numpy_s_poses():
    position, rotation = np.float32(POSITIONS_M), np.float32(ROTATIONS.as_matrix())
    expected = pose_from_frame(position, rotation)
    pose = jax.jit(jax.vmap(pose_from_frame))(position, rotation)
    assert pose.dtype == expected.dtype == np.float32
    difference = pose_error(np.asarray(pose), expected)
    steep = np.abs(expected[:, 4]) > 85.0
    np.testing.assert_allclose(difference[~steep], 0.0, atol=1e-3)
    quaternion = np.float32(ROTATIONS.as_quat(scalar_first=True))
    difference = pose_error(jax.jit(jax.vmap(pose_from_quaternion))(position, quaternion), expected)
    np.testing.assert_allclose(difference[~steep], 0.0, atol=1e-3)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 40.0, 179.0, -100.0])
def test_share_of_a_turn_is_about_its_axis(angle_deg):
    axis = np.array([0.36, -0.48, 0.8])
    turn, third = (Rotation.from_rotvec(np.radians(part * angle_deg) * axis) for part in (1.0, 1 / 3))
    shares = share_of_turn(turn.as_matrix(), np.array([0.0, 1 / 3, 1.0]))
    np.testing.assert_allclose(shares, [np.eye(3), third.as_matrix(), turn.as_matrix()], atol=1e-9)
