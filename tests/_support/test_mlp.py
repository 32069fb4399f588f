"""Activations of the networks on the arm's computer."""

import numpy as np

from mjx_softarm._support.mlp import activate

X = np.array([-1e4, -3.0, -0.2, 0.0, 0.1, 2.0, 1e4])


def test_swish_is_smooth_and_does_not_overflow():
    with np.errstate(all="raise"):
        found = activate(X, "swish")
    few = X[1:-1]
    np.testing.assert_allclose(found[1:-1], few / (1.0 + np.exp(-4.0 * few)), rtol=1e-12, atol=1e-15)
    assert (found[0], found[-1]) == (0.0, 1e4)
