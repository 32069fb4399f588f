"""The ring against a Python list that keeps the last items appended."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.epoch import replay

pytestmark = pytest.mark.usefixtures("strict", "quick_compiler")


class Item(NamedTuple):
    tag: jax.Array  # () int32
    vector: jax.Array  # (2,) float32


CAPACITY, BATCH = 7, 5
EXAMPLE = Item(jnp.zeros((), jnp.int32), jnp.zeros(2))


add, thin = jax.jit(replay.add), jax.jit(replay.thin)


def rows(tags):
    """Items whose vector follows from their tag."""
    tags = np.asarray(tags, np.int32)
    return Item(jnp.asarray(tags), jnp.asarray(np.stack([tags, -tags], axis=-1), jnp.float32))


def oldest_first(ring):
    """Tags of the filled slots from the oldest to the newest."""
    size, position = int(ring.size), int(ring.position)
    start = position if size == CAPACITY else 0
    return [int(ring.data.tag[(start + i) % CAPACITY]) for i in range(size)]


@pytest.mark.parametrize("batch", [BATCH, CAPACITY])
@pytest.mark.parametrize("seed", range(4))
def test_ring_keeps_the_last_valid_items_in_order_over_many_wraps(seed, batch):
    rng = np.random.default_rng(seed)
    ring, model = replay.create(EXAMPLE, CAPACITY), []
    for step in range(25):
        tags = np.arange(step * batch, (step + 1) * batch)
        valid = rng.random(batch) < rng.choice([0.0, 0.3, 0.8, 1.0])
        ring = add(ring, rows(tags), jnp.asarray(valid))
        model = (model + tags[valid].tolist())[-CAPACITY:]
        assert oldest_first(ring) == model
        filled = slice(0, int(ring.size))
        expected = np.stack([ring.data.tag, -ring.data.tag], axis=-1)[filled]
        np.testing.assert_array_equal(ring.data.vector[filled], expected)


def test_nan_rows_marked_by_finite_rows_never_enter():
    items = rows(range(BATCH))
    items = items._replace(vector=items.vector.at[1, 0].set(jnp.nan).at[3, 1].set(jnp.inf))
    finite = replay.finite_rows(items)
    np.testing.assert_array_equal(finite, [True, False, True, False, True])
    ring = add(replay.create(EXAMPLE, CAPACITY), items, finite)
    assert oldest_first(ring) == [0, 2, 4]
    assert np.all(np.isfinite(ring.data.vector))


def test_sample_is_uniform_over_the_filled_slots_and_only_those():
    n_filled, n_draws = 4, 20_000
    ring = add(replay.create(EXAMPLE, CAPACITY), rows(range(1, 1 + n_filled)), jnp.ones(n_filled, bool))
    draw = jax.jit(functools.partial(replay.sample, batch_size=n_draws))
    items = draw(ring, jax.random.key(0))
    np.testing.assert_array_equal(items.vector, np.stack([items.tag, -items.tag], axis=-1))
    counts = np.bincount(items.tag, minlength=1 + n_filled)
    assert counts[0] == 0 and counts.sum() == n_draws
    # Binomial counts: five standard deviations.
    p = 1 / n_filled
    np.testing.assert_allclose(counts[1:], n_draws * p, atol=5 * np.sqrt(n_draws * p * (1 - p)))


@pytest.mark.parametrize("n_added", [6, 13], ids=["partly filled", "wrapped"])
def test_a_thinner_ring_keeps_a_share_oldest_first(n_added):
    ring = replay.create(jnp.zeros(()), 10)
    for k in range(n_added):
        ring = add(ring, jnp.array([float(k)]), jnp.array([True]))
    thinner = thin(ring, jax.random.PRNGKey(0), 0.5)
    n = int(thinner.size)
    kept = np.asarray(thinner.data[:n])
    assert n == min(n_added, 10) // 2 and int(thinner.position) == n
    assert np.all(np.diff(kept) > 0) and set(kept) <= set(range(max(0, n_added - 10), n_added))
    again = add(thinner, jnp.array([99.0]), jnp.array([True]))
    np.testing.assert_array_equal(again.data[: n + 1], [*kept, 99.0])


def test_thinning_draws_every_item_alike():
    ring = add(replay.create(jnp.zeros(()), 8), jnp.arange(8.0), jnp.ones(8, bool))
    draw = jax.jit(jax.vmap(lambda key: replay.thin(ring, key, 0.25).data[:2]))
    drawn = np.asarray(draw(jax.random.split(jax.random.PRNGKey(0), 2000)))
    share = np.bincount(drawn.ravel().astype(int), minlength=8) / len(drawn)
    np.testing.assert_allclose(share, 0.25, atol=4 * np.sqrt(0.25 * 0.75 / 2000))


def test_an_item_ahead_is_the_same_row_of_a_later_addition():
    """A ring that has wrapped around holds three additions; tags say where items came from."""
    ring = replay.create(EXAMPLE, 3 * BATCH)
    for step in range(5):
        ring = add(ring, rows(np.arange(BATCH) + step * BATCH), jnp.ones(BATCH, bool))
    draw = functools.partial(replay.sample_ahead, batch_size=1_000, stride=BATCH, n_ahead=2)
    now, later, ahead = jax.jit(draw)(ring, jax.random.key(0))
    came = np.asarray(now.tag) // BATCH + np.asarray(ahead) < 5  # before the end of the last addition
    np.testing.assert_array_equal(later.tag[came], (now.tag + BATCH * ahead)[came])
    assert set(np.unique(now.tag)) == set(range(2 * BATCH, 5 * BATCH))
    assert (np.bincount(ahead) > 250).all() and len(np.bincount(ahead)) == 3
