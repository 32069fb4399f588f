"""Multilayer perceptron as plain arrays, for NumPy on the arm's computer and JAX in training."""

from __future__ import annotations

from collections.abc import Sequence

from mjx_softarm._support.xp import Array, array_namespace

Layer = tuple[Array, Array]  # weight (in, out) and bias (out,)


def mlp(layers: Sequence[Layer], x: Array) -> Array:
    """Return outputs (..., out) of inputs (..., in): rectified linear hidden layers, linear output."""
    xp = array_namespace(x, *layers[0])
    *hidden, (head_weight, head_bias) = layers
    for weight, bias in hidden:
        x = xp.maximum(x @ weight + bias, 0.0)  # (..., out)
    return x @ head_weight + head_bias
