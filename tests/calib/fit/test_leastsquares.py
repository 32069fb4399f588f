"""Robust least squares on lines in three numbers: where it ends, and whether it says so."""

import numpy as np

from calib.fit.leastsquares import Problem, fit, refine

TRUE = np.array([0.3, -0.2, 0.1])
PROBLEM = Problem(
    prior=np.ones(3), group=np.zeros(2, int), scale=np.array([0.01]), min_scale=np.array([1e-3])
)
SLOPE = np.random.default_rng(0).normal(size=(50, 2, 3))


def test_steps_that_damping_alone_has_made_small_are_no_end():
    """With a Jacobian of the wrong sign every step is refused."""
    solution = fit(lambda x: (SLOPE @ (x - TRUE), -SLOPE), PROBLEM)
    np.testing.assert_array_equal(solution.x, 0.0)
    assert not solution.converged


def test_a_fit_to_a_part_of_the_rows_goes_on_to_all():
    """The last rows have other errors, so the minimum moves; the intervals become those of all rows."""
    rng = np.random.default_rng(1)
    slope = rng.normal(size=(400, 2, 3))
    error = 0.02 * rng.normal(size=(400, 2)) + np.where(np.arange(400) < 200, 0.01, -0.01)[:, None]

    def model(x, rows=slice(None)):
        return (slope @ (x - TRUE) + error)[rows], slope[rows]

    part, whole = fit(lambda x: model(x, slice(200)), PROBLEM), fit(model, PROBLEM)
    after = refine(model, part.x, PROBLEM)
    assert after.converged
    assert np.abs(part.x - whole.x).max() > 0.5 * whole.half_width.min()
    np.testing.assert_allclose(after.x, whole.x, atol=0.1 * whole.half_width.min())
    np.testing.assert_allclose(after.half_width, whole.half_width, rtol=0.02)
    np.testing.assert_allclose(after.half_width, part.half_width / np.sqrt(2), rtol=0.15)


def test_a_fit_ends_where_rounding_hides_how_the_loss_comes_down():
    """Errors come in steps of a thousandth of their scale, as in single precision."""
    rng = np.random.default_rng(1)
    slope, noise = rng.normal(size=(400, 2, 3)), 0.2 * rng.normal(size=(400, 2))

    def model(x):
        return np.round(slope @ (x - TRUE) + noise, 3), slope

    near = fit(model, PROBLEM)
    for seed in range(20):
        away = np.random.default_rng(seed).normal(size=3) * 0.08 * near.half_width
        assert refine(model, near.x + away, PROBLEM).converged
