"""Robust lines y = slope x / (1 - share x) + offset, straight without a share, with held-out errors.

Huber's loss has the scale of the residuals (`calib.fit.leastsquares`): a few gross outliers hardly matter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.errors import FitError
from calib.fit.blocks import block_rows, folds
from calib.fit.leastsquares import Problem, fit

HUBER = 1.345  # standard deviations of the noise; 95 % of the efficiency of least squares
DOWN_WEIGHTED = 2 * HUBER  # error from which a row counts less than half
ROUNDS = ("linear", *["huber"] * 4)  # losses; each round has the scale of the round before
TOLERANCES = {"max_nfev": 15, "ftol": 1e-9, "xtol": 1e-7, "gtol": None}  # end of a round
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
        FitError: the shapes differ, or a column has fewer than 3 rows or one value of x only.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.shape != y.shape or x.ndim != 2:
        raise FitError(f"springs: got tables of shapes {x.shape} and {y.shape}, expected two of one shape")
    n_columns, block = x.shape[1], BLOCK
    if shared:  # rows of one time stay neighbours
        x, y, block = x.reshape(-1, 1), y.reshape(-1, 1), block * n_columns
    known = np.isfinite(x) & np.isfinite(y)
    for k, column in enumerate(known.T):
        if column.sum() < 3 or np.ptp(x[column, k]) == 0 or np.ptp(y[column, k]) == 0:
            raise FitError(
                f"spring{k}: got {column.sum()} rows with a reading and a length, expected 3 or more unlike"
            )
    # Fit the lines, and predict each row by lines that have not seen its block.
    x, y = np.where(known, x, np.nan), np.where(known, y, np.nan)
    lines = _robust_lines(x, y, share, fit_share)
    held_out, beyond = _held_out(x, y, _folds(x, block, seed), share, fit_share)
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


def wire_length(x: np.ndarray, share: float) -> np.ndarray:
    """Return the wire length, but for a factor, from x = w / w_max and share = I_comp w_max."""
    return x / np.maximum(1.0 - share * x, 1e-3)


def _held_out(
    x: np.ndarray, y: np.ndarray, fold: np.ndarray, share: float, fit_share: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Predict each row by a fit without its fold (n,); return also whether it is beyond that fit's rows."""
    predicted, beyond, known = np.full_like(y, np.nan), np.zeros(y.shape, bool), np.isfinite(y)
    for k in range(fold.max() + 1):
        out = fold == k
        if (known[~out].sum(axis=0) >= 2).all():  # else the warnings say that there are too few rows
            others = _robust_lines(x, np.where(out[:, None], np.nan, y), share, fit_share)
            predicted[out] = others.slope * wire_length(x[out], others.share) + others.offset
            seen = x[~out]
            low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
            margin = EDGE * (high - low)
            beyond[out] = (x[out] < low - margin) | (x[out] > high + margin)
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


def _robust_lines(x: np.ndarray, y: np.ndarray, share: float, fit_share: bool) -> _Lines:
    """Fit columns x, y (n, k), NaN where missing: each by itself, or together where they share a number."""
    k = x.shape[1]
    if not fit_share and k > 1:
        each = [_robust_lines(x[:, [j]], y[:, [j]], share, False) for j in range(k)]
        columns = (np.concatenate(values) for values in list(zip(*each, strict=True))[:5])
        return _Lines(*columns, share=share, share_width=0.0)
    # Standardise the columns at the share of the start.
    wire, y_centre, y_spread = wire_length(x, share), np.nanmean(y, axis=0), _spread(y)
    wire = np.where(np.isfinite(y), wire, np.nan)
    centre, spread, target = np.nanmean(wire, axis=0), _spread(wire), (y - y_centre) / y_spread
    own = np.eye(k)

    def model(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors and Jacobian by slopes (k,), offsets (k,) and, if fitted, the share's change."""
        bent = wire_length(x, share + p[2 * k :].sum())
        z = (bent - centre) / spread
        by_share = (p[:k] * bent**2 / spread)[..., None]
        jacobian = [z[..., None] * own, np.broadcast_to(own, (*z.shape, k)), by_share[..., : len(p) - 2 * k]]
        return _stretches(p[:k] * z + p[k : 2 * k] - target), _stretches(np.concatenate(jacobian, axis=-1))

    # Fit them; stretches of neighbouring rows are clusters.
    n_parameters = 2 * k + fit_share
    problem = Problem(
        prior=np.full(n_parameters, PRIOR),
        group=np.tile(np.arange(k), -(-len(x) // min(STRETCHES, len(x)))),
        scale=np.ones(k),
        min_scale=np.full(k, 1e-9),
        huber=HUBER,
    )
    solution = fit(model, problem, ROUNDS, TOLERANCES)
    # Slopes, offsets and the share of the columns as they are, and their derivatives by the parameters.
    change = np.zeros((2 * k + 1, n_parameters))
    change[:k, :k], change[k : 2 * k, :k] = np.diag(1.0 / spread), np.diag(-centre / spread)
    change[k : 2 * k, k : 2 * k], change[2 * k :, 2 * k :] = own, 1.0
    numbers = change @ solution.x
    width = STUDENT * np.sqrt(np.einsum("ip,pq,iq->i", change, solution.covariance, change))
    slope, offset, slope_width, offset_width = (
        y_spread * values for values in (numbers[:k], numbers[k : 2 * k], width[:k], width[k : 2 * k])
    )
    noise, share = y_spread * solution.scale, share + float(numbers[-1])
    return _Lines(slope, y_centre + offset, slope_width, offset_width, noise, share, float(width[-1]))


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
            "be told apart: measure over the whole range": range_y < 5 * noise,
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
