"""Ring of past items on the device: a pytree of arrays with a leading capacity axis.

`add` and `sample` have static shapes and no host work, so both live inside a jitted training step; donate the
ring to update it in place.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support import draws

Items = Any  # a pytree of arrays sharing a leading axis


class Ring(NamedTuple):
    """Ring of N = capacity slots, of which 0 ... size - 1 are filled."""

    data: Items  # leaves (N, ...)
    position: Array  # () int32, the next slot to write
    size: Array  # () int32, filled slots


def create(example_item: Items, capacity: int) -> Ring:
    """Return an empty ring of N slots for items shaped as one item, of arrays or `jax.ShapeDtypeStruct`."""
    data = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), example_item)
    return Ring(data, position=jnp.zeros((), jnp.int32), size=jnp.zeros((), jnp.int32))


def finite_rows(items: Items) -> Array:
    """Return which items (B, ...) have finite numbers alone: (B,) bool, as part of `valid` in `add`."""
    rows = [jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim))) for leaf in jax.tree.leaves(items)]
    return jnp.all(jnp.stack(rows), axis=0)


def add(replay: Ring, items: Items, valid: Array) -> Ring:
    """Return the ring with the valid rows appended in order, over the oldest ones once it is full.

    Args:
        replay: ring of N slots.
        items: pytree of leaves (B, ...), structured as the ring's, with B <= N.
        valid (B,) bool: rows to keep; the others never enter, and take no slot.
    """
    capacity = _capacity(replay)
    # Each valid row takes the slot after the previous one's; an invalid row's slot lies outside the ring,
    # where a scatter in mode "drop" writes nothing. B <= N makes the slots distinct.
    rank = jnp.cumsum(valid, dtype=jnp.int32) - 1  # (B,) among the valid
    slot = jnp.where(valid, (replay.position + rank) % capacity, capacity)  # (B,)
    data = jax.tree.map(lambda ring, rows: ring.at[slot].set(rows, mode="drop"), replay.data, items)
    n_valid = jnp.sum(valid, dtype=jnp.int32)
    return Ring(
        data,
        position=(replay.position + n_valid) % capacity,
        size=jnp.minimum(replay.size + n_valid, capacity),
    )


def sample(replay: Ring, key: Array, batch_size: int) -> Items:
    """Draw items (B, ...) uniformly, with replacement, from the filled slots.

    The number of filled slots is known only at run time, so an empty ring does not raise: it yields zeros.
    """
    slot = draws.integers(key, batch_size, replay.size)
    return jax.tree.map(lambda ring: ring[slot], replay.data)


def sample_ahead(
    replay: Ring, key: Array, batch_size: int, stride: int, n_ahead: int
) -> tuple[Items, Items, Array]:
    """Draw items (B, ...) as `sample` does, and for each one an item (B, ...) that was added later.

    The third result (B,) is the number of additions between the two, from 0 to `n_ahead`; `stride` items are
    added at once. Where the ring does not have the later item yet, or an addition left rows out, that item is
    unrelated.
    """
    key_slot, key_ahead = jax.random.split(key)
    slot = draws.integers(key_slot, batch_size, replay.size).astype(jnp.int32)
    ahead = draws.integers(key_ahead, batch_size, jnp.asarray(n_ahead + 1)).astype(jnp.int32)
    later_slot = (slot + ahead * stride) % _capacity(replay)
    items = jax.tree.map(lambda ring: ring[slot], replay.data)
    later = jax.tree.map(lambda ring: ring[later_slot], replay.data)
    return items, later, ahead


def thin(replay: Ring, key: Array, share: Array) -> Ring:
    """Return the ring with a random share () of its items, oldest first, for a stage with other goals."""
    capacity = _capacity(replay)
    age = (jnp.arange(capacity) - replay.position) % capacity  # oldest first, once the ring is full
    filled = jnp.arange(capacity) < replay.size
    n_kept = jnp.round(share * replay.size.astype(jnp.float32)).astype(jnp.int32)
    # The filled slots of lowest rank in a random order stay; they move to the front, oldest first.
    priority = jnp.where(filled, jax.random.uniform(key, (capacity,)), jnp.inf)  # (N,)
    kept = jnp.argsort(jnp.argsort(priority)) < n_kept  # (N,)
    order = jnp.argsort(jnp.where(kept, age, capacity + age))  # (N,)
    data = jax.tree.map(lambda leaf: leaf[order], replay.data)
    return Ring(data, position=n_kept % capacity, size=n_kept)


def _capacity(replay: Ring) -> int:
    return jax.tree.leaves(replay.data)[0].shape[0]
