"""The sim-to-real network against SciPy's rotations and hand-made networks."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_softarm._support.archive import SealedFileError
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_frame
from mjx_softarm.sensing.s2r import (
    apply_correction,
    carry_body,
    correct,
    correction_between,
    extrapolation,
    load_s2r,
    save_s2r,
)
from tests.networks import s2r_of

RNG = np.random.default_rng(0)
N_SPRINGS, N_IN = 9, 18


def poses(n, seed=0):
    """Poses over the workspace, every third of them in gimbal lock."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform([-180.0, -90.0, -180.0], [180.0, 90.0, 180.0], (n, 3))
    angles[::3, 1] = rng.choice([-90.0, 90.0], len(angles[::3]))
    return np.concatenate([rng.uniform(-300.0, 300.0, (n, 3)), angles], axis=1)


def springs(n, seed=0):
    return np.random.default_rng(seed).uniform(0.1, 0.25, (n, N_SPRINGS))


def network():
    """A random network."""
    rng = np.random.default_rng(0)
    layers = tuple(
        (rng.normal(size=(n_in, n_out)) / np.sqrt(n_in), rng.normal(size=n_out))
        for n_in, n_out in itertools.pairwise((N_IN, 32, 32, 6))
    )
    low, high = np.repeat([[-0.3, -1.0, 0.1], [0.3, 1.0, 0.25]], [3, 6, N_SPRINGS], axis=1)
    inputs = {"input_low": low, "input_high": high, "anchors": rng.uniform(-1.0, 1.0, (50, N_IN))}
    return jax.tree.map(np.float32, s2r_of(layers, np.repeat([20.0, 0.2], 3), **inputs, limit=0.5))


def test_correction_is_a_shift_and_a_turn_in_the_base_frame():
    start, axis, angle = poses(200), RNG.normal(size=(200, 3)), RNG.uniform(-2.0, 2.0, (200, 1))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    shift_mm = RNG.normal(0.0, 20.0, (200, 3))
    change = np.concatenate([shift_mm, axis * np.tan(angle / 2)], axis=1)
    start_m, start_axes = frame_from_pose(start)
    end_m, end_axes = frame_from_pose(pose_from_frame(*apply_correction((start_m, start_axes), change)))
    np.testing.assert_allclose(end_m, start_m + 1e-3 * shift_mm, atol=1e-12)
    turn = Rotation.from_rotvec(axis * angle).as_matrix()
    np.testing.assert_allclose(end_axes, turn @ start_axes, atol=1e-12)


def test_correction_between_two_poses_turns_one_into_the_other():
    start = poses(500, seed=1)
    turns = Rotation.random(500, random_state=2)
    turns = Rotation.from_rotvec(np.deg2rad(170.0) / np.pi * turns.as_rotvec())
    end = pose_from_frame(RNG.uniform(-0.3, 0.3, (500, 3)), turns.as_matrix() @ frame_from_pose(start)[1])
    reached = pose_from_frame(*apply_correction(frame_from_pose(start), correction_between(start, end)))
    for got, expected in zip(frame_from_pose(reached), frame_from_pose(end), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-9)
    half = np.array([0.0, 0.0, 0.0, 180.0, 0.0, 0.0])
    assert np.isfinite(correction_between(np.zeros(6), half)).all()


@pytest.mark.parametrize("yaw, pitch", [(180.0, 10.0), (0.0, 90.0), (0.0, -90.0)])
def test_correction_is_continuous_where_the_angles_jump(yaw, pitch):
    net, spring_m = network(), springs(1)[0]
    axes = Rotation.from_euler("ZYX", [yaw, pitch, 20.0], degrees=True)
    near = [axes * Rotation.from_rotvec([0.0, d, d]) for d in (-1e-5, 1e-5)]
    before, after = (correct(net, pose_from_frame(np.ones(3), r.as_matrix()), spring_m) for r in near)
    apart = correction_between(before, after)
    assert np.abs(apart[:3]).max() < 0.01 and np.abs(apart[3:]).max() < 1e-4


@pytest.mark.parametrize("size", [1.0, 10.0, 1e6])
def test_correction_stays_within_the_range_of_the_training_rows(size):
    net = network()
    net = net._replace(layers=(*net.layers[:-1], (100.0 * net.layers[-1][0], net.layers[-1][1])))
    rng = np.random.default_rng(3)
    pose, spring_m = size * rng.normal(0.0, 300.0, (500, 6)), size * rng.normal(0.0, 0.2, (500, N_SPRINGS))
    change = correction_between(pose, correct(net, pose, spring_m))
    assert (np.abs(change) <= net.output_high * (1.0 + 1e-5) + 1e-6 * size).all()
    assert (np.abs(change[:, :3]).max(axis=0) > 0.99 * net.output_high[:3]).all()  # it was tried


def test_extrapolation_is_the_distance_to_the_nearest_anchor():
    net, pose, spring_m = network(), poses(40), springs(40)
    position_m, axes = frame_from_pose(pose)
    x = np.concatenate([position_m, axes[:, :, 0], axes[:, :, 1], spring_m], axis=1)
    z = 2.0 * (x - net.input_low) / (net.input_high - net.input_low) - 1.0
    each = np.linalg.norm(z[:, None] - net.anchors, axis=-1) / np.sqrt(N_IN)
    np.testing.assert_allclose(extrapolation(net, pose, spring_m), each.min(axis=1) / 0.5, rtol=1e-6)
    on_row = net._replace(anchors=z[:1].astype(np.float32))
    assert extrapolation(on_row, pose[0], spring_m[0]) < 1e-6


@pytest.mark.parametrize("function", [correct, extrapolation])
def test_jax_traces_the_network_and_agrees_with_numpy(function):
    net, pose, spring_m = network(), poses(64).astype(np.float32), springs(64).astype(np.float32)
    pose[::3, 4] = 60.0  # in gimbal lock the angles, not the rotation, depend on the last bit
    expected = function(net, pose, spring_m)
    got = jax.jit(jax.vmap(function, in_axes=(None, 0, 0)))(jax.tree.map(jnp.asarray, net), pose, spring_m)
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=2e-3)
    closed_over = jax.jit(jax.vmap(lambda p, s: function(net, p, s)))(pose, spring_m)
    np.testing.assert_allclose(closed_over, expected, rtol=1e-3, atol=2e-3)


def test_file_gives_the_network_back(tmp_path):
    net = network()
    for name in ("a.npz", "b.npz"):
        save_s2r(tmp_path / name, net)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    jax.tree.map(np.testing.assert_array_equal, load_s2r(tmp_path / "a.npz", N_IN - 9), net)
    with pytest.raises(SealedFileError, match=rf"s2r.input_low: got float32 \({N_IN},\), expected"):
        load_s2r(tmp_path / "a.npz", N_IN - 12)


def test_a_base_that_is_askew_moves_each_plate_by_its_share_of_the_tip_s_way():
    n = 7
    position = np.outer(np.arange(n), [0.0, 0.0, -0.1])
    turn = Rotation.from_euler("x", 2.0, degrees=True).as_matrix()
    tip = pose_from_frame(turn @ position[-1], turn)
    moved, rotation = carry_body(position, np.tile(np.eye(3), (n, 1, 1)), tip)
    np.testing.assert_allclose(moved, position @ turn.T, atol=1e-9)
    np.testing.assert_allclose(rotation[-1], turn, atol=1e-9)
    np.testing.assert_array_equal(rotation[:-1], np.tile(np.eye(3), (n - 1, 1, 1)))
