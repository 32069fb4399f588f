"""Robust lines: intervals and warnings."""

import numpy as np
import pytest

from calib.fit.lines import fit_line


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_intervals_cover_as_often_as_they_say(correlation):
    rng = np.random.default_rng(0)
    n, k = 1_000, 100  # each column is a draw; stretches of 20 rows
    noise = rng.standard_normal((n, k))
    for row in range(1, n):
        noise[row] = correlation * noise[row - 1] + np.sqrt(1 - correlation**2) * noise[row]
    x = np.repeat(np.sin(np.arange(n) / 15.0)[:, None], k, axis=1)
    fit = fit_line(x, 2.0 * x + 1.0 + 0.1 * noise)
    for interval, truth in ((fit.slope_interval, 2.0), (fit.offset_interval, 1.0)):
        covered = np.mean((interval[:, 0] < truth) & (truth < interval[:, 1]))
        assert 0.90 < covered < 0.99


def test_shared_line_is_that_of_all_columns():
    rng = np.random.default_rng(0)
    x = rng.uniform(size=(300, 3))
    fit = fit_line(x, 2 * x + 1, shared=True)
    np.testing.assert_allclose(fit.slope, [2, 2, 2], rtol=1e-6)
    np.testing.assert_allclose(fit.offset, [1, 1, 1], rtol=1e-6)


def test_says_why_not_to_trust():
    rng = np.random.default_rng(0)
    x = 1.0 + 1e-3 * rng.standard_normal((30, 1))
    reasons = " ".join(fit_line(x, x + 1e-3 * rng.standard_normal((30, 1))).warnings)
    assert "spring0: got 30 rows" in reasons and "hardly be told apart" in reasons


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
