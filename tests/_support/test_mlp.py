"""Activations of the networks on the arm's computer."""

import numpy as np
import pytest

from mjx_softarm._support.mlp import activate, mlp

X = np.array([-1e4, -3.0, -0.2, 0.0, 0.1, 2.0, 1e4])


def test_swish_is_smooth_and_does_not_overflow():
    with np.errstate(all="raise"):
        found = activate(X, "swish")
    few = X[1:-1]
    np.testing.assert_allclose(found[1:-1], few / (1.0 + np.exp(-4.0 * few)), rtol=1e-12, atol=1e-15)
    assert (found[0], found[-1]) == (0.0, 1e4)


@pytest.mark.parametrize("activation", ["relu", "swish"])
def test_hidden_layers_alone_are_activated(activation):
    layers = ((np.eye(1), np.zeros(1)), (-np.eye(1), np.ones(1)))
    found = mlp(layers, X[1:-1, None], activation)
    np.testing.assert_allclose(found[:, 0], 1.0 - activate(X[1:-1], activation), rtol=1e-12)
