"""Planted springs come back from noisy lengths, outliers and missing rows."""

import dataclasses

import numpy as np
import pytest

from calib.fit.sensors import fit_springs

N_ROWS = 2_000


def springs(spec, seed=0):
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
    planted, frequency, _, noisy = springs(spec)
    rng = np.random.default_rng(1)
    noisy = np.where(rng.random(noisy.shape) < outliers, noisy + 0.05, noisy)
    noisy[:50, 2] = np.nan
    fit = fit_springs(frequency, noisy, planted)
    np.testing.assert_allclose(fit.beta, planted.beta, rtol=5e-3)
    np.testing.assert_allclose(fit.delta_m, planted.delta_m, atol=5e-3 * 0.18)  # of the mean length
    assert fit.n_rows[2] == N_ROWS - 50 and fit.warnings == ()
    assert (fit.n_outliers >= 0.9 * outliers * fit.n_rows).all()


def test_compensation_is_told_apart(spec):
    planted, frequency, _, noisy = springs(spec)
    half, guess = slice(None, None, 2), dataclasses.replace(planted, compensation_h=5e-7)
    fit = fit_springs(frequency[half], noisy[half], guess, fit_compensation=True)
    low, high = fit.compensation_interval_h
    assert low < planted.compensation_h < high
    np.testing.assert_allclose(fit.beta, planted.beta, rtol=1e-2)
