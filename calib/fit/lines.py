"""Robust lines y = slope x / (1 - share x) + offset, straight without a share, with held-out errors.

Optax's L-BFGS minimises Huber's loss, whose scale is that of the residuals: a few gross outliers hardly
matter. One compiled program fits the lines of all columns, and of all held-out folds, at once.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from calib.fit.blocks import block_rows, folds
from calib.fit.leastsquares import SIGMA_PER_MEDIAN, Problem, solution_at
from mjx_softarm._support import xla
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.xp import array_namespace

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
    """y = slope x + offset for each of k columns."""

    slope: np.ndarray  # (k,)
    offset: np.ndarray  # (k,)
    slope_interval: np.ndarray  # (k, 2) of 95 %
    offset_interval: np.ndarray  # (k, 2)
    rms: np.ndarray  # (k,) over all rows, outliers too
    held_out_rms: np.ndarray  # (k,) over all rows, each predicted by a fit without its block
    beyond: np.ndarray  # (k,) share of rows that the fit without their block extrapolates to
    noise: np.ndarray  # (k,) robust standard deviation of the residuals
    n_rows: np.ndarray  # (k,)
    n_outliers: np.ndarray  # (k,) rows that count less than half
    warnings: tuple[str, ...]  # reasons not to trust the fit
    share: float  # curvature of all lines
    share_interval: tuple[float, float]  # 95 %; of no width where the share was not fitted


def fit_line(
    x: np.ndarray,
    y: np.ndarray,
    shared: bool = False,
    seed: int = 0,
    share: float = 0.0,
    fit_share: bool = False,
) -> LineFit:
    """Fit robust lines, straight in x / (1 - share x): one for each column, or one for all columns together.

    Args:
        x (n, k): predictors; an entry that is not finite is a missing one; 1 at most with a share.
        y (n, k): targets; missing entries as in x.
        shared: fit one slope and offset for all columns.
        seed: seed that chooses which blocks form a fold.
        share: curvature of all lines, below 1, or the start of its fit.
        fit_share: fit the curvature, too.

    Raises:
        InputError: the shapes differ, or a column has fewer than 3 rows or one value of x only.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.shape != y.shape or x.ndim != 2:
        raise InputError(f"springs: got tables of shapes {x.shape} and {y.shape}, expected two of one shape")
    n_columns, block = x.shape[1], BLOCK
    if shared:  # rows of one time stay neighbours
        x, y, block = x.reshape(-1, 1), y.reshape(-1, 1), block * n_columns
    known = np.isfinite(x) & np.isfinite(y)
    for k, column in enumerate(known.T):
        if column.sum() < 3 or np.ptp(x[column, k]) == 0 or np.ptp(y[column, k]) == 0:
            raise InputError(
                f"spring{k}: got {column.sum()} rows with a reading and a length, expected 3 or more unlike"
            )
    # Fit the lines to all rows, and to the rows outside of each fold, which predict the fold.
    x, y = np.where(known, x, np.nan), np.where(known, y, np.nan)
    fold = _folds(x, block, seed)
    parts = [known, *(known & (fold != k)[:, None] for k in range(fold.max() + 1))]
    slopes, offsets, shares = _minimise(x, y, np.stack(parts), share, fit_share)
    lines = _with_widths(x, y, slopes[0], offsets[0], shares[0], share, fit_share)
    held_out, beyond = _held_out(x, parts[1:], fold, slopes[1:], offsets[1:], shares[1:])
    # Compare all rows with the lines.
    wire, sides = wire_length(x, lines.share), np.array([-1.0, 1.0])
    residual = y - lines.slope * wire - lines.offset
    found = LineFit(
        slope=lines.slope,
        offset=lines.offset,
        slope_interval=lines.slope[:, None] + lines.slope_width[:, None] * sides,
        offset_interval=lines.offset[:, None] + lines.offset_width[:, None] * sides,
        rms=np.sqrt(np.nanmean(residual**2, 0)),
        held_out_rms=np.sqrt(np.nanmean((y - held_out) ** 2, 0)),
        beyond=beyond.sum(0) / known.sum(0),
        noise=lines.noise,
        n_rows=known.sum(0),
        n_outliers=(np.abs(residual) > DOWN_WEIGHTED * lines.noise).sum(0),
        warnings=(),
        share=lines.share,
        share_interval=(lines.share - lines.share_width, lines.share + lines.share_width),
    )
    warnings = _warnings(found, wire, "all springs " if shared else "spring")
    if shared:
        arrays = {name: value for name, value in found._asdict().items() if isinstance(value, np.ndarray)}
        found = found._replace(
            **{name: np.repeat(value, n_columns, axis=0) for name, value in arrays.items()}
        )
    return found._replace(warnings=warnings)


