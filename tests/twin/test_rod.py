"""The rod against closed forms of beams and bars, against finer rods, and against the equilibrium solver."""

import numpy as np
import pytest
from scipy.optimize import brentq

from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.workspace import settle_many
from mjx_softarm.twin.instruments import Build
from mjx_softarm.twin.rod import GRAVITY_M_S2, Rod, RodParts
from mjx_softarm.twin.rod_twin import RodTwin
from tests.arms import OTHER_ARMS
from tests.twin.conftest import PRESSURES_KPA

LENGTH_M = 0.2
NONE = np.zeros(9)


def holes(n_sections, n, radius_m=0.035):
    """Places (n_sections, n, 2) at equal angles from +y."""
    angle = np.pi / 2 + 2 * np.pi * np.arange(n) / n
    return np.tile(radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1), (n_sections, 1, 1))


def bar(n_sections=1, tip_kg=0.01, up=(0.0, 0.0, 1.0), joints=None, n_chambers=3, **other):
    """A rod without mass and without forces of chambers and springs, with a weight at its end."""
    s, zeros = n_sections, np.zeros((n_sections, n_chambers))
    numbers = {
        "section_length_m": np.full(s, LENGTH_M),
        "section_mass_kg": np.zeros(s),
        "bending": np.full(s, 0.4),
        "torsion": np.full(s, 0.3),
        "shear": np.full(s, 50.0),
        "extension": np.full(s, 150.0),
        "joint": np.tile(np.eye(3), (s, 1, 1)) if joints is None else joints,
        "chamber_hole_m": holes(s, n_chambers),
        "spring_hole_m": holes(s, 3),
        "stiffness": zeros,
        "hardening": zeros,
        "skew": zeros,
        "rest_m": zeros + LENGTH_M,
        "area": zeros,
        "area_slope": zeros,
        "area_growth": zeros,
        "spring_stiffness": np.zeros(s),
        "spring_rest_m": np.full(s, LENGTH_M),
        "tool_mass_kg": np.array([0.0, tip_kg]),
        "tool_offset_m": np.zeros(2),
        "up": np.array(up),
    }
    return RodParts(**(numbers | other))


def rest(parts, pressure_kpa=NONE, per_section=12):
    rod = Rod(parts, per_section)
    rod.settle(pressure_kpa[: parts.stiffness.size])
    return rod


def as_planes(pressure_kpa, n):
    """Pressures (k, 3 n) of sections with n chambers in the planes through those (k, 9) of three."""
    three, many = (np.exp(2j * np.pi * np.arange(k) / k) for k in (3, n))
    rows = np.linalg.inv(np.stack([np.ones(3), three.real, three.imag], axis=-1))
    plane = np.stack([np.ones(n), many.real, many.imag], axis=-1) @ rows
    return (pressure_kpa.reshape(-1, 3, 3) @ plane.T).reshape(len(pressure_kpa), -1)


def test_cantilever_bends_and_shears_as_timoshenkos_beam():
    """A weight across the rod: w = F L^3 / (3 E I) + F L / (G A), a slope of F L^2 / (2 E I)."""
    shape = rest(bar(up=(-1.0, 0.0, 0.0))).shape()
    force = 0.01 * GRAVITY_M_S2
    expected = force * LENGTH_M**3 / (3 * 0.4) + force * LENGTH_M / 50.0
    assert shape.node_m[-1, 0] == pytest.approx(expected, rel=5e-3)
    assert shape.rotation[-1, 2, 0] == pytest.approx(force * LENGTH_M**2 / (2 * 0.4), rel=5e-3)


def test_weight_stretches_a_hanging_bar():
    """Each of its sections by its own length and stiffness."""
    length_m, extension = np.array([LENGTH_M, 0.1]), np.array([150.0, 80.0])
    shape = rest(bar(2, tip_kg=0.3, section_length_m=length_m, extension=extension)).shape()
    end_m = -np.cumsum(length_m * (1.0 + 0.3 * GRAVITY_M_S2 / extension))
    np.testing.assert_allclose(shape.node_m[[12, 24]], np.outer(end_m, [0.0, 0.0, 1.0]), atol=1e-9)


def test_lever_twists_a_bar():
    """A second section at a right angle is the lever of a weight: angle = F L L / (G J)."""
    right = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    joints = np.stack([np.eye(3), right])
    stiff = {"bending": np.full(2, 1e4), "shear": np.full(2, 1e6)}
    shape = rest(bar(2, up=(-1.0, 0.0, 0.0), joints=joints, **stiff)).shape()
    twist = shape.rotation[12, 1, 0]
    assert abs(twist) == pytest.approx(0.01 * GRAVITY_M_S2 * LENGTH_M**2 / 0.3, rel=1e-2)
    assert np.sign(twist) == np.sign(shape.node_m[-1, 0] * shape.node_m[-1, 1]) * -1.0


