"""Training of small networks: rows, a loss, a schedule of Adam, early stopping and a seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm._support.mlp import Layer

Weights = Any  # a tree of arrays


class Schedule(NamedTuple):
    """Course of a training by Adam."""

    n_updates: int
    learning_rate: float  # first rate, which falls along a half cosine
    batch_size: int
    weight_decay: float = 0.0  # per update and learning rate
    last_share: float = 0.0  # last learning rate over the first


def initial_layers(key: Array, widths: Sequence[int]) -> tuple[Layer, ...]:
    """Draw layers that preserve the magnitude of their input. Source: He et al. 2015, arXiv:1502.01852."""
    keys = jax.random.split(key, len(widths) - 1)
    return tuple(
        (jnp.sqrt(2.0 / n_in) * jax.random.normal(key, (n_in, n_out)), jnp.zeros(n_out))
        for key, n_in, n_out in zip(keys, widths[:-1], widths[1:], strict=True)
    )


def train_network(
    loss: Callable[[Weights, Any], Array],
    weights: Weights,
    rows: Any,
    schedule: Schedule,
    key: Array,
    stop: np.ndarray | None = None,
) -> tuple[Weights, np.ndarray]:
    """Minimise the mean loss of some rows; other rows choose the epoch whose weights are returned.

    Args:
        loss: mean loss () of weights on some rows.
        weights: where to start.
        rows: tree of arrays (n, ...).
        schedule: course of the training.
        key: of the order of the rows.
        stop (n,) bool: rows that stop the training early and are not learned from; by default every tenth.

    Returns:
        Weights with the least loss on the stopping rows; losses (n_epochs,) on these rows.
    """
    # Split the rows into learned rows and stopping rows, and fill whole batches.
    n = len(jax.tree.leaves(rows)[0])
    stops = np.arange(n) % 10 == 0 if stop is None else stop
    learned = jax.tree.map(lambda x: jnp.asarray(x)[~stops], rows)
    stopping = jax.tree.map(lambda x: jnp.asarray(x)[stops], rows)
    n_learned = int(np.count_nonzero(~stops))
    batch_size = min(schedule.batch_size, n_learned)
    n_batches = n_learned // batch_size
    n_epochs = -(-schedule.n_updates // n_batches)
    decay = optax.cosine_decay_schedule(schedule.learning_rate, n_epochs * n_batches, schedule.last_share)
    optimiser = optax.adamw(decay, weight_decay=schedule.weight_decay)

    def run(weights: Weights, keys: Array, learned: Any, stopping: Any) -> tuple[Weights, Array]:
        def update(carry: tuple[Weights, Any], chosen: Array) -> tuple[tuple[Weights, Any], None]:
            weights, state = carry
            batch = jax.tree.map(lambda x: x[chosen], learned)
            step, state = optimiser.update(jax.grad(loss)(weights, batch), state, weights)
            return (optax.apply_updates(weights, step), state), None

        def epoch(carry: tuple, key: Array) -> tuple[tuple, Array]:
            weights, state, best, least = carry
            # Visit the rows once, in a random order.
            shuffled = jax.random.permutation(key, n_learned)[: n_batches * batch_size]
            batches = shuffled.reshape(n_batches, batch_size)
            (weights, state), _ = jax.lax.scan(update, (weights, state), batches)
            # Keep the weights if no epoch before was better.
            value = loss(weights, stopping)
            best = jax.tree.map(lambda new, old: jnp.where(value < least, new, old), weights, best)
            return (weights, state, best, jnp.minimum(value, least)), value

        start = (weights, optimiser.init(weights), weights, jnp.inf)
        (_, _, best, _), losses = jax.lax.scan(epoch, start, keys)
        return best, losses

    keys = jax.random.split(key, n_epochs)
    return jax.device_get(xla.jit(run, "networks")(weights, keys, learned, stopping))
