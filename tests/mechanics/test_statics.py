"""The closed-form statics against C MuJoCo's forces and against automatic differentiation of the energy."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import linalg, sparse

from mjx_softarm import ArmSpec
from mjx_softarm._support import xla
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
        },
    )


def random_state(spec, seed, bend_rad=0.5):
    """Joint coordinates (nv,) and pressures (n_chambers,) of a crooked arm."""
    rng = np.random.default_rng(seed)
    half = spec.link_length_m / 2
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


@pytest.mark.parametrize("structure", STRUCTURES, ids=str)
def test_tendon_lengths_and_jacobians_are_c_mujoco_s(structure):
    spec = odd_arm(*structure)
    model, _ = compiled(spec)
    for seed in range(5):
        q, pressure = random_state(spec, seed)
        data = mujoco_at(spec, q, pressure)
        starts = np.append(model.ten_J_rowadr, model.ten_J_rowadr[-1] + model.ten_J_rownnz[-1])
        shape = (model.ntendon, model.nv)
        jacobian = sparse.csr_array((data.ten_J, model.ten_J_colind, starts), shape).toarray()
        found = solved(spec, q, pressure)
        for k, lines in enumerate((found.chambers, found.springs)):
            np.testing.assert_allclose(lines.length, data.ten_length[k::2], atol=1e-12)
            np.testing.assert_allclose(linalg.block_diag(*lines.jacobian), jacobian[k::2], atol=1e-12)


def test_single_precision_is_far_finer_than_what_counts_as_settled():
    spec = ArmSpec.default()
    for seed in range(20):
        q, pressure = random_state(spec, seed, bend_rad=0.3)
        q = np.float32(q)
        force = pulled(mujoco_at(spec, q, np.float32(pressure)))
        gradient = solved(spec, q, pressure, np.float32).gradient
        assert gradient.dtype == np.float32
        np.testing.assert_allclose(gradient, -force, atol=RESIDUAL_TOLERANCE / 5)


def energy(q, pressure_kpa, spec):
    """V(q) as the module's head defines it, link by link, from the specification alone."""
    per_section = spec.structure.links_per_section
    half = spec.link_length_m / 2
    angle = np.deg2rad(spec.geometry.first_chamber_deg) + 2 * np.pi / 3 * np.arange(3)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], axis=1)
    down = np.array([0.0, 0.0, -1.0])
    length = {"chamber": [0.0] * spec.n_chambers, "spring": [0.0] * spec.n_chambers}
    radius = {"chamber": spec.geometry.chamber_radius_m, "spring": spec.geometry.spring_radius_m}
    total, place, turn = 0.0, np.zeros(3), np.eye(3)
    for link in range(spec.n_links):
        slide, x, y = q[3 * link : 3 * link + 3]
        total += 0.5 * spec.backbone.axial_stiffness_n_per_m * per_section * slide**2
        total += 0.5 * spec.backbone.bending_stiffness_nm_per_rad * per_section * (x**2 + y**2)
        above, above_turn = place, turn
        place = place + turn @ ((half + slide) * down)
        total += 9.81 * spec.mass.arm_kg / spec.n_links * place[2]
        about_x = jnp.array([[1, 0, 0], [0, jnp.cos(x), -jnp.sin(x)], [0, jnp.sin(x), jnp.cos(x)]])
        about_y = jnp.array([[jnp.cos(y), 0, jnp.sin(y)], [0, 1, 0], [-jnp.sin(y), 0, jnp.cos(y)]])
        turn = turn @ about_x @ about_y
        place = place + turn @ (half * down)
        for k in range(3):
            for kind in length:
                hole = radius[kind] * circle[k]
                piece = place + turn @ hole - above - above_turn @ hole
                length[kind][3 * (link // per_section) + k] += jnp.sqrt(piece @ piece)
    gripper = place + turn @ (0.5 * spec.mass.gripper_length_m * down)
    payload = place + turn @ (spec.mass.gripper_length_m * down)
    total += 9.81 * (spec.mass.gripper_kg * gripper[2] + spec.mass.payload_kg * payload[2])
    free = spec.geometry.section_length_m
    chambers = zip(
        *(
            spec.per_chamber(getattr(spec.chambers, name))
            for name in ("area_m2", "area_slope_m", "stiffness_n_per_m", "length_offset_m")
        ),
        strict=True,
    )
    for k, (area, slope, stiffness, offset) in enumerate(chambers):
        chamber, spring = length["chamber"][k], length["spring"][k]
        stretch = chamber - free
        total += 0.5 * stiffness * (stretch - offset) ** 2
        total += 0.5 * spec.springs.stiffness_n_per_m * (spring - spec.springs.rest_length_m) ** 2
        total -= 1e3 * pressure_kpa[k] * (area * stretch + 0.5 * slope * stretch**2)
    return total


def test_gradient_and_hessian_are_the_energy_s_derivatives():
    spec = odd_arm(2, 2)
    # A serial chain like MJX's, which compiles sooner with MJX's options.
    derivatives = xla.jit(lambda q, p: (jax.grad(energy)(q, p, spec), jax.hessian(energy)(q, p, spec)))
    for seed in range(5):
        q, pressure = random_state(spec, seed)
        with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
            gradient, hessian = jax.device_get(derivatives(q, pressure))
        found = solved(spec, q, pressure)
        np.testing.assert_allclose(found.gradient, gradient, atol=1e-11 * np.abs(gradient).max())
        np.testing.assert_allclose(found.hessian, hessian, atol=1e-11 * np.abs(hessian).max())


def test_parameters_are_the_specification_s_in_base_units():
    spec = odd_arm()
    params = ArmParams.from_spec(spec, np.float64)
    np.testing.assert_allclose(params.area, 1e3 * np.array(spec.chambers.area_m2))  # N per kPa
    np.testing.assert_allclose(params.chamber_rest_m, 0.2 + np.array(spec.chambers.length_offset_m))
    np.testing.assert_allclose(params.tool_mass_kg, [0.45, 0.3])
    np.testing.assert_allclose(params.tool_offset_m, [0.05, 0.1])
    assert params.link_mass_kg.sum() == pytest.approx(4.25)
    assert params.section_length_m == pytest.approx(0.2)
    assert params.n_sections == 3
    assert {np.asarray(x).dtype for x in jax.tree.leaves(ArmParams.from_spec(spec))} == {np.dtype(np.float32)}
