"""Detector of outlying rows: no false alarms on steps and swings."""

import numpy as np

from mjx_softarm.logs import checks


def test_steps_swings_and_quantised_columns_have_no_outliers():
    rng = np.random.default_rng(0)
    time = np.arange(20_000)
    step = (time // 200 % 2).astype(float)
    lagged = np.convolve(step, 0.2 * 0.8 ** np.arange(60))[: len(step)]
    noisy = lagged + 0.002 * rng.standard_normal(len(step))
    swing = np.sin(2.0 * np.pi * time / 7.0)
    noise = rng.standard_normal(len(step)), rng.laplace(size=len(step))
    for values in (step, noisy, step + 0.01 * noise[0], np.round(lagged, 1), swing, *noise):
        assert not checks.outlier_rows(values, least=0.01).any()
    rows = np.array([50, 510, 511, 9_950, 15_350])
    noisy[rows] += 0.5
    np.testing.assert_array_equal(np.flatnonzero(checks.outlier_rows(noisy, least=0.01)), rows)
