"""Draws in one row against those of `jax.random`, and against the distributions that they are of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from mjx_softarm._support import draws

SHAPE = (7, 5, 3)


@pytest.mark.parametrize("name, bounds", [("uniform", {}), ("uniform", {"minval": -1.0}), ("normal", {})])
def test_numbers_are_those_that_jax_draws_for_the_shape(name, bounds):
    drawn = getattr(draws, name)(jax.random.key(0), SHAPE, **bounds)
    np.testing.assert_array_equal(drawn, getattr(jax.random, name)(jax.random.key(0), SHAPE, **bounds))


def test_of_one_draw_come_independent_numbers_of_both_distributions():
    uniform, normal = draws.both(jax.random.key(1), (100, 100), (10_000,))
    assert uniform.dtype == normal.dtype == jnp.float32
    assert kstest(np.ravel(uniform), "uniform").pvalue > 1e-3
    assert kstest(normal, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(np.ravel(uniform), normal)[0, 1]) < 0.05  # five standard errors


def test_the_smallest_share_is_a_finite_number(monkeypatch):
    """A share of zero would be a normal number at minus infinity; one in 8 million is zero."""
    monkeypatch.setattr(jax.random, "uniform", lambda key, shape, minval: jnp.zeros(shape))
    _, normal = draws.both(jax.random.key(2), (2,), (3,))
    assert np.isfinite(normal).all() and (normal < -5).all()
