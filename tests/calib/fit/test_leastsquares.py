"""Robust least squares on lines in three numbers: where it ends, and whether it says so."""

import numpy as np

from calib.fit import leastsquares
from calib.fit.leastsquares import Problem, fit

TRUE = np.array([0.3, -0.2, 0.1])
PROBLEM = Problem(
    prior=np.ones(3), group=np.zeros(2, int), scale=np.array([0.01]), min_scale=np.array([1e-3])
)
SLOPE = np.random.default_rng(0).normal(size=(50, 2, 3))


def test_a_line_is_found_and_the_fit_comes_to_an_end():
    solution = fit(lambda x: (SLOPE @ (x - TRUE), SLOPE), PROBLEM)
    np.testing.assert_allclose(solution.x, TRUE, atol=1e-5)
    assert solution.converged


def test_steps_that_damping_alone_has_made_small_are_no_end():
    """With a Jacobian of the wrong sign every step is refused."""
    solution = fit(lambda x: (SLOPE @ (x - TRUE), -SLOPE), PROBLEM)
    np.testing.assert_array_equal(solution.x, 0.0)
    assert not solution.converged


def test_newton_steps_end_a_fit_whose_scales_still_changed(monkeypatch):
    """Outliers on one side: the minimum moves with the scale, which each round leaves behind."""
    rng = np.random.default_rng(1)
    slope = rng.normal(size=(400, 2, 3)) + 1.0
    noise = 0.2 * rng.normal(size=(400, 2)) + np.where(rng.uniform(size=(400, 1)) < 0.3, 10.0, 0.0)

    def model(x):
        return slope @ (x - TRUE) + noise, slope

    assert fit(model, PROBLEM).converged
    monkeypatch.setattr(leastsquares, "NEWTON_STEPS", 0)
    assert not fit(model, PROBLEM).converged
