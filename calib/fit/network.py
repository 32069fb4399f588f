"""Small network fitted to rows of a log, or to a process that was fitted to them; bounded, stopped early.

A linear map is fitted first, and a network learns its residual. Both are joined to one network, which is
stored and run as one. Its inputs and outputs stay within the range of the rows, and anchors measure how far
an input is from all rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import block_diag

from calib.fit.blocks import block_rows, held_out_blocks
from calib.fit.leastsquares import ridge
from mjx_softarm._support.mlp import Layer, mlp
from mjx_softarm._support.training import Schedule, initial_layers, train_network
from mjx_softarm.sensing.s2r import S2R

RIDGE = 1.0  # prior of the linear map: as strong as a row or two, as inputs are from -1 to 1
N_ANCHORS = 256
LIMIT_PERCENTILE = 99.0


@dataclass(frozen=True)
class NetworkConfig:
    """Hidden layers and training."""

    hidden: tuple[int, ...]
    schedule: Schedule
    line: bool = True  # fit a linear map first, and the network to its residual


# Rows of a log are few and noisy, so weights decay. Learning rate and batch size are the paper's.
OF_ROWS = NetworkConfig((64, 64), Schedule(3_000, 0.01, 128, weight_decay=0.3))
# The mean of a process has no noise.
OF_PROCESS = NetworkConfig((192, 192), Schedule(12_000, 4e-3, 512))
# The paper's network from P and L_spring to P_S2R: Adam with 0.01, batches of 128. The paper leaves layers
# and number of updates open: these are the numbers of `OF_ROWS`.
PRINTED = NetworkConfig((64, 64), Schedule(3_000, 0.01, 128, last_share=1.0), line=False)


class NetworkFit(NamedTuple):
    """Fitted network, and the course of its training."""

    network: S2R
    stop_epoch: int  # epoch whose weights were best on the rows that stop the training
    n_epochs: int


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
        config: hidden layers and training; by default `OF_ROWS`, or `OF_PROCESS` with points.
        points: inputs (m, n_in) and outputs (m, n_out) without noise, which it learns in place of the rows.
    """
    config = config or (OF_ROWS if points is None else OF_PROCESS)
    # Bring the inputs to -1 to 1, and choose anchors.
    bounds = _bounds(x, y)
    low, high = bounds["input_low"], bounds["input_high"]

    def normalised(x: np.ndarray) -> np.ndarray:
        return (2.0 * (x - low) / (high - low) - 1.0).astype(np.float32)

    z, stop = normalised(x), held_out_blocks(len(x), block=block_rows(len(x)), seed=1_000 * seed)
    anchors, limit = _anchors(z, stop)
    if points is not None:
        z, y, stop = np.clip(normalised(points[0]), -1.0, 1.0), points[1], None
    # Fit a linear map, then a network to its residual.
    linear = ridge(z, y, RIDGE)[0] if config.line else np.zeros((z.shape[1], y.shape[1]))
    left = y - z @ linear
    centre, spread = left.mean(axis=0), left.std(axis=0)
    spread = np.where(spread > 0.0, spread, 1.0)
    rows = (np.asarray(z, np.float32), np.asarray((left - centre) / spread, np.float32))
    key_layers, key_rows = jax.random.split(jax.random.key(seed))
    start = initial_layers(key_layers, (z.shape[1], *config.hidden, y.shape[1]))
    layers, losses = train_network(_loss, start, rows, config.schedule, key_rows, stop)
    network = S2R(_with_line(layers, spread, centre, linear), **bounds, anchors=anchors, limit=limit)
    return NetworkFit(network, int(losses.argmin()), len(losses))


def _loss(layers: tuple[Layer, ...], rows: tuple[Array, Array]) -> Array:
    x, y = rows
    return jnp.mean((mlp(layers, x, "relu") - y) ** 2)


def _bounds(x: np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
    """Return ranges of the training rows; an input that never changes gets a width above zero."""
    low, high = (f(x, axis=0).astype(np.float32) for f in (np.min, np.max))
    narrow = high - low <= 1e-5 * np.maximum(np.abs(low), np.abs(high))
    margin = np.where(narrow, np.maximum(1e-3 * np.abs(low), 1e-3), 0.0).astype(np.float32)
    output_low, output_high = (f(y, axis=0).astype(np.float32) for f in (np.min, np.max))
    inputs = {"input_low": low - margin, "input_high": high + margin}
    return inputs | {"output_low": output_low, "output_high": output_high}


def _with_line(
    layers: tuple[Layer, ...], scale: np.ndarray, offset: np.ndarray, linear: np.ndarray
) -> tuple[Layer, ...]:
    """Return a network of `scale` times another's outputs, plus `offset`, plus a linear map of the inputs.

    The inputs z are -1 or more, so z + 1 passes through the rectified layers unchanged.

    Args:
        layers: layers of the other network.
        scale, offset (n_out,): scale and offset of its outputs.
        linear (n_in, n_out): weights of the linear map.
    """
    *hidden, (weight, bias) = layers
    n_in = len(linear)
    joined: list[Layer] = []
    for k, (w, b) in enumerate(hidden):
        passing = np.eye(n_in)  # z + 1
        block = block_diag(w, passing) if k else np.hstack([w, passing])  # both read the same inputs
        joined.append((block, np.append(b, np.full(n_in, float(k == 0)))))
    joined.append((np.vstack([weight * scale, linear]), bias * scale + offset - linear.sum(axis=0)))
    return tuple((np.asarray(w, np.float32), np.asarray(b, np.float32)) for w, b in joined)


def _anchors(z: np.ndarray, left_out: np.ndarray) -> tuple[np.ndarray, np.float32]:
    """Return rows that represent all rows z (n, n_in), and the greatest distance to believe.

    Nearly all left-out rows are within this distance of anchors chosen without them.
    """
    without = _spread_rows(z[~left_out])
    gap = np.min(np.mean((z[left_out, None] - without) ** 2, axis=-1), axis=-1)
    limit = np.sqrt(np.percentile(gap, LIMIT_PERCENTILE))
    return _spread_rows(z), np.float32(max(float(limit), 1e-3))


def _spread_rows(z: np.ndarray) -> np.ndarray:
    """Choose up to N_ANCHORS rows, each the farthest from the rows chosen before."""
    chosen, gap = [0], np.full(len(z), np.inf)
    while len(chosen) < min(N_ANCHORS, len(z)):
        gap = np.minimum(gap, np.mean((z - z[chosen[-1]]) ** 2, axis=-1))
        if gap.max() == 0.0:
            break
        chosen.append(int(gap.argmax()))
    return z[chosen]