def wire_length(x: Any, share: Any) -> Any:
    """Return the wire length, but for a factor, from x = w / w_max and share = I_comp w_max."""
    return x / array_namespace(x, share).maximum(1.0 - share * x, 1e-3)


def _held_out(
    x: np.ndarray,
    parts: Sequence[np.ndarray],
    fold: np.ndarray,
    slopes: np.ndarray,
    offsets: np.ndarray,
    shares: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Predict rows x (n, k) by the lines without their fold (n,); mark the rows beyond those lines' rows."""
    predicted, beyond = np.full_like(x, np.nan), np.zeros(x.shape, bool)
    for k, part in enumerate(parts):
        rows = fold == k
        if (part.sum(axis=0) >= 2).all():  # else the warnings report too few rows
            predicted[rows] = slopes[k] * wire_length(x[rows], shares[k]) + offsets[k]
            others = x[~rows]
            low, high = np.nanmin(others, axis=0), np.nanmax(others, axis=0)
            margin = EDGE * (high - low)
            beyond[rows] = (x[rows] < low - margin) | (x[rows] > high + margin)
    return predicted, beyond


def _folds(x: np.ndarray, block: int, seed: int) -> np.ndarray:
    """Return the fold (n,) of each row; all folds reach over the whole range of the columns (n, k)."""
    n = len(x)
    known = np.isfinite(x)
    centred = np.where(known, x - np.nanmean(x, axis=0), 0.0) / np.maximum(np.nanstd(x, axis=0), 1e-300)
    by = centred.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return folds(by, block_rows(n, block), min(5, n), seed)


class _Lines(NamedTuple):
    """Robust lines y = slope x / (1 - share x) + offset; widths are half of the 95 % intervals."""

    slope: np.ndarray  # (k,)
    offset: np.ndarray  # (k,)
    slope_width: np.ndarray  # (k,)
    offset_width: np.ndarray  # (k,)
    noise: np.ndarray  # (k,) robust standard deviation of the residuals
    share: float
    share_width: float  # 0 where it was not fitted


def _minimise(
    x: np.ndarray, y: np.ndarray, parts: np.ndarray, share: float, fit_share: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Minimise Huber's loss by optax: one program for all columns and all parts of the rows.

    Args:
        x, y (n, k): columns, NaN where missing.
        parts (f, n, k) bool: rows of each fit.
        share: curvature of all lines, or the start of its fit.
        fit_share: fit one curvature to all columns together; without it each column is a fit of its own.

    Returns:
        Slopes (f, k), offsets (f, k) and shares (f,).
    """
    # Standardise the targets, and pad the rows, so that logs of several lengths share a program.
    centre, spread = np.nanmean(y, axis=0), _spread(y)
    arrays = [np.where(parts[0], x, 0.0), np.where(parts[0], (y - centre) / spread, 0.0), parts]
    n_fits, pad = len(parts), -len(x) % PADDED_ROWS
    x, y, parts = (np.pad(a, [(0, 0)] * (a.ndim - 2) + [(0, pad), (0, 0)]) for a in arrays)
    if fit_share:
        x, y = x[None], y[None]  # (1, n, k)
    else:
        x, y, parts = (a.swapaxes(-1, -2)[..., None] for a in (x, y, parts))  # (k, n, 1), parts (f, k, n, 1)
        parts = parts.reshape(-1, *x.shape[1:])
    # Fit all lines at once, in double precision.
    with jax.enable_x64(True):
        lines = jax.device_get(_fit_all()(x, y, parts, float(share), float(fit_share)))
    slopes, offsets = (values.reshape(n_fits, -1) for values in lines[:2])
    return slopes * spread, offsets * spread + centre, lines[2].reshape(n_fits, -1)[:, 0]


@functools.cache
def _fit_all() -> Callable[..., tuple[Array, Array, Array]]:
    """Return the compiled `_fit_one` for tables (g, n, c) and parts (f g, n, c) of their rows."""

    def fit_all(x: Array, y: Array, parts: Array, share: Array, fit_share: Array) -> tuple[Array, ...]:
        x, y = (jnp.tile(a, (len(parts) // len(a), 1, 1)) for a in (x, y))
        return jax.vmap(_fit_one, in_axes=(0, 0, 0, None, None))(x, y, parts, share, fit_share)

    return xla.jit(fit_all, "networks")


def _fit_one(
    x: Array, y: Array, known: Array, start_share: Array, fit_share: Array
) -> tuple[Array, Array, Array]:
    """Fit the lines of c columns with a common share.

    Args:
        x, y (n, c): columns; y has unit spread.
        known (n, c) bool: entries that take part.
        start_share (): share, or start of its fit.
        fit_share (): 1 to fit the share, 0 to keep it.

    Returns:
        Slopes (c,), offsets (c,) and share ().
    """
    count, c = jnp.maximum(known.sum(axis=0), 1), x.shape[1]

    def lines(p: Array) -> tuple[Array, Array, Array, Array]:
        """Return slopes, offsets, share and errors (n, c); p (2 c + 1,) is in standardised wire lengths."""
        share = start_share + fit_share * p[2 * c]
        wire = wire_length(x, share)
        mean = jnp.sum(known * wire, axis=0) / count
        spread = jnp.sqrt(jnp.maximum(jnp.sum(known * (wire - mean) ** 2, axis=0) / count, 1e-300))
        slope = p[:c] / spread
        offset = p[c : 2 * c] - slope * mean
        return slope, offset, share, jnp.where(known, slope * wire + offset - y, 0.0)

    def descend(p: Array, scale: Array) -> Array:
        """Minimise the loss from p by L-BFGS, with scales (c,) of the errors that stay."""

        def loss(p: Array) -> Array:
            huber = optax.losses.huber_loss(lines(p)[3] / scale, delta=HUBER)
            return jnp.min(scale) ** 2 * (jnp.sum(huber) + 0.5 * jnp.sum((p / PRIOR) ** 2)) / jnp.sum(count)

        optimiser = optax.lbfgs(linesearch=optax.scale_by_backtracking_linesearch(20))

        def iterate(carry: tuple) -> tuple:
            p, state, n_done, _ = carry
            value, gradient = jax.value_and_grad(loss)(p)
            step, state = optimiser.update(gradient, state, p, value=value, grad=gradient, value_fn=loss)
            return optax.apply_updates(p, step), state, n_done + 1, optax.tree.norm(step)

        start, goal = (p, optimiser.init(p), 0, jnp.inf), SMALL_STEP * jnp.min(scale)
        return jax.lax.while_loop(lambda c: (c[2] < ITERATIONS) & (c[3] > goal), iterate, start)[0]

    def next_round(carry: tuple) -> tuple:
        p, scale, n_done, _ = carry
        p = descend(p, scale)
        size = jnp.nanmedian(jnp.where(known, jnp.abs(lines(p)[3]), jnp.nan), axis=0)
        next_scale = jnp.maximum(jnp.nan_to_num(SIGMA_PER_MEDIAN * size), MIN_SCALE)
        return p, next_scale, n_done + 1, jnp.max(jnp.abs(next_scale / scale - 1.0))

    # Least squares come first, then Huber's loss with the scale of the residuals of the round before.
    first = jnp.zeros(2 * c + 1), jnp.full(c, 1e3), 0, jnp.inf
    p = jax.lax.while_loop(lambda c: (c[2] < ROUNDS) & (c[3] > SAME_SCALE), next_round, first)[0]
    return lines(p)[:3]


def _with_widths(
    x: np.ndarray,
    y: np.ndarray,
    slope: np.ndarray,
    offset: np.ndarray,
    share: float,
    start_share: float,
    fit_share: bool,
) -> _Lines:
    """Return fitted lines of columns x, y (n, k) with their noise and the widths of their intervals."""
    k = x.shape[1]
    if not fit_share and k > 1:
        columns = zip(x.T[..., None], y.T[..., None], slope[:, None], offset[:, None], strict=True)
        each = [_with_widths(*column, share, start_share, False) for column in columns]
        slope, offset, slope_width, offset_width, noise = (
            np.concatenate(values) for values in list(zip(*each, strict=True))[:5]
        )
        return _Lines(slope, offset, slope_width, offset_width, noise, share, 0.0)
    # Standardise the columns; parameters are slopes, offsets and, if fitted, the share.
    wire, y_spread = np.where(np.isfinite(y), wire_length(x, share), np.nan), _spread(y)
    centre, spread = np.nanmean(wire, axis=0), _spread(wire)
    z, unit = (wire - centre) / spread, np.eye(k)
    p = np.concatenate(
        [slope * spread / y_spread, (offset + slope * centre - np.nanmean(y, axis=0)) / y_spread]
    )
    jacobian = [z[..., None] * unit, np.broadcast_to(unit, (*z.shape, k))]
    if fit_share:
        jacobian.append((p[:k] * wire**2 / spread)[..., None])
        p = np.append(p, share - start_share)
    # Stretches of neighbouring rows are clusters.
    problem = Problem(
        prior=np.full(len(p), PRIOR),
        group=np.tile(np.arange(k), -(-len(x) // min(STRETCHES, len(x)))),
        scale=np.ones(k),
        min_scale=np.full(k, MIN_SCALE),
        huber=HUBER,
    )
    error = (slope * wire + offset - y) / y_spread
    solution = solution_at(p, _stretches(error), _stretches(np.concatenate(jacobian, axis=-1)), problem)
    # Derivatives of slopes, offsets and share by the parameters.
    change = np.zeros((2 * k + 1, len(p)))
    change[:k, :k] = np.diag(1.0 / spread)
    change[k : 2 * k, :k] = np.diag(-centre / spread)
    change[k : 2 * k, k : 2 * k] = unit
    change[2 * k :, 2 * k :] = 1.0
    width = STUDENT * np.sqrt(np.einsum("ip,pq,iq->i", change, solution.covariance, change))
    widths = y_spread * width[:k], y_spread * width[k : 2 * k]
    return _Lines(slope, offset, *widths, y_spread * solution.scale, share, float(width[-1]))


def _spread(values: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each column (n, k), above zero."""
    return np.maximum(np.nanstd(values, axis=0), 1e-300)


def _stretches(table: np.ndarray) -> np.ndarray:
    """Cut (n, k, ...) into stretches of neighbouring rows (n_stretches, n_rows k, ...), NaN at their ends."""
    pieces = np.array_split(table, min(STRETCHES, len(table)))
    padded = np.full((len(pieces), len(pieces[0]), *table.shape[1:]), np.nan)
    for row, piece in zip(padded, pieces, strict=True):
        row[: len(piece)] = piece
    return padded.reshape(len(pieces), -1, *table.shape[2:])


def _warnings(fit: LineFit, wire: np.ndarray, name: str) -> tuple[str, ...]:
    """Return reasons not to trust lines of wire lengths (n, k), each with its remedy."""
    found = []
    for k in range(len(fit.slope)):
        n, held_out, noise, rms = fit.n_rows[k], fit.held_out_rms[k], fit.noise[k], fit.rms[k]
        range_y = abs(fit.slope[k]) * np.nanstd(wire[:, k])
        width = np.ptp(fit.slope_interval[k]) / 2 / abs(fit.slope[k])
        reasons = {
            f"got {n} rows, expected {MIN_ROWS} or more: measure more": n < MIN_ROWS,
            f"lengths spread by {range_y:.3g} only, noise being {noise:.3g}, so slope and offset can hardly "
            "be separated: measure over the whole range": range_y < 5 * noise,
            f"held-out error {held_out:.3g} extrapolates in {100 * fit.beyond[k]:.0f} % of rows: measure the "
            "shortest and the longest lengths more than once, at different times": fit.beyond[k] > MAX_BEYOND,
            f"held-out error {held_out:.3g}, on its own rows {rms:.3g}: measure more rows, in random order": (
                not held_out < 1.5 * rms
            ),
            f"slope known to {100 * width:.2g} % only: measure more rows, over a wider range": (
                not width < 0.02
            ),
            f"{fit.n_outliers[k]} of {n} rows are outliers of a straight line: look for lengths of another "
            "spring or another time": fit.n_outliers[k] > 0.1 * n,
        }
        found += [f"{name}{k}: {reason}" for reason, holds in reasons.items() if holds]
    return tuple(found)
