"""Calibration of the springs: L = beta l + delta, L a measured length and l the raw length of a reading.

Each spring has a robust line, with held-out errors. Optax's L-BFGS minimises Huber's loss, whose scale is
that of the residuals: a few gross outliers hardly matter. One compiled program fits the lines of all springs,
and of all held-out folds, at once.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from calib.fit.blocks import block_rows, folds
from calib.fit.leastsquares import SIGMA_PER_MEDIAN, Problem, solution_at
from mjx_softarm._support import xla
from mjx_softarm._support.errors import InputError
from mjx_softarm.sensing.sensors import Sensor

HUBER = 1.345  # standard deviations of the noise; 95 % of the efficiency of least squares
DOWN_WEIGHTED = 2 * HUBER  # error from which a row counts less than half
ROUNDS, SAME_SCALE = 20, 1e-5  # most rounds of a fit, and the relative change of the scale that ends them
ITERATIONS, SMALL_STEP = 60, 1e-8  # most iterations of L-BFGS in a round; step, in scales, that ends them
MIN_SCALE = 1e-9  # least scale of standardised errors
PADDED_ROWS = 1_024  # tables are padded to a multiple of it
PRIOR = 10.0  # standard deviation of standardised parameters: next to no prior
STRETCHES = 50  # clusters of the intervals: neighbouring rows err alike
STUDENT = 2.0096  # 97.5 % quantile for STRETCHES - 1 degrees of freedom
MIN_ROWS = 50
BLOCK = 100  # rows of one spring that are held out together
EDGE = 0.05  # share of the range of the other rows by which a held-out row may exceed it
MAX_BEYOND = 0.02  # share of held-out rows beyond the range from which there is a warning


class LineFit(NamedTuple):
    """y = slope x + offset for each of k columns; of springs, the slope is beta and the offset delta [m]."""

    slope: np.ndarray  # (k,)
    offset: np.ndarray  # (k,)
    slope_width: np.ndarray  # (k,) half-width of the 95 % interval
    offset_width: np.ndarray  # (k,) half-width of the 95 % interval
    rms: np.ndarray  # (k,) over all rows, outliers too
    held_out_rms: np.ndarray  # (k,) over all rows, each predicted by a fit without its block
    beyond: np.ndarray  # (k,) share of rows that the fit without their block extrapolates to
    noise: np.ndarray  # (k,) robust standard deviation of the residuals
    n_rows: np.ndarray  # (k,)
    n_outliers: np.ndarray  # (k,) rows that count less than half
    warnings: tuple[str, ...] = ()  # reasons not to trust the fit, each with its remedy


def fit_springs(readings: np.ndarray, length_m: np.ndarray, sensor: Sensor, seed: int = 0) -> LineFit:
    """Calibrate springs from readings and the lengths that were measured at them.

    Args:
        readings (n, n_springs): readings; readings outside the sensor's range are left out.
        length_m (n, n_springs): measured lengths, NaN where there is none.
        sensor: sensor that gave the readings; its beta and delta are not used.
        seed: seed that chooses which blocks of rows are held out together.

    Raises:
        InputError: the shapes differ, or a spring has fewer than 3 rows or one reading only.
    """
    readings = np.asarray(readings, float)
    low, high = sensor.range
    believed = (readings >= low) & (readings <= high)
    raw_m, exists = sensor.raw_length(np.where(believed, readings, low))
    return fit_line(np.where(believed & exists, raw_m, np.nan), length_m, seed)


def fit_line(x: np.ndarray, y: np.ndarray, seed: int = 0) -> LineFit:
    """Fit a robust line to each column.

    Args:
        x (n, k): predictors; an entry that is not finite is a missing one.
        y (n, k): targets; missing entries as in x.
        seed: seed that chooses which blocks form a fold.

    Raises:
        InputError: the shapes differ, or a column has fewer than 3 rows or one value of x only.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.shape != y.shape or x.ndim != 2:
        raise InputError(f"springs: got tables of shapes {x.shape} and {y.shape}, expected two of one shape")
    known = np.isfinite(x) & np.isfinite(y)
    for k, column in enumerate(known.T):
        if column.sum() < 3 or np.ptp(x[column, k]) == 0 or np.ptp(y[column, k]) == 0:
            raise InputError(
                f"spring{k}: got {column.sum()} rows with a reading and a length, expected 3 or more unlike"
            )
    # Fit the lines to all rows, and to the rows outside of each fold, which predict the fold.
    x, y = np.where(known, x, np.nan), np.where(known, y, np.nan)
    fold = _folds(x, seed)
    parts = [known, *(known & (fold != k)[:, None] for k in range(fold.max() + 1))]
    slopes, offsets = _minimise(x, y, np.stack(parts))
    slope, offset = slopes[0], offsets[0]
    columns = zip(x.T, y.T, slope, offset, strict=True)
    slope_width, offset_width, noise = np.transpose([_widths(*column) for column in columns])
    held_out, beyond = _held_out(x, parts[1:], fold, slopes[1:], offsets[1:])
    # Compare all rows with the lines.
    residual = y - slope * x - offset
    fit = LineFit(
        slope=slope,
        offset=offset,
        slope_width=slope_width,
        offset_width=offset_width,
        rms=np.sqrt(np.nanmean(residual**2, 0)),
        held_out_rms=np.sqrt(np.nanmean((y - held_out) ** 2, 0)),
        beyond=beyond.sum(0) / known.sum(0),
        noise=noise,
        n_rows=known.sum(0),
        n_outliers=(np.abs(residual) > DOWN_WEIGHTED * noise).sum(0),
    )
    return fit._replace(warnings=_warnings(fit, np.nanstd(x, axis=0)))


