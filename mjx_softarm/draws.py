"""Random numbers in any shape, drawn as one row.

They are those that `jax.random` gives for the shape. Of a shape whose last axis is short, XLA unrolls the
generator on a CPU, and compiles it three times as long.
"""

from __future__ import annotations

import math

import jax
from jax import Array


def uniform(key: Array, shape: tuple[int, ...], minval: float = 0.0, maxval: float = 1.0) -> Array:
    """Uniform from `minval` to below `maxval`, float32."""
    return jax.random.uniform(key, (math.prod(shape),), minval=minval, maxval=maxval).reshape(shape)


def normal(key: Array, shape: tuple[int, ...]) -> Array:
    """Of the standard normal distribution, float32."""
    return jax.random.normal(key, (math.prod(shape),)).reshape(shape)
