"""The closed-form statics against C MuJoCo's forces, their slope, and its tendons."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import RESIDUAL_TOLERANCE
from mjx_softarm.mechanics.statics import statics

ODD_ARMS = [(3, 4, 0.4), (3, 4, 1.0), (2, 3, 1.5), (2, 3, -0.1), (1, 1, 0.4)]  # sections, links, bonded share


@pytest.fixture(autouse=True)
def _strict():
    with jax.numpy_dtype_promotion("strict"):
        yield


@functools.cache
def odd_arm(sections=3, links=4, share=0.4):
    """An arm in which no two chambers are alike, so that no two can be mistaken for each other."""
    n = 3 * sections
    rng = np.random.default_rng(7)

    def spread(middle):
        return tuple(middle * rng.uniform(0.8, 1.2, n))

    return ArmSpec.default().replace(
        structure={"n_sections": sections, "links_per_section": links},
        geometry={"first_chamber_deg": 17.0},
        mass={"payload_kg": 0.3},
        chambers={
            "area_m2": spread(1.62e-3),
            "area_slope_m": spread(-4.06e-3),
            "stiffness_n_per_m": spread(506.7),
            "length_offset_m": tuple(rng.uniform(-0.01, 0.01, n)),
            "bonded_share": share,
        },
    )


def random_state(spec, seed, bend_rad=0.5):
    """Joint coordinates (nv,) and pressures (n_chambers,) of a crooked arm."""
    rng = np.random.default_rng(seed)
    half = spec.link_length_m.max() / 2
    q = rng.uniform([-half, -bend_rad, -bend_rad], [half, bend_rad, bend_rad], (spec.n_links, 3))
    return q.ravel(), rng.uniform(-40.0, 20.0, spec.n_chambers)


@jax.jit
def _statics(q, pressure_kpa, params):
    found = statics(chain_kinematics(params)(q), q, pressure_kpa, params)
    return found, jax.vmap(found.hessian.times)(jnp.eye(len(q), dtype=q.dtype))


def solved(spec, q, pressure_kpa, dtype=np.float64):
    """`statics` of one arm, as NumPy arrays, the Hessian a plain matrix."""
    params = ArmParams.from_spec(spec, dtype)
    with jax.enable_x64(dtype == np.float64):
        found, hessian = jax.device_get(_statics(dtype(q), dtype(pressure_kpa), params))
    return found._replace(hessian=hessian)


@functools.cache
def compiled(spec):
    model = build_model(spec)
    return model, mujoco.MjData(model)


def mujoco_at(spec, q, pressure_kpa):
    """C MuJoCo's data of an arm that stands still."""
    model, data = compiled(spec)
    data.qpos[:], data.ctrl[:] = q, pressure_kpa
    data.qvel[:] = 0.0
    mujoco.mj_forward(model, data)
    return data


def pulled(data):
    """Generalised force on the standing arm: springs and chambers, less its weight."""
    return data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias


@pytest.mark.parametrize("odd", ODD_ARMS, ids=str)
def test_the_gradient_is_minus_c_mujoco_s_force(odd):
    spec = odd_arm(*odd)
    for seed in range(10):
        q, pressure = random_state(spec, seed)
        force = pulled(mujoco_at(spec, q, pressure))
        gradient = solved(spec, q, pressure).gradient
        np.testing.assert_allclose(gradient, -force, atol=1e-9 * np.abs(force).max())


@pytest.mark.parametrize("odd", ODD_ARMS, ids=str)
def test_the_hessian_is_the_slope_of_c_mujoco_s_force(odd):
    spec, step = odd_arm(*odd), 1e-6
    q, pressure = random_state(spec, 3)
    columns = []
    for direction in step * np.eye(len(q)):
        ahead = pulled(mujoco_at(spec, q + direction, pressure)).copy()
        behind = pulled(mujoco_at(spec, q - direction, pressure)).copy()
        columns.append((behind - ahead) / (2 * step))
    hessian = solved(spec, q, pressure).hessian
    np.testing.assert_allclose(hessian, np.array(columns).T, atol=1e-7 * np.abs(hessian).max())


def test_bonds_are_pieces_of_their_chambers():
    """Each of four pieces is four times as stiff, and a quarter as long."""
    spec = odd_arm(share=0.4)
    model, stiffness = compiled(spec)[0], np.array(spec.chambers.stiffness_n_per_m)
    rest_m = 0.2 + np.array(spec.chambers.length_offset_m)
    np.testing.assert_allclose(model.tendon_stiffness[:9], 0.6 * stiffness)
    np.testing.assert_allclose(model.tendon_stiffness[18:], np.repeat(4 * 0.4 * stiffness, 4))
    np.testing.assert_allclose(model.tendon_lengthspring[18:, 0], np.repeat(rest_m / 4, 4))


def test_single_precision_is_far_finer_than_what_counts_as_settled():
    spec = ArmSpec.default()
    for seed in range(20):
        q, pressure = random_state(spec, seed, bend_rad=0.3)
        q = np.float32(q)
        force = pulled(mujoco_at(spec, q, np.float32(pressure)))
        gradient = solved(spec, q, pressure, np.float32).gradient
        assert gradient.dtype == np.float32
        np.testing.assert_allclose(gradient, -force, atol=RESIDUAL_TOLERANCE / 5)