def _held_out(
    x: np.ndarray, parts: Sequence[np.ndarray], fold: np.ndarray, slopes: np.ndarray, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Predict rows x (n, k) by the lines without their fold (n,); mark the rows beyond those lines' rows."""
    predicted, beyond = np.full_like(x, np.nan), np.zeros(x.shape, bool)
    for k, part in enumerate(parts):
        rows = fold == k
        if (part.sum(axis=0) >= 2).all():  # else the warnings report too few rows
            predicted[rows] = slopes[k] * x[rows] + offsets[k]
            others = x[~rows]
            low, high = np.nanmin(others, axis=0), np.nanmax(others, axis=0)
            margin = EDGE * (high - low)
            beyond[rows] = (x[rows] < low - margin) | (x[rows] > high + margin)
    return predicted, beyond


def _folds(x: np.ndarray, seed: int) -> np.ndarray:
    """Return the fold (n,) of each row; all folds reach over the whole range of the columns (n, k)."""
    n = len(x)
    known = np.isfinite(x)
    centred = np.where(known, x - np.nanmean(x, axis=0), 0.0) / _spread(x)
    by = centred.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return folds(by, block_rows(n, BLOCK), min(5, n), seed)


def _minimise(x: np.ndarray, y: np.ndarray, parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimise Huber's loss by optax: one program for all columns and all parts of the rows.

    Args:
        x, y (n, k): columns, NaN where missing.
        parts (f, n, k) bool: rows of each fit.

    Returns:
        Slopes (f, k) and offsets (f, k).
    """
    # Standardise the targets, and pad the rows, so that logs of several lengths share a program.
    centre, spread = np.nanmean(y, axis=0), _spread(y)
    tables = np.where(parts[0], x, 0.0), np.where(parts[0], (y - centre) / spread, 0.0), parts
    ahead, pad = ((0, 0), (0, 0)), (0, -len(x) % PADDED_ROWS)
    columns = (np.pad(table.swapaxes(-1, -2), (*ahead[: table.ndim - 1], pad)) for table in tables)
    # Fit all lines at once, in double precision.
    with jax.enable_x64(True):
        slopes, offsets = jax.device_get(_fit_all()(*columns))
    return slopes * spread, offsets * spread + centre


@functools.cache
def _fit_all() -> Callable[..., tuple[Array, Array]]:
    """Return the compiled `_fit_one` for columns (k, n) and parts (f, k, n) of their rows."""
    return xla.jit(jax.vmap(jax.vmap(_fit_one), in_axes=(None, None, 0)), "networks")


def _fit_one(x: Array, y: Array, known: Array) -> tuple[Array, Array]:
    """Return slope () and offset () of the line of y by x (n,) at the known entries; y has unit spread."""
    count = jnp.maximum(known.sum(), 1)
    mean = jnp.sum(known * x) / count
    spread = jnp.sqrt(jnp.maximum(jnp.sum(known * (x - mean) ** 2) / count, 1e-300))

    def line(p: Array) -> tuple[Array, Array, Array]:
        """Return slope, offset and errors (n,); p (2,) is in standardised predictors."""
        slope = p[0] / spread
        offset = p[1] - slope * mean
        return slope, offset, jnp.where(known, slope * x + offset - y, 0.0)

    def descend(p: Array, scale: Array) -> Array:
        """Minimise the loss from p by L-BFGS, with a scale () of the errors that stays."""

        def loss(p: Array) -> Array:
            huber = optax.losses.huber_loss(line(p)[2] / scale, delta=HUBER)
            return scale**2 * (jnp.sum(huber) + 0.5 * jnp.sum((p / PRIOR) ** 2)) / count

        optimiser = optax.lbfgs(linesearch=optax.scale_by_backtracking_linesearch(20))

        def iterate(carry: tuple) -> tuple:
            p, state, n_done, _ = carry
            value, gradient = jax.value_and_grad(loss)(p)
            step, state = optimiser.update(gradient, state, p, value=value, grad=gradient, value_fn=loss)
            return optax.apply_updates(p, step), state, n_done + 1, optax.tree.norm(step)

        start, goal = (p, optimiser.init(p), 0, jnp.inf), SMALL_STEP * scale
        return jax.lax.while_loop(lambda c: (c[2] < ITERATIONS) & (c[3] > goal), iterate, start)[0]

    def next_round(carry: tuple) -> tuple:
        p, scale, n_done, _ = carry
        p = descend(p, scale)
        size = jnp.nanmedian(jnp.where(known, jnp.abs(line(p)[2]), jnp.nan))
        next_scale = jnp.maximum(jnp.nan_to_num(SIGMA_PER_MEDIAN * size), MIN_SCALE)
        return p, next_scale, n_done + 1, jnp.abs(next_scale / scale - 1.0)

    # Least squares come first, then Huber's loss with the scale of the residuals of the round before.
    first = jnp.zeros(2), jnp.asarray(1e3), 0, jnp.inf
    p = jax.lax.while_loop(lambda c: (c[2] < ROUNDS) & (c[3] > SAME_SCALE), next_round, first)[0]
    return line(p)[:2]


def _widths(x: np.ndarray, y: np.ndarray, slope: float, offset: float) -> tuple[float, float, float]:
    """Return half-widths of a line's slope and offset, and the noise of its column x, y (n,)."""
    # Parameters are slope and offset of the standardised column; stretches of neighbouring rows are clusters.
    centre, spread, y_spread = np.nanmean(x), _spread(x), _spread(y)
    z, error = (x - centre) / spread, (slope * x + offset - y) / y_spread
    p = np.array([slope * spread, offset + slope * centre - np.nanmean(y)]) / y_spread
    problem = Problem(
        prior=np.full(2, PRIOR),
        group=np.zeros(-(-len(x) // min(STRETCHES, len(x))), int),
        scale=np.ones(1),
        min_scale=np.full(1, MIN_SCALE),
        huber=HUBER,
    )
    jacobian = np.stack([z, np.ones_like(z)], axis=-1)
    solution = solution_at(p, _stretches(error), _stretches(jacobian), problem)
    # Derivatives of slope and offset by the parameters.
    change = np.array([[1.0 / spread, 0.0], [-centre / spread, 1.0]])
    widths = STUDENT * np.sqrt(np.einsum("ip,pq,iq->i", change, solution.covariance, change))
    return *(y_spread * widths), y_spread * solution.scale[0]


def _spread(values: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each column (n, ...), above zero."""
    return np.maximum(np.nanstd(values, axis=0), 1e-300)


def _stretches(table: np.ndarray) -> np.ndarray:
    """Cut (n, ...) into stretches of neighbouring rows (n_stretches, n_rows, ...), NaN at their ends."""
    pieces = np.array_split(table, min(STRETCHES, len(table)))
    padded = np.full((len(pieces), len(pieces[0]), *table.shape[1:]), np.nan)
    for row, piece in zip(padded, pieces, strict=True):
        row[: len(piece)] = piece
    return padded


def _warnings(fit: LineFit, spread: np.ndarray) -> tuple[str, ...]:
    """Return reasons not to trust the lines, each with its remedy; predictors spread by (k,)."""
    warnings = []
    for k in range(len(fit.slope)):
        n = fit.n_rows[k]
        held_out, noise, rms = (1e3 * error[k] for error in (fit.held_out_rms, fit.noise, fit.rms))  # [mm]
        range_y = 1e3 * abs(fit.slope[k]) * spread[k]
        width = fit.slope_width[k] / abs(fit.slope[k])
        reasons = {
            f"got {n} rows, expected {MIN_ROWS} or more: measure more": n < MIN_ROWS,
            f"lengths spread by {range_y:.3g} mm only, noise being {noise:.3g} mm, so slope and offset can "
            "hardly be separated: measure over the whole range": range_y < 5 * noise,
            f"held-out error {held_out:.3g} mm extrapolates in {100 * fit.beyond[k]:.0f} % of rows: measure "
            "the shortest and longest lengths more than once, at different times": fit.beyond[k] > MAX_BEYOND,
            f"held-out error {held_out:.3g} mm, on its own rows {rms:.3g} mm: measure more, at random": (
                not held_out < 1.5 * rms
            ),
            f"slope known to {100 * width:.2g} % only: measure more rows, over a wider range": (
                not width < 0.02
            ),
            f"{fit.n_outliers[k]} of {n} rows are outliers of a straight line: look for lengths of another "
            "spring or another time": fit.n_outliers[k] > 0.1 * n,
        }
        warnings += [f"spring{k}: {reason}" for reason, holds in reasons.items() if holds]
    return tuple(warnings)
