"""Pressures that hold the unloaded arm: a planted straight line comes back, and only where it helps."""

import dataclasses

import numpy as np
import pytest

from calib.fit.held_pressures import fit_held_pressures
from mjx_softarm.control import allocation, chambers_of_springs
from mjx_softarm.spec import ArmSpec, SpecError

SPEC = ArmSpec.default()
N = SPEC.n_chambers


def poses(n=200, noise_kpa=0.3):
    rng = np.random.default_rng(3)
    spring_m = SPEC.geometry.section_length_m + rng.uniform(-0.02, 0.04, (n, N))
    simulated_kpa = rng.uniform(-20.0, 20.0, (n, N))
    return spring_m, simulated_kpa, noise_kpa * rng.standard_normal((n, N))


def test_a_planted_line_comes_back_through_the_specification():
    spring_m, simulated_kpa, noise_kpa = poses()
    slope = np.random.default_rng(4).normal(0.0, 60.0, (N, N))
    planted_kpa = 0.5 + (spring_m - SPEC.geometry.section_length_m) @ slope.T
    fit = fit_held_pressures(SPEC, spring_m, simulated_kpa + planted_kpa + noise_kpa, simulated_kpa)
    assert fit.is_better and fit.after_kpa < 0.4 < 2.0 < fit.before_kpa
    spec = SPEC.replace(unmodelled=dataclasses.asdict(fit.unmodelled))
    assert np.abs(spec.unmodelled_kpa(spring_m) - planted_kpa).max() < 0.5


def test_pressures_that_move_nothing_are_no_residual(four_chamber_arm):
    """A log's poses hold any redundant pressures, the law none: pushes alike count alike."""
    rng, n = np.random.default_rng(3), four_chamber_arm.n_chambers
    area_m2 = 1.2e-3 * (1.0 + rng.uniform(-0.1, 0.1, n))
    spec = four_chamber_arm.replace(chambers={"area_m2": tuple(area_m2)})
    plane = np.eye(n) - allocation(spec).redundant
    simulated_kpa = rng.uniform(-20.0, 20.0, (200, n)) @ plane
    spring_m = 0.2 + rng.uniform(-0.02, 0.04, (200, n)) @ plane
    chamber_m = spring_m @ chambers_of_springs(spec).T
    area_m2 = area_m2 + spec.chambers.area_slope_m * (chamber_m - 0.2)
    force = np.repeat(rng.uniform(-5.0, 5.0, (200, 3)), 4, axis=1) * np.tile([1.0, -1.0], n // 2)
    measured_kpa = simulated_kpa + 1.2e-3 * force / area_m2
    fit = fit_held_pressures(spec, spring_m, measured_kpa, simulated_kpa)
    assert np.abs(measured_kpa - simulated_kpa).max() > 4.0 and fit.before_kpa < 1e-9


def test_noise_alone_is_told_by_the_rows_held_out():
    spring_m, simulated_kpa, noise_kpa = poses()
    fit = fit_held_pressures(SPEC, spring_m, simulated_kpa + noise_kpa, simulated_kpa)
    assert not fit.is_better


def test_numbers_that_a_specification_lacks_are_zeros():
    spring_m = np.full(N, 0.1)
    assert not SPEC.unmodelled_kpa(spring_m).any()
    assert (SPEC.replace(unmodelled={"pressure_kpa": (1.0,) * N}).unmodelled_kpa(spring_m) == 1.0).all()


@pytest.mark.parametrize(("name", "expected"), [("pressure_kpa", "9 cham"), ("slope_kpa_per_m", "81 pairs")])
def test_a_specification_says_how_many_numbers_it_needs(name, expected):
    with pytest.raises(SpecError, match=f"unmodelled.{name}: got 2 numbers, expected .* the {expected}"):
        SPEC.replace(unmodelled={name: (1.0,) * 2})
