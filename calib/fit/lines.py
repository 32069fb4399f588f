"""Robust straight lines y = slope x + offset, with intervals and held-out errors.

Optax's L-BFGS minimises Huber's loss, whose scale comes from the residuals, so that a few gross outliers
hardly matter. Intervals take stretches of neighbouring rows as one piece of evidence each, since neighbouring
rows of a log err alike.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from calib.errors import FitError
from calib.fit.blocks import folds
from calib.fit.huber_line import HUBER, descend, wire_length
from calib.fit.leastsquares import Problem, solution_at

DOWN_WEIGHTED = 2 * HUBER  # beyond it a row counts less than half
PRIOR = 10.0  # of the parameters of normalised columns: next to nothing
STRETCHES = 50  # of neighbouring rows, for the intervals
STUDENT = 2.0096  # 97.5 % quantile for STRETCHES - 1 degrees of freedom
MIN_ROWS = 50
MIN_BLOCKS = 20  # of which folds are made: shorter blocks rather than fewer
EDGE = 0.05  # of the range of the other rows, beyond which a held-out row is extrapolated to
MAX_BEYOND = 0.02  # share of such rows that is worth a warning


class LineFit(NamedTuple):
    """y = slope x + offset for each of k columns."""

    slope: np.ndarray  # (k,)
    offset: np.ndarray  # (k,)
    slope_interval: np.ndarray  # (k, 2) of 95 %
    offset_interval: np.ndarray  # (k, 2)
    rms: np.ndarray  # (k,) over all rows, outliers too
    held_out_rms: np.ndarray  # (k,) over all rows, each predicted by a fit without its block
    beyond: np.ndarray  # (k,) share of rows that this fit had to extrapolate to
    noise: np.ndarray  # (k,) robust standard deviation of the residuals
    n_rows: np.ndarray  # (k,)
    n_outliers: np.ndarray  # (k,) rows that count less than half
    warnings: tuple[str, ...]  # reasons not to trust the fit


def fit_line(
    x: np.ndarray, y: np.ndarray, name: str = "column", shared: bool = False, block: int = 100, seed: int = 0
) -> LineFit:
    """Fit robust straight lines: one for each column, or one for all columns together.

    Args:
        x (n, k): predictors; an entry that is not finite is a missing one.
        y (n, k): targets; missing entries as in x.
        name: name of a column in messages; its number follows.
        shared: fit one slope and offset for all columns.
        block: rows that are held out together.
        seed: seed that chooses which blocks form a fold.

    Raises:
        FitError: the shapes differ, or a column has fewer than 3 rows or one value of x only.
    """
    return fit_curved_line(x, y, 0.0, False, name, shared, block, seed)[0]


def fit_curved_line(
    x: np.ndarray,
    y: np.ndarray,
    share: float,
    fit_share: bool,
    name: str,
    shared: bool,
    block: int,
    seed: int,
) -> tuple[LineFit, float, float]:
    """Fit lines in x / (1 - share x); arguments as in `fit_line`.

    Args:
        x (n, k), y (n, k): predictors and targets.
        share: the curvature, or where its fit starts; x is 1 at most, share below 1.
        fit_share: fit the curvature, too, one for all columns.

    Returns:
        The lines; the share; the half-width of its 95 % interval.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.shape != y.shape or x.ndim != 2:
        raise FitError(f"{name}s: got tables of shapes {x.shape} and {y.shape}, expected two of one shape")
    n_columns = x.shape[1]
    if shared:  # rows of one time stay neighbours
        x, y, block = x.reshape(-1, 1), y.reshape(-1, 1), block * n_columns
    known = np.isfinite(x) & np.isfinite(y)
    for k, column in enumerate(known.T):
        if column.sum() < 3 or np.ptp(x[column, k]) == 0 or np.ptp(y[column, k]) == 0:
            raise FitError(
                f"{name}{k}: got {column.sum()} rows with a reading and a length, expected 3 or more unlike"
            )
    x, y = np.where(known, x, np.nan), np.where(known, y, np.nan)
    lines = _robust_lines(x, y, share, fit_share)
    # Predict each row by a fit that has not seen its block.
    held_out, beyond, fold = np.full_like(y, np.nan), np.zeros(y.shape, bool), _folds(x, block, seed)
    for k in range(fold.max() + 1):
        out = fold == k
        if (known[~out].sum(axis=0) >= 2).all():  # else the warnings say that there are too few rows
            others = _robust_lines(x, np.where(out[:, None], np.nan, y), share, fit_share)
            held_out[out] = others.slope * wire_length(x[out], others.share) + others.offset
            seen = np.where(known[~out], x[~out], np.nan)
            low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
            margin = EDGE * (high - low)
            beyond[out] = (x[out] < low - margin) | (x[out] > high + margin)
    wire = wire_length(x, lines.share)
    residual = y - lines.slope * wire - lines.offset
    fit = LineFit(
        slope=lines.slope,
        offset=lines.offset,
        slope_interval=lines.slope[:, None] + lines.half_width[0][:, None] * [-1, 1],
        offset_interval=lines.offset[:, None] + lines.half_width[1][:, None] * [-1, 1],
        rms=np.sqrt(np.nanmean(residual**2, 0)),
        held_out_rms=np.sqrt(np.nanmean((y - held_out) ** 2, 0)),
        beyond=beyond.sum(0) / known.sum(0),
        noise=lines.noise,
        n_rows=known.sum(0),
        n_outliers=(np.abs(residual) > DOWN_WEIGHTED * lines.noise).sum(0),
        warnings=(),
    )
    fit = fit._replace(warnings=_warnings(fit, wire, f"all {name}s " if shared else name))
    if shared:
        fit = LineFit(*(np.repeat(value, n_columns, axis=0) for value in fit[:-1]), warnings=fit.warnings)
    return fit, lines.share, lines.share_half_width


