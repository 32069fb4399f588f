"""Small networks fitted to rows of a log: averaged, stopped early on contiguous blocks, bounded.

A log is short for a network, so the fit prefers smooth functions. A linear map is fitted first. Several small
networks with weight decay learn its residual, each stopped early on blocks of rows that it did not see, and
their outputs are averaged. The linear map and the members are joined to one network, layers side by side,
which is stored and run as one.

Where a process was fitted to the rows (`calib.fit.section_process`), one network learns its mean instead, at
many points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from calib.errors import FitError
from calib.fit.blocks import held_out_blocks
from mjx_softarm._support import xla
from mjx_softarm._support.mlp import Layer, mlp
from mjx_softarm.sensing.s2r import S2R

RIDGE = 1.0  # of the linear map; inputs are from -1 to 1, so it weighs as much as a row or two
N_ANCHORS = 256
LIMIT_PERCENTILE = 99.0
ROWS_PER_BLOCK = 100
MIN_BLOCKS = 20  # shorter blocks rather than fewer

STOP_EVERY = 10  # of the points one stops the training early


@dataclass(frozen=True)
class NetworkConfig:
    """Training settings. Learning rate and batch are the paper's."""

    hidden: tuple[int, ...] = (64, 64)
    n_members: int = 5  # networks that are averaged
    n_updates: int = 3_000  # of each
    learning_rate: float = 0.01  # of Adam at the start; it falls to zero along a half cosine
    batch_size: int = 128
    weight_decay: float = 0.3  # per update and learning rate
    stop_share: float = 0.2  # of the rows, which stop a member early


# For a network that learns a process: without noise there is nothing to average, and nothing to hold back.
OF_PROCESS = NetworkConfig((192, 192), 1, 12_000, 4e-3, 512, 0.0)


class NetworkFit(NamedTuple):
    """Fitted network, and the course of its training."""

    network: S2R
    stop_epoch: np.ndarray  # (n_members,) epoch whose weights were best on the member's own blocks
    n_epochs: int


