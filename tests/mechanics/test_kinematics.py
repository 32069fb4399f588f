"""Both engines place plates and joints where C MuJoCo does; by hand where that is possible."""

import functools

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_softarm import ArmSpec
from mjx_softarm._support import xla
from mjx_softarm._support.lazy import mjx
from mjx_softarm.mechanics.kinematics import ChainKinematics, Frames, chain_kinematics, frames_of
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.workspace import settle_many

STRUCTURES = [(3, 4), (2, 3), (1, 1)]
TOLERANCE_M = 1e-6  # float32 at 0.7 m


@functools.cache
def arm(sections=3, links=4):
    structure = {"n_sections": sections, "links_per_section": links}
    return ArmSpec.default().replace(structure=structure)


@functools.cache
def compiled(sections=3, links=4):
    return build_model(arm(sections, links))


def random_q(spec, n, seed=0, bend_rad=0.8):
    """Joint coordinates of arms far more crooked than any that pressure makes: up to 45 deg a hinge."""
    rng = np.random.default_rng(seed)
    half = spec.link_length_m.max() / 2
    q = rng.uniform([-half, -bend_rad, -bend_rad], [half, bend_rad, bend_rad], (n, spec.n_links, 3))
    return np.float32(q.reshape(n, -1))


def mujoco_frames(model, q):
    """The frames that C MuJoCo computes: rings, hinges and slides, by name."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    n_links = len(q) // 3
    rings = [data.geom(f"ring{k}") for k in range(n_links + 1)]
    kinds = ("slide", "bend_x", "bend_y"), ("slide", "bend_y", "bend_x")  # y comes first in each second link
    joints = [[data.joint(f"{kind}{k}") for kind in kinds[k % 2]] for k in range(n_links)]
    return Frames(
        plate_position=np.array([ring.xpos for ring in rings]),
        plate_rotation=np.array([ring.xmat.reshape(3, 3) for ring in rings]),
        axis=np.array([[joint.xaxis for joint in link] for link in joints]),
        anchor=np.array([link[1].xanchor for link in joints]),
        tip_position=data.site("tip").xpos,
        tip_rotation=data.site("tip").xmat.reshape(3, 3),
    )


def assert_same_frames(got, expected, case):
    for name, a, b in zip(Frames._fields, got, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=TOLERANCE_M, err_msg=f"{name} of {case}")


@functools.cache
def chain(sections=3, links=4):
    length = arm(sections, links).link_length_m
    return jax.jit(jax.vmap(ChainKinematics(length)))


@pytest.mark.parametrize("structure", STRUCTURES, ids=str)
def test_the_chain_is_where_c_mujoco_puts_it(structure):
    spec, model = arm(*structure), compiled(*structure)
    q = random_q(spec, 50)
    with jax.numpy_dtype_promotion("strict"):
        frames = jax.device_get(chain(*structure)(q))
    assert all(field.dtype == np.float32 for field in frames)
    for k in range(len(q)):
        assert_same_frames([field[k] for field in frames], mujoco_frames(model, q[k]), f"arm {k}")


def test_arms_that_come_last_are_those_that_come_first():
    q = random_q(arm(1, 2), 3)  # as many arms as a vector has components
    kinematics = ChainKinematics(arm(1, 2).link_length_m[:, None])
    last = jax.tree.map(lambda x: np.moveaxis(x, -1, 0), jax.jit(kinematics)(q.T))
    assert_same_frames(last, chain(1, 2)(q), "3 arms")


MOUNTING = {
    "base_turn_deg": (20.0, -10.0, 5.0),
    "base_offset_m": (0.01, -0.02, 0.03),
    "section_roll_deg": (3.0, -2.0, 4.0),
    "tip_turn_deg": (-12.0, 15.0, 5.0),
    "tip_offset_m": (0.001, -0.002, 0.004),
}


@pytest.mark.parametrize("links", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_both_engines_agree_and_mount_base_and_tip_alike(links):
    mounted = arm(3, links).replace(mounting=MOUNTING)
    q = random_q(mounted, 64, seed=1)
    frames = jax.device_get(jax.jit(jax.vmap(chain_kinematics(ArmParams.from_spec(mounted))))(q))
    model = mjx.put_model(build_model(mounted))
    data = mjx.make_data(model)
    other = xla.jit(jax.vmap(lambda q: frames_of(model, mjx.kinematics(model, data.replace(qpos=q)))))(q)
    assert_same_frames(other, frames, "64 arms")
    turned = Rotation.from_rotvec([20.0, -10.0, 5.0], degrees=True).as_matrix()
    np.testing.assert_allclose(frames.plate_rotation[:, 0], np.resize(turned, (64, 3, 3)), atol=1e-6)
    expected = np.array(MOUNTING["base_offset_m"]) + chain(3, links)(q).plate_position @ turned.T
    np.testing.assert_allclose(frames.plate_position, expected, atol=1e-6)


def test_a_tilted_arm_at_rest_is_at_rest_in_mujoco():
    """Gravity, holes and plates of both descriptions of a tilted, rolled arm: no force is left."""
    mounted = arm().replace(mounting=MOUNTING)
    pressure_kpa = np.array([[-12.0, 3, -20, -5, -30, 4, 2, -9, -14]])
    found = settle_many(mounted, pressure_kpa)
    model = build_model(mounted)
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = found.q[0], pressure_kpa[0]
    mujoco.mj_forward(model, data)
    left = data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias
    assert np.abs(left).max() < 5e-3
    np.testing.assert_allclose(data.site("tip").xpos, found.tip_position_m[0], atol=1e-5)
    np.testing.assert_allclose(data.site("tip").xmat.reshape(3, 3), found.tip_rotation[0], atol=1e-5)
