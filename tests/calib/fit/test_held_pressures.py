"""Pressures that hold the unloaded arm: planted laws come back with their error, where they help."""

import numpy as np
import pytest

from calib.fit.held_pressures import fit_held_pressures, hysteresis_kpa
from mjx_softarm._support.archive import SealedFileError
from mjx_softarm.control import allocation, chambers_of_springs
from mjx_softarm.sensing.held_pressures import (
    PRESSURES_FILE,
    find_pressures,
    held_kpa,
    residual,
    save_pressures,
)
from mjx_softarm.sensing.hysteresis import stops
from mjx_softarm.spec import ArmSpec, SpecError
from tests.arms import FOUR_CHAMBERS

SPEC = ArmSpec.default()
N = SPEC.n_chambers
SIZES = 3, N, N
NOISE_KPA = 0.1


def poses(n=200, seed=3):
    rng = np.random.default_rng(seed)
    spring_m = SPEC.geometry.section_length_m + rng.uniform(-0.02, 0.04, (n, N))
    return spring_m, rng.uniform(-20.0, 20.0, (n, N)), NOISE_KPA * rng.standard_normal((n, N))


def hardening(spring_m, pressure_kpa):
    """Residuals of chambers that harden, whose areas grow with pressure, and which feel their neighbours."""
    stretch = (spring_m - 0.2) / 0.2
    own = 40.0 * stretch + 300.0 * stretch**2 + 0.002 * pressure_kpa**2
    return own + 20.0 * np.roll(stretch.reshape(-1, 3, 3), 1, axis=2).reshape(-1, N)


@pytest.fixture(scope="module")
def fit():
    spring_m, simulated_kpa, noise_kpa = poses()
    measured_kpa = simulated_kpa + hardening(spring_m, simulated_kpa) + noise_kpa
    return fit_held_pressures(SPEC, spring_m, measured_kpa, simulated_kpa)


def test_planted_laws_come_back_with_their_error(fit):
    assert fit.is_better and fit.after_kpa < 0.1 * fit.before_kpa
    assert 0.6 < fit.expected_kpa / fit.after_kpa < 1.6
    spring_m, simulated_kpa, _ = poses(100, seed=4)
    found = residual(fit.held, spring_m, simulated_kpa)
    off_kpa = found.mean_kpa - hardening(spring_m, simulated_kpa).reshape(found.mean_kpa.shape)
    deviation = np.sqrt(found.share[..., None] * np.diagonal(fit.held.covariance_kpa2, axis1=1, axis2=2))
    assert np.mean(np.abs(off_kpa) < 2.0 * deviation) > 0.9 and np.abs(off_kpa).mean() < 3 * NOISE_KPA


def test_hysteresis_that_the_order_of_the_poses_shows_comes_back():
    """A stop operator of another stroke than those of the fit, on top of the planted laws."""
    spring_m, simulated_kpa, noise_kpa = poses()
    measured_kpa = simulated_kpa + hardening(spring_m, simulated_kpa) + noise_kpa
    by_way_kpa = 0.8 * stops(spring_m, np.full(N, 0.01))
    fit = fit_held_pressures(SPEC, spring_m, measured_kpa + by_way_kpa, simulated_kpa)
    np.testing.assert_allclose(fit.held.hysteresis_kpa, 0.8, rtol=0.25)
    assert fit.expected_kpa < 0.4
    found_kpa = hysteresis_kpa(SPEC, fit.held, spring_m)
    assert np.sqrt(np.mean((found_kpa - by_way_kpa) ** 2)) < 0.5 * np.sqrt(np.mean(by_way_kpa**2))
    # In another order the poses do not show it
    shuffled = np.random.default_rng(1).permutation(len(spring_m))
    rows = spring_m[shuffled], (measured_kpa + by_way_kpa)[shuffled], simulated_kpa[shuffled]
    assert fit_held_pressures(SPEC, *rows).held.hysteresis_kpa.max() < 0.2


def test_an_arm_without_hysteresis_gets_none(fit):
    assert fit.held.hysteresis_kpa.max() < 0.5 * NOISE_KPA


def test_far_from_the_poses_little_is_known_and_draws_differ_by_that(fit):
    (spring_m, simulated_kpa, _), rng = poses(200, seed=5), np.random.default_rng(0)
    near, far = (residual(fit.held, 0.2 + k * (spring_m - 0.2), simulated_kpa) for k in (1.0, 4.0))
    assert np.median(far.share) > 3.0 * np.median(near.share)
    drawn_kpa = held_kpa(fit.held, spring_m, simulated_kpa, np.zeros((200, N)), rng)
    left_kpa = (drawn_kpa - simulated_kpa).reshape(near.mean_kpa.shape) - near.mean_kpa
    expected = near.share[..., None] * np.diagonal(fit.held.covariance_kpa2, axis1=1, axis2=2)
    assert np.mean(left_kpa**2 / expected) == pytest.approx(1.0, abs=0.1)


def test_the_file_gives_the_process_back_for_its_own_arm(fit, tmp_path):
    assert find_pressures(tmp_path, *SIZES) is None
    held = fit.held._replace(factor=0.9, factor_sd=0.03)
    save_pressures(tmp_path / PRESSURES_FILE, held)
    for one, other in zip(find_pressures(tmp_path, *SIZES), held, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(SealedFileError, match="pressures.state: got float64"):
        find_pressures(tmp_path, 2, 6, 6)


def test_pressures_that_move_nothing_are_no_residual():
    """A log's poses hold any redundant pressures, the law none: pushes alike count alike."""
    rng, n = np.random.default_rng(3), FOUR_CHAMBERS.n_chambers
    area_m2 = 1.2e-3 * (1.0 + rng.uniform(-0.1, 0.1, n))
    spec = FOUR_CHAMBERS.replace(chambers={"area_m2": tuple(area_m2)})
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
    assert fit.after_kpa > 0.95 * fit.before_kpa


def test_a_specification_needs_an_unmodelled_pressure_for_each_chamber():
    with pytest.raises(SpecError, match="unmodelled.pressure_kpa: got 2 numbers, expected .* the 9 chambers"):
        SPEC.replace(unmodelled={"pressure_kpa": (1.0,) * 2})
