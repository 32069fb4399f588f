"""Gaussian processes on planted functions, against the textbook's formula, and as networks learn them."""

import numpy as np

from calib.fit.gaussian_process import NOISES, fit_process, predict

RNG = np.random.default_rng(0)
Z, UNSEEN = RNG.uniform(-1.0, 1.0, (200, 4)), RNG.uniform(-0.9, 0.9, (100, 4))


def planted(z):
    return np.stack([np.sin(2.0 * z[:, 0]) * z[:, 1], z[:, 2] ** 2 + 3.0], axis=1)


def test_a_smooth_function_is_met_where_no_row_is():
    process = fit_process(Z, planted(Z))
    np.testing.assert_allclose(predict(process, Z), planted(Z), atol=0.02)
    assert np.abs(predict(process, UNSEEN) - planted(UNSEEN)).max() < 0.03


def test_noise_is_told_from_the_function():
    """The mean of the process is closer to the function than the rows are."""
    noise = 0.2 * RNG.normal(size=(200, 2))
    process = fit_process(Z, planted(Z) + noise)
    assert np.std(predict(process, Z) - planted(Z)) < 0.6 * np.std(noise)


def test_the_mean_is_the_textbook_s():
    y = planted(Z[:30])[:, :1]
    process = fit_process(Z[:30], y)
    off = y - y.mean()

    def covariance(a, b):
        return np.exp(-((a[:, None] - b) ** 2).sum(-1) / (2.0 * process.length[0] ** 2))

    means = [
        y.mean()
        + covariance(UNSEEN, Z[:30]) @ np.linalg.solve(covariance(Z[:30], Z[:30]) + s * np.eye(30), off)
        for s in NOISES
    ]
    assert min(np.abs(mean - predict(process, UNSEEN)).max() for mean in means) < 1e-6


def test_an_output_that_never_changes_is_kept():
    y = np.column_stack([planted(Z)[:, 0], np.full(200, 7.0)])
    np.testing.assert_allclose(predict(fit_process(Z, y), UNSEEN)[:, 1], 7.0, atol=1e-9)
