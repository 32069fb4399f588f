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


def both(key: Array, shape_uniform: tuple[int, ...], shape_normal: tuple[int, ...]) -> tuple[Array, Array]:
    """Numbers uniform from 0 to below 1, and of the standard normal distribution, of one draw; float32.

    Args:
        key: for the draw.
        shape_uniform: of the ones.
        shape_normal: of the others.
    """
    n_uniform = math.prod(shape_uniform)
    share = uniform(key, (n_uniform + math.prod(shape_normal),))
    centred = jnp.maximum(2.0 * share[n_uniform:] - 1.0, jnp.nextafter(-1.0, 0.0))  # -1 is at minus infinity
    drawn = math.sqrt(2.0) * jax.lax.erf_inv(centred)
    return share[:n_uniform].reshape(shape_uniform), drawn.reshape(shape_normal)
