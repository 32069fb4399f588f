"""The pipe against closed forms, and NumPy against JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.mechanics.body import ring_radius_m
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.pipe import RIM_POINTS, CrossPipe, body_clearance, body_points, clearance

PIPE = CrossPipe(300.0)
R, Z = 0.15, -0.55


def hanging(spec, x_m=0.0):
    """Plates of an arm without any bending, moved sideways."""
    z = -spec.link_length_m[0] * np.arange(spec.n_links + 1.0)
    position = np.stack([np.full_like(z, x_m), np.zeros_like(z), z], axis=-1)
    return position, np.broadcast_to(np.eye(3), (len(z), 3, 3))


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ([0.0, 0.0, -0.2], R),  # on the vertical axis
        ([0.25, 0.0, Z], R),  # on the horizontal one
        ([0.0, 0.0, Z], R),  # where they cross
        ([0.0, -R, -0.2], 0.0),  # at the wall
        ([0.6 * R, 0.8 * R, -0.9], 0.0),
        ([-0.28, 0.6 * R, Z + 0.8 * R], 0.0),
        ([0.0, 0.05, -0.2], R - 0.05),
        ([0.28, 0.03, Z - 0.04], R - 0.05),  # in a branch
        ([R, 0.0, Z + R], 0.0),  # on the edge where the cylinders meet
        ([0.6 * R, 0.8 * R, Z - 0.6 * R], 0.0),
        ([0.09, 0.0, Z + 0.04], R - 0.04),  # the larger of the two distances
        ([0.2, 0.0, -0.2], -0.05),  # outside
        ([0.3, 0.0, Z + 0.4], R - 0.3),
    ],
)
def test_clearance_of_single_points(point, expected):
    np.testing.assert_allclose(clearance(PIPE, np.array(point)), expected, atol=1e-12)


def test_clearance_is_a_lower_bound_of_the_distance():
    """No wall within it: points that far away in random directions are inside the union, too."""
    rng = np.random.default_rng(0)
    point = np.array([0.0, 0.0, Z]) + rng.uniform(-0.2, 0.2, (4000, 3))
    free = clearance(PIPE, point)
    point, free = point[free > 0.0], free[free > 0.0]
    direction = rng.standard_normal(point.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    assert len(point) > 1000
    assert (clearance(PIPE, point + 0.999 * free[:, None] * direction) > 0.0).all()


def test_body_of_a_straight_arm(spec):
    position, rotation = hanging(spec)
    points = body_points(position, rotation, spec)
    assert points.shape == (RIM_POINTS * (spec.n_links + 1) + 24, 3)
    assert points[:, 2].min() == pytest.approx(-0.7)  # 600 mm of arm and 100 mm of gripper
    assert np.hypot(points[:, 0], points[:, 1]).max() == pytest.approx(0.069)
    gripper = points[points[:, 2] < -0.601]
    assert np.abs(gripper[:, 0]).max() == pytest.approx(0.025)
    assert ring_radius_m(spec) == pytest.approx(0.069)
    assert body_clearance(PIPE, position, rotation, spec) == pytest.approx(R - 0.069, abs=1e-12)


def test_numpy_and_jax_agree(spec):
    q = np.float32(np.random.default_rng(1).normal(0.0, 0.03, (50, 3 * spec.n_links)))
    plates = jax.jit(jax.vmap(chain_kinematics(ArmParams.from_spec(spec))))(q)[:2]
    jitted = jax.jit(lambda position, rotation: body_clearance(PIPE, position, rotation, spec))(*plates)
    assert jitted.shape == (50,) and jitted.dtype == jnp.float32
    alone = [body_clearance(PIPE, *(np.asarray(a[k], np.float64) for a in plates), spec) for k in range(50)]
    np.testing.assert_allclose(jitted, alone, atol=1e-6)
    assert np.ptp(alone) > 0.01


@pytest.mark.parametrize("point", [[0.0, 0.0, -0.2], [0.0, 0.0, Z], [R, 0.0, Z + R], [0.1, 0.02, Z]])
def test_gradient_is_finite_and_a_unit_vector_at_most(point):
    gradient = jax.grad(lambda p: clearance(PIPE, p))(jnp.array(point))
    assert np.isfinite(gradient).all() and np.linalg.norm(gradient) <= 1.0 + 1e-6


@pytest.mark.parametrize("aside_m", [0.0, 0.05])
def test_gradient_of_the_body(spec, aside_m):
    """Finite where the arm hangs on the axis, all its rims as near; -1 along x where it is off the axis."""
    plates = [jnp.array(part, jnp.float32) for part in hanging(spec, aside_m)]
    gradient = jax.jit(jax.grad(lambda *plates: body_clearance(PIPE, *plates, spec), (0, 1)))(*plates)
    assert all(np.isfinite(part).all() for part in gradient)
    np.testing.assert_allclose(gradient[0].sum(0), [-1.0 if aside_m else 0.0, 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("diameter_mm", [0.0, -300.0, 480.0, np.nan])
def test_impossible_diameter_is_refused(diameter_mm):
    with pytest.raises(ValueError, match="diameter_mm: got .*, expected more than 0 and less than 480"):
        CrossPipe(diameter_mm)
