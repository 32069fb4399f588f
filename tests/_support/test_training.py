"""The trainer of small networks, on linear regressions whose solution is known."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_softarm._support.training import Schedule, train_network

TRUE = np.array([1.0, -2.0, 0.5], np.float32)
SCHEDULE = Schedule(n_updates=400, learning_rate=0.1, batch_size=20)


def loss(weights, rows):
    x, y = rows
    return jnp.mean((x @ weights - y) ** 2)


def regression(n=100):
    x = np.random.default_rng(0).normal(size=(n, 3)).astype(np.float32)
    return x, x @ TRUE


def train(rows, schedule=SCHEDULE, seed=0, stop=None):
    return train_network(loss, jnp.zeros(3), rows, schedule, jax.random.key(seed), stop)


def test_rows_are_learned_but_for_every_tenth():
    weights, losses = train(regression())
    np.testing.assert_allclose(weights, TRUE, atol=1e-3)
    assert len(losses) == 100  # 90 rows fill four batches


def test_the_weights_are_those_of_the_best_epoch_on_the_stopping_rows():
    x, y = regression()
    stop = np.arange(100) >= 50
    y[stop] = x[stop] @ (0.5 * TRUE)  # half of the way is best for them
    weights, losses = train((x, y), Schedule(200, 0.02, 50), stop=stop)
    assert 0 < losses.argmin() < len(losses) - 1
    np.testing.assert_allclose(loss(weights, (x[stop], y[stop])), losses.min(), rtol=1e-5)


def test_the_seed_decides_and_decay_holds_weights_back():
    rows = regression()
    first, again, other = (train(rows, Schedule(20, 0.1, 20), seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    held_back, _ = train(rows, SCHEDULE._replace(weight_decay=3.0))
    assert np.linalg.norm(held_back) < 0.9 * np.linalg.norm(TRUE)
