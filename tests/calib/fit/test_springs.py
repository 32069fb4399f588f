"""Springs, by robust lines of optax: SciPy's least squares, intervals, one program, warnings."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from benchmarks.accuracy.calibration import ASU_LOGS, read_asu, still_rows
from calib.fit import springs
from calib.fit.springs import HUBER, fit_line, fit_springs

DATA = Path(__file__).parents[3].parent / "shared/data"
N_ROWS = 2_000
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no logs of a real arm in {DATA}")


def scipy_line(x, y, noise):
    """Slope and offset by SciPy's least squares with Huber's loss."""
    tight = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15, "x_scale": "jac"}
    return least_squares(
        lambda p: p[0] * x + p[1] - y, [1.0, 0.0], loss="huber", f_scale=HUBER * noise, **tight
    ).x


def planted(n=800, k=4, outliers=0.1, seed=0):
    """Columns x with lines y, noise, outliers and missing entries."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0.3, 1.0, (n, k))
    y = np.linspace(0.8, 1.2, k) * x - 0.1 + 0.01 * rng.standard_normal((n, k))
    y += 0.3 * (rng.random((n, k)) < outliers)
    y[rng.random((n, k)) < 0.05] = np.nan
    return x, y


def test_planted_lines_with_outliers_agree_with_scipy():
    x, y = planted()
    fit = fit_line(x, y)
    for k in range(x.shape[1]):
        rows = np.isfinite(y[:, k])
        expected = scipy_line(x[rows, k], y[rows, k], fit.noise[k])
        np.testing.assert_allclose([fit.slope[k], fit.offset[k]], expected, rtol=1e-5)
    np.testing.assert_allclose(fit.slope, np.linspace(0.8, 1.2, 4), atol=0.01)
    np.testing.assert_array_less(60, fit.n_outliers)  # of some 76


@needs_data
@pytest.mark.parametrize(("log", "rms_mm"), [("apr5", 0.62), ("apr4", 0.23)])
def test_draw_wires_of_a_real_arm(log, rms_mm):
    """SciPy's lines come back; at rest held-out errors are at most those of the data's own page."""
    asu = read_asu(DATA / ASU_LOGS[log])
    x, y = asu.wire_m, asu.section_m
    still = still_rows(asu.time_s, x) & still_rows(asu.time_s, y)
    for rows in (asu.fresh, asu.fresh & still):
        fit = fit_line(x[rows, None], y[rows, None])
        expected = scipy_line(x[rows], y[rows], fit.noise[0])
        np.testing.assert_allclose([fit.slope[0], fit.offset[0]], expected, rtol=1e-5)
    assert 1e3 * fit.held_out_rms[0] <= rms_mm


def test_one_program_fits_all_springs_and_folds(monkeypatch):
    """Other numbers and other rows up to the padding do not trace it again."""
    traced = []
    optimiser = springs.optax.lbfgs
    monkeypatch.setattr(springs.optax, "lbfgs", lambda **keywords: traced.append(1) or optimiser(**keywords))
    springs._fit_all.cache_clear()
    fit_line(*planted(n=300, k=7))
    assert len(traced) == 1
    fit_line(*planted(n=900, k=7, outliers=0.02, seed=1))
    assert len(traced) == 1


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_intervals_cover_as_often_as_they_say(correlation):
    rng = np.random.default_rng(0)
    n, k = 1_000, 100  # each column is a draw; stretches of 20 rows
    noise = rng.standard_normal((n, k))
    for row in range(1, n):
        noise[row] = correlation * noise[row - 1] + np.sqrt(1 - correlation**2) * noise[row]
    x = np.repeat(np.sin(np.arange(n) / 15.0)[:, None], k, axis=1)
    fit = fit_line(x, 2.0 * x + 1.0 + 0.1 * noise)
    for value, width, truth in ((fit.slope, fit.slope_width, 2.0), (fit.offset, fit.offset_width, 1.0)):
        covered = np.mean(np.abs(value - truth) < width)
        assert 0.90 < covered < 0.99


def test_says_why_not_to_trust():
    rng = np.random.default_rng(0)
    x = 1.0 + 1e-3 * rng.standard_normal((30, 1))
    reasons = " ".join(fit_line(x, x + 1e-3 * rng.standard_normal((30, 1))).warnings)
    assert "spring0: got 30 rows" in reasons and "hardly be separated" in reasons


def test_refuses():
    with pytest.raises(ValueError, match=r"got tables of shapes \(5, 1\) and \(4, 1\)"):
        fit_line(np.zeros((5, 1)), np.zeros((4, 1)))
    with pytest.raises(ValueError, match="spring0: got 9 rows with a reading and a length, expected 3"):
        fit_line(np.ones((9, 1)), np.arange(9.0)[:, None])


def test_plateaus_are_held_out_across_the_range_and_extrapolation_is_said():
    """Rows at rest at few lengths: a fold that sees one length only would be tens of millimetres off."""
    rng = np.random.default_rng(0)
    x = np.repeat([0.10, 0.13, 0.16, 0.19], 40)[:, None]
    y = 1.1 * x + 0.002 + 2e-4 * rng.standard_normal(x.shape)
    fit = fit_line(x, y)
    assert fit.held_out_rms[0] < 1.2 * fit.rms[0] and fit.beyond[0] == 0.0
    far = np.concatenate([x, np.full((8, 1), 0.5)])
    said = fit_line(far, 1.1 * far + 2e-4 * rng.standard_normal(far.shape)).warnings
    assert any("extrapolates in" in warning for warning in said)


def planted_springs(spec, seed=0):
    """Planted calibration, readings without noise, true lengths, and lengths with 1 % of noise."""
    rng = np.random.default_rng(seed)
    planted = dataclasses.replace(
        spec.spring_sensor, beta=rng.uniform(0.85, 1.0, 9), delta_m=rng.uniform(-5e-3, 5e-3, 9)
    )
    length = rng.uniform(0.1, 0.26, (N_ROWS, 9))
    noisy = length * (1 + 0.01 * rng.standard_normal(length.shape))
    return planted, planted.readings(length), length, noisy


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_planted_calibration_within_half_a_percent_at_one_percent_of_length(spec, outliers):
    planted, frequency, _, noisy = planted_springs(spec)
    rng = np.random.default_rng(1)
    noisy = np.where(rng.random(noisy.shape) < outliers, noisy + 0.05, noisy)
    noisy[:50, 2] = np.nan
    fit = fit_springs(frequency, noisy, planted)
    np.testing.assert_allclose(fit.slope, planted.beta, rtol=5e-3)
    np.testing.assert_allclose(fit.offset, planted.delta_m, atol=5e-3 * 0.18)  # of the mean length
    assert fit.n_rows[2] == N_ROWS - 50 and fit.warnings == ()
    assert (fit.n_outliers >= 0.9 * outliers * fit.n_rows).all()