def _folds(x: np.ndarray, block: int, seed: int) -> np.ndarray:
    """Return the fold (n,) of each row; all folds reach over the whole range of the columns (n, k)."""
    n = len(x)
    known = np.isfinite(x)
    centred = np.where(known, x - np.nanmean(x, axis=0), 0.0) / np.maximum(np.nanstd(x, axis=0), 1e-300)
    block = max(min(block, n // MIN_BLOCKS), 1)
    return folds(n, block, min(5, n), seed, centred.sum(axis=1) / np.maximum(known.sum(axis=1), 1))


class _Lines(NamedTuple):
    """Robust lines y = slope x / (1 - share x) + offset."""

    slope: np.ndarray  # (k,)
    offset: np.ndarray  # (k,)
    half_width: np.ndarray  # (2, k) of the 95 % intervals of slope and offset
    noise: np.ndarray  # (k,) robust standard deviation of the residuals
    share: float
    share_half_width: float  # 0 where it was not fitted


def _robust_lines(x: np.ndarray, y: np.ndarray, share: float, fit_share: bool) -> _Lines:
    """Fit columns x, y (n, k), NaN where missing: each by itself, or together where they share a number."""
    if not fit_share and x.shape[1] > 1:
        each = [_robust_lines(x[:, [k]], y[:, [k]], share, False) for k in range(x.shape[1])]
        slope, offset, half_width, noise, *_ = zip(*each, strict=True)
        joined = (np.concatenate(slope), np.concatenate(offset), np.concatenate(half_width, axis=1))
        return _Lines(*joined, np.concatenate(noise), share, 0.0)
    k = x.shape[1]
    # Normalise the columns, and cut them into stretches: (n_stretches, n_rows, k).
    wire = wire_length(x, share)
    centre, y_centre = np.nanmean(wire, axis=0), np.nanmean(y, axis=0)
    spread, y_spread = (np.maximum(np.nanstd(table, axis=0), 1e-300) for table in (wire, y))
    x, y = (_stretches(table) for table in (x, (y - y_centre) / y_spread))

    def model(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope, offset, now = p[:k], p[k : 2 * k], share + p[2 * k :].sum()
        wire = wire_length(x, now)
        z = (wire - centre) / spread
        jacobian = np.zeros((*x.shape, len(p)))
        for j in range(k):
            jacobian[..., j, j], jacobian[..., j, k + j] = z[..., j], 1.0
        if fit_share:
            jacobian[..., -1] = slope * wire**2 / spread
        error = slope * z + offset - y
        return error.reshape(len(x), -1), jacobian.reshape(len(x), -1, len(p))

    n_parameters = 2 * k + fit_share
    problem = Problem(
        prior=np.full(n_parameters, PRIOR),
        group=np.tile(np.arange(k), x.shape[1]),
        scale=np.ones(k),
        min_scale=np.full(k, 1e-9),
        huber=HUBER,
    )
    with jax.enable_x64(True):
        start = np.asarray(descend(x.reshape(-1, k), y.reshape(-1, k), share, fit_share))
    slope, offset = start[:k], start[k : 2 * k]
    p = np.concatenate([slope * spread, offset + slope * centre, start[2 * k :]])
    found = solution_at(p, *model(p), problem)
    slope, offset = y_spread * found.x[:k] / spread, y_spread * found.x[k : 2 * k]
    variance, lever = np.diag(found.covariance), centre / spread
    both = np.diag(found.covariance[:k, k : 2 * k])
    deviations = np.sqrt([variance[:k], variance[k : 2 * k] + lever**2 * variance[:k] - 2 * lever * both])
    return _Lines(
        slope,
        y_centre + offset - slope * centre,
        STUDENT * deviations * y_spread / [spread, np.ones(k)],
        found.scale * y_spread,
        share + float(found.x[2 * k :].sum()),
        STUDENT * float(np.sqrt(variance[2 * k :].sum())),
    )


def _stretches(table: np.ndarray) -> np.ndarray:
    """Cut (n, k) into stretches of neighbouring rows (n_stretches, n_rows, k), NaN at their ends."""
    pieces = np.array_split(table, min(STRETCHES, len(table)))
    longest = len(pieces[0])
    return np.stack([np.pad(p, ((0, longest - len(p)), (0, 0)), constant_values=np.nan) for p in pieces])


def _warnings(fit: LineFit, x: np.ndarray, name: str) -> tuple[str, ...]:
    found = []
    for k in range(len(fit.slope)):
        range_y = abs(fit.slope[k]) * np.nanstd(x[:, k])
        width = np.ptp(fit.slope_interval[k]) / 2 / abs(fit.slope[k])
        for bad, reason in (
            (
                fit.n_rows[k] < MIN_ROWS,
                f"got {fit.n_rows[k]} rows, expected {MIN_ROWS} or more: measure more",
            ),
            (
                range_y < 5 * fit.noise[k],
                f"lengths spread by {range_y:.3g} only, noise being {fit.noise[k]:.3g}, so slope and offset "
                "can hardly be told apart: measure over the whole range",
            ),
            (
                fit.beyond[k] > MAX_BEYOND,
                f"held-out error {fit.held_out_rms[k]:.3g} extrapolates in {100 * fit.beyond[k]:.0f} % of "
                "rows: measure the shortest and the longest lengths more than once, at different times",
            ),
            (
                not fit.held_out_rms[k] < 1.5 * fit.rms[k],
                f"held-out error {fit.held_out_rms[k]:.3g}, on its own rows {fit.rms[k]:.3g}: "
                "measure more rows, in random order",
            ),
            (
                not width < 0.02,
                f"slope known to {100 * width:.2g} % only: measure more rows, over a wider range",
            ),
            (
                fit.n_outliers[k] > 0.1 * fit.n_rows[k],
                f"{fit.n_outliers[k]} of {fit.n_rows[k]} rows are outliers of a straight line: "
                "look for lengths of another spring or another time",
            ),
        ):
            if bad:
                found.append(f"{name}{k}: {reason}")
    return tuple(found)
