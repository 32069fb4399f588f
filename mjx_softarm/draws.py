"""Random numbers in any shape, drawn as one row.

Of a shape whose last axis is short, XLA unrolls the generator on a CPU, and compiles it three times as long.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array


def uniform(key: Array, shape: tuple[int, ...], minval: float = 0.0) -> Array:
    """Uniform from `minval` to below 1, float32: the numbers of `jax.random.uniform`."""
    return jax.random.uniform(key, (math.prod(shape),), minval=minval).reshape(shape)


def normal(key: Array, shape: tuple[int, ...]) -> Array:
    """Of the standard normal distribution, float32: the numbers of `jax.random.normal`."""
    return jax.random.normal(key, (math.prod(shape),)).reshape(shape)


def both(key: Array, uniform: tuple[int, ...], normal: tuple[int, ...]) -> tuple[Array, Array]:
    """Numbers uniform from 0 to below 1, and of the standard normal distribution, of one draw; float32.

    Args:
        key: for the draw.
        uniform: shape of the ones.
        normal: shape of the others.
    """
    n_uniform = math.prod(uniform)
    share = jax.random.uniform(key, (n_uniform + math.prod(normal),))
    centred = jnp.maximum(2.0 * share[n_uniform:] - 1.0, jnp.nextafter(-1.0, 0.0))  # -1 is at minus infinity
    return share[:n_uniform].reshape(uniform), (math.sqrt(2.0) * jax.lax.erf_inv(centred)).reshape(normal)