def block_rows(n: int) -> int:
    """Return the number of rows in a held-out block of a log of n rows."""
    return max(min(ROWS_PER_BLOCK, n // MIN_BLOCKS), 1)


def fit_network(
    x: np.ndarray,
    y: np.ndarray,
    seed: int,
    config: NetworkConfig | None = None,
    points: tuple[np.ndarray, np.ndarray] | None = None,
) -> NetworkFit:
    """Fit a network from inputs to outputs by mean squared error.

    Args:
        x (n, n_in): inputs in order of time, without the rows that will test the network.
        y (n, n_out): outputs.
        seed: seed of weights, batches and blocks.
        config: training settings.
        points: inputs (m, n_in) and outputs (m, n_out) without noise that it learns in place of the rows.

    Raises:
        FitError: fewer than two rows, arrays that do not fit together, or a number that is not finite.
    """
    _check(x, y)
    n = len(x)
    config = config or (NetworkConfig() if points is None else OF_PROCESS)
    seeds = (1_000 * seed + k for k in range(config.n_members))
    stopping = [held_out_blocks(n, config.stop_share, block_rows(n), of) for of in seeds]
    bounds = _bounds(x, y)
    low, high = bounds["input_low"], bounds["input_high"]

    def normalised(x: np.ndarray) -> np.ndarray:
        return (2.0 * (x - low) / (high - low) - 1.0).astype(np.float32)

    z = normalised(x)
    anchors, limit = _anchors(z, stopping[0])
    if points is not None:
        z, y = np.clip(normalised(points[0]), -1.0, 1.0), points[1]
        stopping = [np.arange(len(z)) % STOP_EVERY == 0] * config.n_members
    linear = _line(z, y)
    left = y - z @ linear
    centre, spread = left.mean(axis=0), left.std(axis=0)
    spread = np.where(spread > 0.0, spread, 1.0)
    rows = _equally_many([np.flatnonzero(~stop) for stop in stopping])
    n_batches = max(rows.shape[1] // config.batch_size, 1)
    n_epochs = -(-config.n_updates // n_batches)
    members, losses = _train(
        jax.random.key(seed),
        jnp.asarray(z, jnp.float32),
        jnp.asarray((left - centre) / spread, jnp.float32),
        rows,
        _equally_many([np.flatnonzero(stop) for stop in stopping]),
        hidden=config.hidden,
        batch_size=min(config.batch_size, rows.shape[1]),
        n_epochs=n_epochs,
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
    )
    layers = _side_by_side(jax.device_get(members), spread, centre, linear)
    network = S2R(layers=layers, **bounds, anchors=anchors, limit=np.float32(limit))
    return NetworkFit(network, np.asarray(losses).argmin(axis=1), n_epochs)


def _check(x: np.ndarray, y: np.ndarray) -> None:
    if x.ndim != 2 or y.ndim != 2 or len(x) != len(y) or len(x) < 2:
        tables = f"{x.shape} and {y.shape}"
        raise FitError(f"network: got tables {tables}, expected as many rows in both, 2 or more")
    for name, table in (("inputs", x), ("outputs", y)):
        if not np.isfinite(table).all():
            row, column = np.argwhere(~np.isfinite(table))[0]
            where = f"{name}, row {row}, column {column}"
            raise FitError(f"network: {where}: got {table[row, column]}, expected a finite number")


def _bounds(x: np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
    """Return ranges of the training rows; an input that never changes gets a width above zero."""
    low, high = (f(x, axis=0).astype(np.float32) for f in (np.min, np.max))
    narrow = high - low <= 1e-5 * np.maximum(np.abs(low), np.abs(high))
    margin = np.where(narrow, np.maximum(1e-3 * np.abs(low), 1e-3), 0.0).astype(np.float32)
    output_low, output_high = (f(y, axis=0).astype(np.float32) for f in (np.min, np.max))
    inputs = {"input_low": low - margin, "input_high": high + margin}
    return inputs | {"output_low": output_low, "output_high": output_high}


def _equally_many(rows: list[np.ndarray]) -> np.ndarray:
    """Stack row numbers of the members (n_members, n); shorter ones repeat their first."""
    return np.stack([np.resize(row, max(map(len, rows))) for row in rows])


@xla.jit_at_first_call(uses_mjx=False, static_argnames=("hidden", "batch_size", "n_epochs"))
def _train(
    key: Array,
    x: Array,
    y: Array,
    rows: Array,
    stop_rows: Array,
    *,
    hidden: tuple[int, ...],
    batch_size: int,
    n_epochs: int,
    learning_rate: float,
    weight_decay: float,
) -> tuple[tuple[Layer, ...], Array]:
    """Return stacked layers of the members, and their losses (n_members, n_epochs) on the stopping rows."""
    sizes = (x.shape[1], *hidden, y.shape[1])
    n_batches = rows.shape[1] // batch_size
    schedule = optax.cosine_decay_schedule(learning_rate, n_epochs * n_batches)
    optimiser = optax.adamw(schedule, weight_decay=weight_decay)

    def loss(layers, chosen):
        return jnp.mean((mlp(layers, x[chosen]) - y[chosen]) ** 2)

    def update(carry, batch):
        layers, state = carry
        step, state = optimiser.update(jax.grad(loss)(layers, batch), state, layers)
        return (optax.apply_updates(layers, step), state), None

    def member(key, rows, stop_rows):
        key_layers, key_epochs = jax.random.split(key)

        def epoch(carry, key):
            layers, state, best, least = carry
            shuffled = jax.random.permutation(key, rows)[: n_batches * batch_size]
            (layers, state), _ = jax.lax.scan(
                update, (layers, state), shuffled.reshape(n_batches, batch_size)
            )
            value = loss(layers, stop_rows)
            best = jax.tree.map(lambda new, old: jnp.where(value < least, new, old), layers, best)
            return (layers, state, best, jnp.minimum(value, least)), value

        layers = _initial_layers(key_layers, sizes)
        start = (layers, optimiser.init(layers), layers, jnp.inf)
        (_, _, best, _), losses = jax.lax.scan(epoch, start, jax.random.split(key_epochs, n_epochs))
        return best, losses

    return jax.vmap(member)(jax.random.split(key, rows.shape[0]), rows, stop_rows)


def _initial_layers(key: Array, sizes: tuple[int, ...]) -> tuple[Layer, ...]:
    """Draw layers with He's initialisation."""
    keys = jax.random.split(key, len(sizes) - 1)
    return tuple(
        (jnp.sqrt(2.0 / n_in) * jax.random.normal(key, (n_in, n_out)), jnp.zeros(n_out))
        for key, n_in, n_out in zip(keys, sizes[:-1], sizes[1:], strict=True)
    )


def _line(z: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return weights (n_in, n_out) of the linear map from inputs to outputs, without its offset."""
    z, y = z - z.mean(axis=0), y - y.mean(axis=0)
    return np.linalg.solve(z.T @ z + RIDGE * np.eye(z.shape[1]), z.T @ y)


def _side_by_side(
    members: tuple[Layer, ...], scale: np.ndarray, offset: np.ndarray, linear: np.ndarray
) -> tuple[Layer, ...]:
    """Join members to one network: `scale` times their mean, plus `offset`, plus a linear map of the inputs.

    The inputs z are -1 or more, so z + 1 passes through the rectified layers unchanged.

    Args:
        members: layers of weights (n_members, in, out) and biases (n_members, out).
        scale, offset (n_out,): scale and offset of the outputs.
        linear (n_in, n_out): weights of the linear map.
    """
    *hidden, (weight, bias) = members
    n_in = linear.shape[0]
    layers: list[Layer] = []
    for k, (w, b) in enumerate(hidden):
        n_members, n_before, n_after = w.shape
        joined = np.zeros((n_members, n_before, n_members, n_after), np.float32)
        joined[np.arange(n_members), :, np.arange(n_members)] = w
        rows = n_members * n_before
        block = np.zeros((rows + n_in, n_members * n_after + n_in), np.float32)
        block[:rows, :-n_in] = joined.reshape(rows, -1)
        block[rows:, -n_in:] = np.eye(n_in)
        if k == 0:  # all members and the line read the same inputs
            block = block.reshape(n_members + 1, n_in, -1).sum(axis=0)
        layers.append((block, np.append(b.reshape(-1), np.full(n_in, float(k == 0)))))
    head = np.concatenate([np.concatenate(list(weight)) * scale / len(weight), linear])
    layers.append((head, bias.mean(axis=0) * scale + offset - linear.sum(axis=0)))
    return tuple((np.asarray(w, np.float32), np.asarray(b, np.float32)) for w, b in layers)


def _anchors(z: np.ndarray, left_out: np.ndarray) -> tuple[np.ndarray, float]:
    """Return rows that represent all rows z (n, n_in), and the greatest distance to believe.

    Nearly all left-out rows are within this distance of anchors chosen without them.
    """
    without = _spread_rows(z[~left_out])
    gap = np.min(np.mean((z[left_out, None] - without) ** 2, axis=-1), axis=-1)
    limit = np.sqrt(np.percentile(gap, LIMIT_PERCENTILE))
    return _spread_rows(z), max(float(limit), 1e-3)


def _spread_rows(z: np.ndarray) -> np.ndarray:
    """Choose up to N_ANCHORS rows, each the farthest from those before it."""
    chosen, gap = [0], np.full(len(z), np.inf)
    while len(chosen) < min(N_ANCHORS, len(z)):
        gap = np.minimum(gap, np.mean((z - z[chosen[-1]]) ** 2, axis=-1))
        if gap.max() == 0.0:
            break
        chosen.append(int(gap.argmax()))
    return z[chosen]
