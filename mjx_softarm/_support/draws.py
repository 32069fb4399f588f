"""Random numbers in any shape, drawn as one row, and on several devices by each of them.

For a shape with a short last axis XLA unrolls the generator on a CPU, and compiles it three times as long.
For numbers split over devices it lets devices draw for each other, and exchange the numbers.
"""

from __future__ import annotations

import contextlib
import math

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh, PartitionSpec


def on(mesh: Mesh | None) -> contextlib.AbstractContextManager:
    """Return a context in which, in a traced function, each device of the mesh draws all numbers.

    None is one device.
    """
    if mesh is None:
        return contextlib.nullcontext()
    return jax.sharding.use_abstract_mesh(mesh.abstract_mesh)


def uniform(key: Array, shape: tuple[int, ...], minval: float = 0.0) -> Array:
    """Return numbers of `jax.random.uniform`, from `minval` to below 1, float32."""
    return _everywhere(jax.random.uniform(key, (math.prod(shape),), minval=minval).reshape(shape))


def normal(key: Array, shape: tuple[int, ...]) -> Array:
    """Return numbers of `jax.random.normal`, of the standard normal distribution, float32."""
    return _everywhere(jax.random.normal(key, (math.prod(shape),)).reshape(shape))


def integers(key: Array, n: int, below: Array) -> Array:
    """Return integers (n,) from 0 to below `below` (), uint32.

    They are the remainders of random bits, which favours some by less than one in a thousand where `below` is
    at most four million, and compiles faster than `jax.random.randint`.
    """
    return _everywhere(jax.random.bits(key, (n,), jnp.uint32) % below.astype(jnp.uint32))


def both(key: Array, shape_uniform: tuple[int, ...], shape_normal: tuple[int, ...]) -> tuple[Array, Array]:
    """Return uniform numbers from 0 to below 1, and standard normal numbers, from one draw; float32.

    Args:
        key: key of the draw.
        shape_uniform: shape of the uniform numbers.
        shape_normal: shape of the normal numbers.
    """
    n_uniform = math.prod(shape_uniform)
    share = uniform(key, (n_uniform + math.prod(shape_normal),))
    centred = jnp.maximum(2.0 * share[n_uniform:] - 1.0, jnp.nextafter(-1.0, 0.0))  # -1 is at minus infinity
    drawn = math.sqrt(2.0) * jax.lax.erf_inv(centred)
    uniform_part = _everywhere(share[:n_uniform].reshape(shape_uniform))
    return uniform_part, _everywhere(drawn.reshape(shape_normal))


def _everywhere(numbers: Array) -> Array:
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or set(mesh.axis_types) != {jax.sharding.AxisType.Auto}:  # as within `jax.pmap`
        return numbers
    return jax.lax.with_sharding_constraint(numbers, PartitionSpec())