@pytest.mark.parametrize("n_chambers", [3, 4, 6])
def test_chambers_harden(n_chambers):
    """Equal chambers and springs without weight: one equation for the length."""
    law = {"stiffness": 500.0, "skew": 0.3, "hardening": 0.8}
    chambers = law | {"area": 1.6, "area_slope": -4.0, "area_growth": 0.003}
    numbers = {name: np.full((1, n_chambers), value) for name, value in chambers.items()}
    springs = {"spring_stiffness": np.array([54.0]), "spring_rest_m": np.array([0.18])}
    parts = bar(tip_kg=0.0, n_chambers=n_chambers, **numbers, **springs)
    for kpa in (-35.0, 20.0):
        rod = rest(parts, np.full(n_chambers, kpa))

        def force(d, kpa=kpa):
            stretch = d / LENGTH_M
            chamber = 500.0 * d * (1.0 + 0.3 * stretch + 0.8 * stretch**2)
            chamber -= kpa * (1.0 + 0.003 * kpa) * (1.6 - 4.0 * d)
            return 150.0 * d / LENGTH_M + n_chambers * chamber + 3 * 54.0 * (d + LENGTH_M - 0.18)

        length_m = LENGTH_M + brentq(force, -0.19, 0.19)
        assert abs(length_m - LENGTH_M) > 0.01
        np.testing.assert_allclose(rod.shape().node_m[-1], [0.0, 0.0, -length_m], atol=1e-8)
        np.testing.assert_allclose(rod.spring_lengths(), np.full(3, length_m), atol=1e-8)


def test_one_chamber_bends_to_a_circle():
    """Without weight and shear every cross-section has the same strain: an arc that ends on a circle."""
    numbers = {"stiffness": np.full((1, 3), 500.0), "area": np.full((1, 3), 1.6)}
    rod = rest(bar(tip_kg=0.0, shear=np.full(1, 1e7), **numbers), np.array([20.0, 0.0, 0.0]))
    node, rotation = rod.shape()
    angle = np.arcsin(-rotation[-1, 1, 2])
    arc_m = np.linalg.norm(np.diff(node, axis=0), axis=1).sum()
    assert abs(angle) > 0.3
    assert abs(node[-1, 1]) == pytest.approx(arc_m * (1.0 - np.cos(angle)) / abs(angle), rel=1e-3)
    np.testing.assert_allclose(np.ptp(rod.q, axis=0), 0.0, atol=1e-6)


def test_derivatives_are_those_of_one_potential():
    """The gradient's derivative by differences is symmetric, and is the second derivative."""
    shape, length_m = (2, 4), np.array([LENGTH_M, 0.12])
    parts = bar(2, tip_kg=0.5, up=(0.1, -0.2, 0.97), tool_offset_m=np.array([0.0, 0.1]), n_chambers=4)
    parts = parts._replace(stiffness=np.full(shape, 500.0), area=np.full(shape, 1.6))
    parts = parts._replace(section_length_m=length_m, spring_stiffness=np.array([54.0, 30.0]))
    rod, pressure = Rod(parts, 2), np.random.default_rng(0).uniform(-20.0, 10.0, shape)
    rod.q = rod.q + 0.3 * np.random.default_rng(1).normal(size=rod.q.shape)
    at, found = rod.q, rod._derivatives(pressure)[1]
    columns = []
    for k in range(at.size):
        step = 1e-6 * np.eye(at.size)[k].reshape(at.shape)
        ends = []
        for rod.q in (at + step, at - step):
            ends.append(rod._derivatives(pressure)[0].ravel())
        columns.append((ends[0] - ends[1]) / 2e-6)
    differences = np.stack(columns, axis=1)
    np.testing.assert_allclose(differences, differences.T, atol=1e-7)
    block = np.kron(np.eye(4), np.ones((6, 6))) > 0
    np.testing.assert_allclose(found[~block], differences[~block], atol=1e-7)


def test_holding_pressures_ends_where_settle_does():
    parts = bar(2, tip_kg=0.3, stiffness=np.full((2, 3), 500.0), area=np.full((2, 3), 1.6))
    pressure = np.array([-15.0, 4.0, 0.0, 10.0, -8.0, -3.0])
    rod = Rod(parts, 3)
    for _ in range(400):
        rod.step(pressure, 0.02)
    expected = rest(parts, pressure, 3).shape().node_m[-1]
    np.testing.assert_allclose(rod.shape().node_m[-1], expected, atol=2e-6)


@pytest.mark.parametrize("name", ["paper", *OTHER_ARMS])
def test_an_ideal_rod_agrees_with_the_training_model(name):
    """Rigid in shear and torsion it is nearly training's chain, whose four links leave 3 mm.

    The tapered arm has five, as its first section is longer and wider.
    """
    spec = OTHER_ARMS.get(name, ArmSpec.default())
    spec = spec.replace(structure={"links_per_section": 5 if name == "tapered" else 4})
    pressures = as_planes(PRESSURES_KPA, spec.structure.chambers_per_section)
    expected = settle_many(spec, pressures)
    for kpa, tip_m, spring_m in zip(pressures, expected.tip_position_m, expected.spring_m, strict=True):
        arm = RodTwin(0, spec, build=Build(gap=0.0, noise=0.0))
        arm.settle(kpa)
        np.testing.assert_allclose(arm.motion_capture().tip_m, tip_m, atol=3e-3)
        np.testing.assert_allclose(arm._rod.spring_lengths(), spring_m, atol=2e-3)
