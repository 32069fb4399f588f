"""The closed form of the estimator against curves integrated numerically, and NumPy against JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_softarm.sensing.estimator import (
    N_CHANGES,
    N_VARIABLES,
    Frame,
    PoseEstimator,
    SpringModel,
    chain,
    constant_curvature,
    estimate,
    estimate_frame,
    expected_springs,
)
from mjx_softarm.sensing.pose import frame_from_pose
from tests.linear_arm import LOAD, changed, even_estimator

N, RADIUS_M = 9, 0.067
ANGLE = np.radians(90.0) + 2 * np.pi * np.arange(N) / 3
SITE_M = RADIUS_M * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=-1).reshape(3, 3, 2)
STRAIGHT_M = np.full(N, 0.2, np.float32)


def springs_of(length_m, towards_rad, bend_rad):
    """Springs (3,) of one section that bends evenly: each is an arc at its own distance from the centre."""
    along_m = SITE_M[0] @ [np.cos(towards_rad), np.sin(towards_rad)]
    return length_m - bend_rad * along_m


def integrated(length_m, towards_rad, bend_rad, n=20_000):
    """The section's end, by following its centre line downwards in small steps."""
    axis = np.array([np.sin(towards_rad), -np.cos(towards_rad), 0.0])  # turns -z towards the direction
    middle = Rotation.from_rotvec(bend_rad * (np.arange(n)[:, None] + 0.5) / n * axis)
    return middle.apply([0, 0, -length_m]).mean(axis=0), Rotation.from_rotvec(bend_rad * axis).as_matrix()


def random_estimator(seed, dtype=np.float32):
    """An estimator with random polynomials, of variables beyond their range as well as in it."""
    even, rng = even_estimator(SITE_M), np.random.default_rng(seed)
    coefficient = rng.normal(size=even.coefficient.shape) * np.repeat([1e-4, 5e-4], 3)
    centre, scale = np.zeros(N_VARIABLES), np.ones(N_VARIABLES)
    centre[0], scale[:3] = 0.2, [0.03, 0.5, 0.5]
    each = {"variable_centre": np.tile(centre, (3, 1)), "variable_scale": np.tile(scale, (3, 1))}
    estimator = even._replace(coefficient=coefficient, **each)
    return PoseEstimator(*(np.asarray(value, dtype) for value in estimator))


@pytest.mark.parametrize("bend_rad", [0.0, 1e-5, 3e-3, 0.4, 1.7])
@pytest.mark.parametrize("towards_rad", [0.0, 2.2, -1.0])
def test_section_of_constant_curvature(bend_rad, towards_rad):
    spring_m = np.concatenate([springs_of(0.19, towards_rad, bend_rad), [0.2] * 6])
    section = constant_curvature(SITE_M, spring_m)
    position_m, rotation = integrated(0.19, towards_rad, bend_rad)
    np.testing.assert_allclose(section.position_m[0], position_m, atol=1e-9)
    np.testing.assert_allclose(section.rotation[0], rotation, atol=1e-9)
    np.testing.assert_allclose(section.position_m[1:], [[0, 0, -0.2]] * 2, atol=1e-12)


