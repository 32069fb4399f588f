"""The closed-form statics against C MuJoCo's forces, their slope, and its tendons."""

import functools

import jax
import mujoco
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.kinematics import ChainKinematics
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import RESIDUAL_TOLERANCE
from mjx_softarm.mechanics.statics import statics

STRUCTURES = [(3, 4), (2, 3), (1, 1)]


@pytest.fixture(autouse=True)
def _strict():
    with jax.numpy_dtype_promotion("strict"):
        yield


@functools.cache
def odd_arm(sections=3, links=4):
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
            "bonded_share": 0.4,
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
    found = statics(ChainKinematics(params.link_length_m)(q), q, pressure_kpa, params)
    return found, found.hessian.dense()


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


@pytest.mark.parametrize("structure", STRUCTURES, ids=str)
def test_the_gradient_is_minus_c_mujoco_s_force(structure):
    spec = odd_arm(*structure)
    for seed in range(10):
        q, pressure = random_state(spec, seed)
        force = pulled(mujoco_at(spec, q, pressure))
        gradient = solved(spec, q, pressure).gradient
        np.testing.assert_allclose(gradient, -force, atol=1e-9 * np.abs(force).max())


@pytest.mark.parametrize("structure", STRUCTURES, ids=str)
def test_the_hessian_is_the_slope_of_c_mujoco_s_force(structure):
    spec, step = odd_arm(*structure), 1e-6
    q, pressure = random_state(spec, 3)
    columns = []
    for direction in step * np.eye(len(q)):
        ahead = pulled(mujoco_at(spec, q + direction, pressure)).copy()
        behind = pulled(mujoco_at(spec, q - direction, pressure)).copy()
        columns.append((behind - ahead) / (2 * step))
    hessian = solved(spec, q, pressure).hessian
    np.testing.assert_allclose(hessian, np.array(columns).T, atol=1e-7 * np.abs(hessian).max())


def test_bonded_chambers_resist_links_that_bend_unlike_each_other_and_no_others():
    """The energy of a section of like links stays; that of a shape without sum grows by the links' own."""
    bonded, share, links = odd_arm(), 0.4, 4
    free = bonded.replace(chambers={"bonded_share": 0.0})
    rng, pressure_kpa = np.random.default_rng(0), np.zeros(9, np.float32)
    section, sign = 1e-3 * rng.normal(size=(3, 1, 3)), np.array([1.0, -1.0, -1.0, 1.0])[:, None]

    def change(shape):
        """By how much bonds raise q^T (gradient of q less that of none), twice the elastic energy."""
        q = np.broadcast_to(shape, (3, links, 3)).reshape(-1).astype(np.float32)
        of = [ArmParams.from_spec(spec) for spec in (free, bonded)]
        pulls = [_statics(x, pressure_kpa, p)[0].gradient for p in of for x in (q, 0 * q)]
        return float(q @ (pulls[2] - pulls[3]) - q @ (pulls[0] - pulls[1])), float(q @ (pulls[0] - pulls[1]))

    at_rest = [
        _statics(np.zeros(36, np.float32), pressure_kpa, ArmParams.from_spec(s))[0] for s in (free, bonded)
    ]
    np.testing.assert_allclose(at_rest[1].gradient, at_rest[0].gradient, atol=1e-4)  # by the rest lengths
    alike, size = change(section)
    assert abs(alike) < 0.01 * size
    least = np.reshape(free.chambers.stiffness_n_per_m, (3, 3)).min(axis=1)
    each = 3 * links * share * least[:, None] * [1.0, *2 * [free.geometry.chamber_radius_m**2 / 2]]
    assert change(section * sign)[0] == pytest.approx(links * (each * section[:, 0] ** 2).sum(), rel=0.01)


def test_single_precision_is_far_finer_than_what_counts_as_settled():
    spec = ArmSpec.default()
    for seed in range(20):
        q, pressure = random_state(spec, seed, bend_rad=0.3)
        q = np.float32(q)
        force = pulled(mujoco_at(spec, q, np.float32(pressure)))
        gradient = solved(spec, q, pressure, np.float32).gradient
        assert gradient.dtype == np.float32
        np.testing.assert_allclose(gradient, -force, atol=RESIDUAL_TOLERANCE / 5)
