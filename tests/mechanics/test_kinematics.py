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
from mjx_softarm.mechanics.kinematics import Frames, chain_kinematics, frames_of
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.params import ArmParams

TOLERANCE_M = 1e-6  # float32 at 0.7 m
MOUNTING = {
    "base_turn_deg": (20.0, -10.0, 5.0),
    "base_offset_m": (0.01, -0.02, 0.03),
    "tip_turn_deg": (-12.0, 15.0, 5.0),
    "tip_offset_m": (0.001, -0.002, 0.004),
}


@functools.cache
def arm(sections, links):
    structure = {"n_sections": sections, "links_per_section": links}
    return ArmSpec.default().replace(structure=structure, mounting=MOUNTING)


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
def chain(*structure):
    return jax.jit(jax.vmap(chain_kinematics(ArmParams.from_spec(arm(*structure)))))


@pytest.mark.parametrize("structure", [(3, 4), (2, 3), (1, 1)], ids=str)
def test_the_chain_is_where_c_mujoco_puts_it(structure):
    spec = arm(*structure)
    q, model = random_q(spec, 50), build_model(spec)
    with jax.numpy_dtype_promotion("strict"):
        frames = jax.device_get(chain(*structure)(q))
    assert all(field.dtype == np.float32 for field in frames)
    for k in range(len(q)):
        assert_same_frames([field[k] for field in frames], mujoco_frames(model, q[k]), f"arm {k}")
    turned = Rotation.from_rotvec(MOUNTING["base_turn_deg"], degrees=True).as_matrix()
    np.testing.assert_allclose(frames.plate_rotation[:, 0], np.resize(turned, (50, 3, 3)), atol=1e-6)


def test_arms_that_come_last_are_those_that_come_first():
    q = random_q(arm(1, 2), 3)  # as many arms as a vector has components
    kinematics = chain_kinematics(jax.tree.map(lambda x: x[..., None], ArmParams.from_spec(arm(1, 2))))
    last = jax.tree.map(lambda x: np.moveaxis(x, -1, 0), jax.jit(kinematics)(q.T))
    assert_same_frames(last, chain(1, 2)(q), "3 arms")


@pytest.mark.parametrize("links", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_mjx_has_the_frames_of_the_chain(links):
    q, model = random_q(arm(3, links), 64, seed=1), mjx.put_model(build_model(arm(3, links)))
    data = mjx.make_data(model)
    other = xla.jit(jax.vmap(lambda q: frames_of(model, mjx.kinematics(model, data.replace(qpos=q)))))(q)
    assert_same_frames(other, chain(3, links)(q), "64 arms")