@pytest.mark.parametrize("n_springs", [3, 4, 6])
def test_springs_give_a_section_by_least_squares(n_springs):
    """A plane through noisy lengths, solved by NumPy; sections of other radii and angles."""
    rng = np.random.default_rng(n_springs)
    radius_m, first_rad = np.array([0.075, 0.05]), np.array([1.5, -0.4])
    angle = first_rad[:, None] + 2 * np.pi * np.arange(n_springs) / n_springs
    site_m = radius_m[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    spring_m = 0.2 + 0.03 * rng.normal(size=(2, n_springs))
    got = constant_curvature(site_m, spring_m.ravel())
    for section in range(2):
        plane = np.column_stack([np.ones(n_springs), -site_m[section]])
        length_m, *bend = np.linalg.lstsq(plane, spring_m[section], rcond=None)[0]
        position_m, rotation = integrated(length_m, np.arctan2(bend[1], bend[0]), np.hypot(*bend))
        np.testing.assert_allclose(got.position_m[section], position_m, atol=1e-8)
        np.testing.assert_allclose(got.rotation[section], rotation, atol=1e-8)


def test_sections_follow_one_another():
    shapes = [(0.15, 0.3, 0.9), (0.22, -2.0, 1.4), (0.2, 1.9, 0.6)]
    even = constant_curvature(SITE_M, np.concatenate([springs_of(*shape) for shape in shapes]))
    position_m, rotation = np.zeros(3), np.eye(3)
    for shape in shapes:
        end_m, turn = integrated(*shape)
        position_m, rotation = position_m + rotation @ end_m, rotation @ turn
    plate = chain(even)
    np.testing.assert_allclose(plate.position_m, position_m, atol=1e-8)
    np.testing.assert_allclose(plate.rotation, rotation, atol=1e-8)


def test_changes_move_and_turn_the_section_ends():
    """Constant changes and one by payload: position added, Gibbs vector as a rotation on the left."""
    rng = np.random.default_rng(0)
    changes = rng.normal(size=(3, N_CHANGES)) * np.repeat([0.01, 0.2], 3)
    estimator = PoseEstimator(*(np.asarray(value, np.float64) for value in even_estimator(SITE_M)))
    estimator = changed(changed(estimator, 0.3 * changes), 0.5 * changes, (LOAD,))
    mounting = {"tip_offset_m": rng.normal(size=3), "base_position_m": rng.normal(size=3)}
    turns = Rotation.from_euler("xyz", rng.normal(size=(2, 3))).as_matrix()
    estimator = estimator._replace(**mounting, tip_rotation=turns[0], base_rotation=turns[1])
    spring_m = 0.2 + 0.03 * rng.normal(size=N)
    even = constant_curvature(SITE_M, spring_m)
    angle = 2 * np.arctan(np.linalg.norm(changes[:, 3:], axis=1))
    axis = changes[:, 3:] / np.linalg.norm(changes[:, 3:], axis=1, keepdims=True)
    turn = Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
    expected = chain(Frame(even.position_m + changes[:, :3], turn @ even.rotation))
    got = estimate_frame(estimator, spring_m, 1.4)
    plate_m = expected.position_m + expected.rotation @ mounting["tip_offset_m"]
    np.testing.assert_allclose(got.position_m, mounting["base_position_m"] + turns[1] @ plate_m, atol=1e-12)
    np.testing.assert_allclose(got.rotation, turns[1] @ expected.rotation @ turns[0], atol=1e-12)
    np.testing.assert_allclose(got.rotation @ got.rotation.T, np.eye(3), atol=1e-12)


def test_numpy_and_jax_agree_and_batches_are_rows():
    estimator, rng = random_estimator(1), np.random.default_rng(1)
    spring_m = (0.2 + 0.03 * rng.normal(size=(2, 50, N))).astype(np.float32)
    load_kg = np.float32([[0.0], [1.0]])
    pose = estimate(estimator, spring_m, load_kg)
    assert pose.shape == (2, 50, 6) and pose.dtype == np.float32
    in_jax = jax.jit(estimate)(jax.tree.map(jnp.asarray, estimator), jnp.asarray(spring_m), load_kg)
    same = [frame_from_pose(np.asarray(x, float)) for x in (pose, in_jax)]  # angles may differ in gimbal lock
    for one, other in zip(*same, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-5)
    np.testing.assert_allclose(estimate(estimator, spring_m[1, 7], 1.0), pose[1, 7], atol=2e-2)
    one = estimate_frame(estimator, spring_m[1, 7], 1.0)
    np.testing.assert_allclose(one.rotation, same[0][1][1, 7], atol=1e-5)
    assert estimate(estimator, spring_m.astype(np.float64), 0.5).dtype == np.float32


def test_straight_arm_has_a_slope():
    slope = jax.jit(jax.jacobian(lambda s: estimate_frame(random_estimator(2), s, 0.0).position_m))(
        jnp.asarray(STRAIGHT_M)
    )
    step = 1e-4 * np.eye(N)
    double = random_estimator(2, dtype=np.float64)
    ahead, back = (estimate_frame(double, STRAIGHT_M + sign * step, 0.0).position_m for sign in (1, -1))
    np.testing.assert_allclose(slope, (ahead - back).T / 2e-4, atol=2e-2)
    assert np.abs(slope).max() > 0.5


@pytest.mark.parametrize("n_chambers", [9, 18])
def test_expected_springs_by_hand(n_chambers):
    """Spring k takes k + 1 times the pressure of its chamber, the first of one or two."""
    weight = np.zeros((n_chambers, N), np.float32)
    weight[:: n_chambers // N] = np.diag(np.arange(1.0, 10.0))
    one, each = np.ones(N, np.float32), np.ones(n_chambers, np.float32)
    model = SpringModel(((weight, 0.5 * one),), -10 * each, 30 * each, 0.2 * one, 0.01 * one)
    got = expected_springs(model, np.full((4, n_chambers), 20.0))
    np.testing.assert_allclose(got, np.tile(0.2 + 0.01 * (np.arange(1.0, 10.0) + 0.5), (4, 1)), rtol=1e-6)
