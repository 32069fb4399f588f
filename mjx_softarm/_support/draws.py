"""Random numbers of any shape, drawn as one row; with several devices, each device draws all numbers.

One row, because on a CPU XLA unrolls the generator for a shape with a short last axis and then compiles three
times as long. All numbers on each device, because XLA otherwise lets devices draw for each other and exchange
the numbers.
"""

from __future__ import annotations

import contextlib
import math

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh, PartitionSpec


def on(mesh: Mesh | None) -> contextlib.AbstractContextManager:
    """Return a context in which each device of a mesh draws all numbers of a traced function.

    A mesh of None stands for one device.
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

    They are remainders of random bits, which compile faster than `jax.random.randint`. Some integers are
    more likely than others, by less than one in a thousand for `below` up to four million.
    """
    return _everywhere(jax.random.bits(key, (n,), jnp.uint32) % below.astype(jnp.uint32))


def both(key: Array, shape_uniform: tuple[int, ...], shape_normal: tuple[int, ...]) -> tuple[Array, Array]:
    """Return uniform numbers from 0 to below 1 and standard normal numbers, from one draw; float32."""
    n_uniform = math.prod(shape_uniform)
    share = uniform(key, (n_uniform + math.prod(shape_normal),))
    centred = jnp.maximum(2.0 * share[n_uniform:] - 1.0, jnp.nextafter(-1.0, 0.0))  # -1 would give -infinity
    drawn = math.sqrt(2.0) * jax.lax.erf_inv(centred)
    uniform_part = _everywhere(share[:n_uniform].reshape(shape_uniform))
    return uniform_part, _everywhere(drawn.reshape(shape_normal))


def _everywhere(numbers: Array) -> Array:
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or set(mesh.axis_types) != {jax.sharding.AxisType.Auto}:  # inside `jax.pmap`
        return numbers
    return jax.lax.with_sharding_constraint(numbers, PartitionSpec())
