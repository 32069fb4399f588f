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
    """Return an empty ring.

    Args:
        example_item: pytree of one item (arrays or `jax.ShapeDtypeStruct`): structure, shapes and dtypes.
        capacity: number of slots N.

    Raises:
        ValueError: `capacity` is not positive.
    """
    if capacity < 1:
        raise ValueError(f"Replay capacity: got {capacity}, expected at least 1")
    item = jax.eval_shape(lambda x: x, example_item)
    data = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), item)
    return Ring(data, position=jnp.zeros((), jnp.int32), size=jnp.zeros((), jnp.int32))


def finite_rows(items: Items) -> Array:
    """Return which items have finite numbers alone, as part of `valid` in `add`.

    Args:
        items: pytree of leaves (B, ...).

    Returns:
        finite (B,) bool.
    """
    rows = [jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim))) for leaf in jax.tree.leaves(items)]
    return jnp.all(jnp.stack(rows), axis=0)


def add(replay: Ring, items: Items, valid: Array) -> Ring:
    """Append the valid rows in order, over the oldest ones once the ring is full.

    Args:
        replay: ring of N slots.
        items: pytree of leaves (B, ...), structured as the ring's, with B <= N.
        valid (B,) bool: rows to keep; the others never enter, and take no slot.

    Returns:
        The ring with the valid rows.

    Raises:
        ValueError: structure, shape or dtype of `items` or `valid` does not fit the ring, or B > N.
    """
    capacity = _check(replay, items, valid)
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
    """Draw items uniformly, with replacement, from the filled slots.

    The fill is known only at run time, so an empty ring cannot raise here: it yields zeros. Fill it first.

    Args:
        replay: ring with at least one item.
        key: PRNG key.
        batch_size: number of items B.

    Returns:
        Pytree of leaves (B, ...).
    """
    slot = draws.integers(key, batch_size, replay.size)
    return jax.tree.map(lambda ring: ring[slot], replay.data)


def sample_ahead(
    replay: Ring, key: Array, batch_size: int, stride: int, n_ahead: int
) -> tuple[Items, Items, Array]:
    """Draw items as `sample` does, and beside each one an item that was added later.

    Args:
        replay: ring with at least one item.
        key: PRNG key.
        batch_size: number of items B.
        stride: number of items that are added at once.
        n_ahead: largest number of additions between an item and the one beside it.

    Returns:
        Pytrees of leaves (B, ...): items, and the items beside them; the number of additions between the two,
        (B,) from 0 to `n_ahead`. Where so many have not come yet, or an addition left rows out, the item
        beside is an unrelated one.
    """
    key_slot, key_ahead = jax.random.split(key)
    slot = draws.integers(key_slot, batch_size, replay.size).astype(jnp.int32)
    ahead = draws.integers(key_ahead, batch_size, jnp.asarray(n_ahead + 1)).astype(jnp.int32)
    capacity = jax.tree.leaves(replay.data)[0].shape[0]
    beside = (slot + ahead * stride) % capacity
    items = jax.tree.map(lambda ring: ring[slot], replay.data)
    later = jax.tree.map(lambda ring: ring[beside], replay.data)
    return items, later, ahead


def thin(replay: Ring, key: Array, share: Array) -> Ring:
    """Return the ring with a random share of its items, oldest first, for a stage with other goals.

    Args:
        replay: ring of N slots.
        key: PRNG key.
        share (): share of the filled slots to keep, 0 to 1.
    """
    capacity = jax.tree.leaves(replay.data)[0].shape[0]
    age = (jnp.arange(capacity) - replay.position) % capacity  # oldest first, once the ring is full
    filled = jnp.arange(capacity) < replay.size
    n_kept = jnp.round(share * replay.size.astype(jnp.float32)).astype(jnp.int32)
    # The filled slots of lowest rank in a random order stay; they move to the front, oldest first.
    priority = jnp.where(filled, jax.random.uniform(key, (capacity,)), jnp.inf)  # (N,)
    kept = jnp.argsort(jnp.argsort(priority)) < n_kept  # (N,)
    order = jnp.argsort(jnp.where(kept, age, capacity + age))  # (N,)
    data = jax.tree.map(lambda leaf: leaf[order], replay.data)
    return Ring(data, position=n_kept % capacity, size=n_kept)


def _check(replay: Ring, items: Items, valid: Array) -> int:
    """Check structure, shapes and dtypes of what `add` gets; return the capacity."""
    expected_tree, got_tree = jax.tree.structure(replay.data), jax.tree.structure(items)
    if expected_tree != got_tree:
        raise ValueError(f"Replay items: got structure {got_tree}, expected {expected_tree}")
    if valid.ndim != 1 or valid.dtype != jnp.bool_:
        raise ValueError(f"Replay valid: got {valid.shape} {valid.dtype}, expected (B,) bool")
    capacity, batch = jax.tree.leaves(replay.data)[0].shape[0], valid.shape[0]
    if batch > capacity:
        raise ValueError(f"Replay add: got {batch} rows, expected at most {capacity}, the capacity")
    rings, _ = jax.tree_util.tree_flatten_with_path(replay.data)
    for (path, ring), rows in zip(rings, jax.tree.leaves(items), strict=True):
        if rows.shape != (batch, *ring.shape[1:]) or rows.dtype != ring.dtype:
            name, shape = jax.tree_util.keystr(path), (batch, *ring.shape[1:])
            raise ValueError(
                f"Replay items{name}: got {rows.shape} {rows.dtype}, expected {shape} {ring.dtype}"
            )
    return capacity
