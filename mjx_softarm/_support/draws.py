"""Random numbers of any shape, drawn as one row.

On a CPU XLA unrolls the generator for a shape with a short last axis, and then compiles three times as long.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array


def uniform(key: Array, shape: tuple[int, ...], minval: float = 0.0) -> Array:
    """Return numbers of `jax.random.uniform`, from `minval` to below 1, float32."""
    return jax.random.uniform(key, (math.prod(shape),), minval=minval).reshape(shape)


def normal(key: Array, shape: tuple[int, ...]) -> Array:
    """Return numbers of `jax.random.normal`, of the standard normal distribution, float32."""
    return jax.random.normal(key, (math.prod(shape),)).reshape(shape)


def integers(key: Array, n: int, below: Array) -> Array:
    """Return integers (n,) from 0 to below `below` (), uint32.

    They are remainders of random bits, which compile faster than `jax.random.randint`. Some are more likely
    than others, by less than one in a thousand for `below` up to four million.
    """
    return jax.random.bits(key, (n,), jnp.uint32) % below.astype(jnp.uint32)


def both(key: Array, shape_uniform: tuple[int, ...], shape_normal: tuple[int, ...]) -> tuple[Array, Array]:
    """Return uniform numbers from 0 to below 1 and standard normal numbers, from one draw; float32."""
    n_uniform = math.prod(shape_uniform)
    share = uniform(key, (n_uniform + math.prod(shape_normal),))
    centred = jnp.maximum(2.0 * share[n_uniform:] - 1.0, jnp.nextafter(-1.0, 0.0))  # -1 would give -infinity
    drawn = math.sqrt(2.0) * jax.lax.erf_inv(centred)
    return share[:n_uniform].reshape(shape_uniform), drawn.reshape(shape_normal)
