"""The springs' calibration: L = beta l + delta, L a measured length and l that of a reading.

A straight line per spring (or one for all), fitted with Huber's loss, whose scale comes from the residuals,
so that a few gross outliers hardly matter. Intervals are of the sandwich kind and take stretches of
neighbouring rows as one piece of evidence each, since neighbouring rows of a log err alike.

What lengths can tell of the circuit: L = beta K w / (1 - I_comp w) + delta with w = C (2 pi f)^2 stays the
same when C grows by a factor and beta and I_comp shrink by it. So C stays at its given value and beta answers
for it; I_comp, one for all springs, can be fitted, from the curvature of L against f^2, if the lengths reach
far enough.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from calib.errors import FitError
from calib.fit.blocks import folds
from mjx_softarm.sensing.sensors import Coil, Sensor

HUBER = 1.345  # in standard deviations of the noise: 95 % of the efficiency of least squares
DOWN_WEIGHTED = 2 * HUBER  # beyond it a row counts less than half
ROUNDS = 5  # of scale and parameters in turn
ITERATIONS = 40
STRETCHES = 50  # of neighbouring rows, for the intervals
STUDENT = 2.0096  # 97.5 % quantile for STRETCHES - 1 degrees of freedom
MIN_ROWS = 50


class LineFit(NamedTuple):
    """y = slope x + offset for each of k columns."""

    slope: np.ndarray  # (k,)
    offset: np.ndarray  # (k,)
    slope_interval: np.ndarray  # (k, 2) of 95 %
    offset_interval: np.ndarray  # (k, 2)
    rms: np.ndarray  # (k,) over all rows, outliers too
    held_out_rms: np.ndarray  # (k,) over all rows, each predicted by a fit without its block
    noise: np.ndarray  # (k,) robust standard deviation of the residuals
    n_rows: np.ndarray  # (k,)
    n_outliers: np.ndarray  # (k,) rows that count less than half
    warnings: tuple[str, ...]  # reasons not to trust the fit


class SpringFit(NamedTuple):
    """Calibration of n springs; fields as in `LineFit`, lengths in metres."""

    beta: np.ndarray  # (n,)
    delta_m: np.ndarray  # (n,)
    beta_interval: np.ndarray  # (n, 2)
    delta_interval_m: np.ndarray  # (n, 2)
    compensation_h: float | None  # of coils, None where it was not fitted
    compensation_interval_h: tuple[float, float] | None
    rms_m: np.ndarray
    held_out_rms_m: np.ndarray
    noise_m: np.ndarray
    n_rows: np.ndarray
    n_outliers: np.ndarray
    warnings: tuple[str, ...]


def fit_line(
    x: np.ndarray, y: np.ndarray, name: str = "column", shared: bool = False, block: int = 100, seed: int = 0
) -> LineFit:
    """Robust straight lines, one for each column, or one for all columns together.

    Args:
        x (n, k): predictors; an entry that is not finite is a missing one.
        y (n, k): targets, likewise.
        name: of a column in messages, its number follows.
        shared: one slope and offset for all columns.
        block: rows that are held out together.
        seed: chooses which blocks form a fold.

    Raises:
        FitError: the shapes differ, or a column has fewer than 3 rows or one value of x only.
    """
    found = _fit(_identity, x, y, np.zeros(0), name, shared, block, seed)
    return found[0]


def fit_springs(
    readings: np.ndarray,
    length_m: np.ndarray,
    sensor: Sensor,
    fit_compensation: bool = False,
    shared: bool = False,
    block: int = 100,
    seed: int = 0,
) -> SpringFit:
    """Calibrate springs from readings and the lengths that were measured at them.

    Args:
        readings (n, n_springs): readings; one that is not finite or not believed is left out.
        length_m (n, n_springs): measured lengths, NaN where there is none.
        sensor: which reads them; its beta and delta are not used.
        fit_compensation: fit I_comp, too, one for all springs; for coils alone.
        shared: one beta and delta for all springs.
        block, seed: as in `fit_line`.

    Raises:
        FitError: the shapes differ, a spring has fewer than 3 rows or one reading only, or a compensation is
            to be fitted to sensors that have none.
    """
    readings = np.asarray(readings, float)
    low, high = sensor.range
    believed = (readings >= low) & (readings <= high)
    scale, compensation_h, compensation_interval = 1.0, None, None
    if fit_compensation:
        if not isinstance(sensor, Coil):
            raise FitError(f"fit_compensation: got sensors of kind {sensor.kind}, expected {Coil.kind}")
        inverse_h = np.where(believed, sensor.inverse_inductance(readings), np.nan)
        unit_h = 1.0 / np.nanmax(inverse_h)  # I_comp beyond it would leave no coil
        w = inverse_h * unit_h
        line, share, interval = _fit(
            _wire_share,
            w,
            length_m,
            np.array([sensor.compensation_h / unit_h]),
            "spring",
            shared,
            block,
            seed,
        )
        assert interval is not None  # one number besides the lines was fitted
        scale, compensation_h = unit_h / sensor.coil_hm, float(share[0] * unit_h)
        compensation_interval = (float(interval[0] * unit_h), float(interval[1] * unit_h))
        warnings = (*line.warnings, *_compensation_warnings(compensation_interval, unit_h))
    else:
        raw_m, exists = sensor.raw_length(np.where(believed, readings, low))
        line = fit_line(np.where(believed & exists, raw_m, np.nan), length_m, "spring", shared, block, seed)
        warnings = line.warnings
    return SpringFit(
        beta=line.slope * scale,
        delta_m=line.offset,
        beta_interval=line.slope_interval * scale,
        delta_interval_m=line.offset_interval,
        compensation_h=compensation_h,
        compensation_interval_h=compensation_interval,
        rms_m=line.rms,
        held_out_rms_m=line.held_out_rms,
        noise_m=line.noise,
        n_rows=line.n_rows,
        n_outliers=line.n_outliers,
        warnings=warnings,
    )


def still_rows(time_s: np.ndarray, x: np.ndarray, tolerance: float, window_s: float = 0.5) -> np.ndarray:
    """Mask (n,) of the rows around which x (n,) moves by less than the tolerance within the window.

    Two instruments that are not triggered together differ by speed times delay while the arm moves; a static
    calibration wants rows at which both were still. A fit's residuals have no say in it.
    """
    before, after = (np.interp(time_s + shift, time_s, x) for shift in (-window_s, window_s))
    return (np.abs(x - before) < tolerance) & (np.abs(after - x) < tolerance)


def _identity(x: Array, q: Array) -> Array:
    return x


def _wire_share(w: Array, q: Array) -> Array:
    """Wire length, but for a factor, from w = y / y_max and q = I_comp y_max."""
    return w / jnp.maximum(1.0 - q[0] * w, 1e-3)


def _columns(x: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted mean and standard deviation (k,) of the columns."""
    total = jnp.sum(weight, 0)
    mean = jnp.sum(weight * x, 0) / total
    return mean, jnp.sqrt(jnp.sum(weight * (x - mean) ** 2, 0) / total)


def _scale(residual: Array, weight: Array) -> Array:
    """Robust standard deviation (k,) of the columns."""
    return jnp.maximum(1.4826 * jnp.nanmedian(jnp.where(weight > 0, jnp.abs(residual), jnp.nan), 0), 1e-9)


@functools.partial(jax.jit, static_argnums=0)
def _robust(feature, x: Array, y: Array, q: Array, weight: Array) -> tuple[Array, Array, Array, Array]:
    """Slope (k,), offset (k,), numbers of the feature (m,), noise (k,); y has unit spread, weight 0 or 1."""

    def residual(params):
        slope, offset, q = params
        wire = feature(x, q)
        mean, spread = _columns(wire, weight)
        return y - slope * (wire - mean) / spread - offset

    def descend(params, scale):
        def loss(params):
            loss = weight * optax.losses.huber_loss(residual(params) / scale, delta=HUBER)
            return jnp.min(scale) ** 2 * jnp.sum(loss) / jnp.sum(weight)

        optimiser = optax.lbfgs(linesearch=optax.scale_by_backtracking_linesearch(20, store_grad=True))

        def iterate(carry):
            params, state, count, _ = carry
            value, gradient = optax.value_and_grad_from_state(loss)(params, state=state)
            update, state = optimiser.update(
                gradient, state, params, value=value, grad=gradient, value_fn=loss
            )
            steepest = optax.tree.norm(gradient)
            return optax.apply_updates(params, update), state, count + 1, steepest

        start = (params, optimiser.init(params), 0, jnp.inf)
        goal = 1e-10 * jnp.min(scale)
        return jax.lax.while_loop(lambda c: (c[2] < ITERATIONS) & (c[3] > goal), iterate, start)[0]

    mean, _ = _columns(y, weight)

    def again(count, params):
        least_squares = jnp.full_like(mean, 1e3)
        return descend(params, jnp.where(count == 0, least_squares, _scale(residual(params), weight)))

    params = jax.lax.fori_loop(0, ROUNDS, again, (jnp.ones_like(mean), mean, q))
    mean, spread = _columns(feature(x, params[2]), weight)
    slope = params[0] / spread
    return slope, params[1] - slope * mean, params[2], _scale(residual(params), weight)


def _fit(feature, x, y, q, name: str, shared: bool, block: int, seed: int):
    """LineFit with regard to feature(x, q); the best q (m,), and its interval (2,) where m is 1."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.shape != y.shape or x.ndim != 2:
        raise FitError(f"{name}s: expected two tables of one shape, got {x.shape} and {y.shape}")
    n_columns = x.shape[1]
    if shared:  # rows of one time stay neighbours
        x, y, block = x.reshape(-1, 1), y.reshape(-1, 1), block * n_columns
    known = np.isfinite(x) & np.isfinite(y)
    for k, column in enumerate(known.T):
        if column.sum() < 3 or np.ptp(x[column, k]) == 0 or np.ptp(y[column, k]) == 0:
            raise FitError(
                f"{name}{k}: {column.sum()} rows with a reading and a length, expected 3 or more that differ"
            )
    x, unit = np.where(known, x, x[known].mean()), y[known].std()
    y = np.where(known, y, y[known].mean())
    fold = folds(len(x), block, min(5, len(x)), seed)
    with jax.enable_x64(True):
        weight = known.astype(float)
        slope, offset, best_q, noise = jax.device_get(_robust(feature, x, y / unit, q, weight))
        slope, offset, noise = slope * unit, offset * unit, noise * unit
        held_out = np.empty_like(y)
        for k in range(fold.max() + 1):
            out = fold == k
            some = weight * ~out[:, None]
            if (some.sum(0) < 2).any():
                held_out[out] = np.nan  # said in the warnings: too few rows
                continue
            a, b, c, _ = jax.device_get(_robust(feature, x, y / unit, q, some))
            held_out[out] = unit * (a * np.asarray(feature(x[out], c)) + b)
        wire = np.asarray(feature(x, best_q))
        columns = [wire, np.ones_like(wire)]
        if len(best_q):
            columns.append(slope * np.asarray(jax.jvp(lambda c: feature(x, c), (best_q,), (np.ones(1),))[1]))
    residual = np.where(known, y - slope * wire - offset, np.nan)
    half, q_half = _half_widths(np.stack(columns, -1), residual, noise)
    fit = LineFit(
        slope=slope,
        offset=offset,
        slope_interval=slope[:, None] + half[:, :1] * [-1, 1],
        offset_interval=offset[:, None] + half[:, 1:] * [-1, 1],
        rms=np.sqrt(np.nanmean(residual**2, 0)),
        held_out_rms=np.sqrt(np.nanmean(np.where(known, y - held_out, np.nan) ** 2, 0)),
        noise=noise,
        n_rows=known.sum(0),
        n_outliers=(np.abs(residual) > DOWN_WEIGHTED * noise).sum(0),
        warnings=(),
    )
    fit = fit._replace(
        warnings=_warnings(fit, np.where(known, wire, np.nan), "all " + name + "s " if shared else name)
    )
    if shared:
        fit = LineFit(*(np.repeat(value, n_columns, axis=0) for value in fit[:-1]), warnings=fit.warnings)
    return fit, best_q, None if q_half is None else best_q[0] + q_half * np.array([-1, 1])


def _half_widths(jacobian, residual, noise) -> tuple[np.ndarray, float | None]:
    """Half-widths of the 95 % intervals: of slope and offset (k, 2), and of the shared number, if any.

    Args:
        jacobian (n, k, p): by slope and offset of its column and, where p is 3, by a number of all columns.
        residual (n, k): NaN where missing.
        noise (k,): robust standard deviation of the residuals.

    Source: Huber, "Robust Statistics", 1981; Liang and Zeger, Biometrika 73 (1986), for the stretches.
    """
    n, k, p = jacobian.shape
    size = 2 * k + (p == 3)
    n_stretches = min(STRETCHES, n)
    first_rows = np.arange(n_stretches) * n // n_stretches
    curvature, scores = np.zeros((size, size)), np.zeros((n_stretches, size))
    for j in range(k):
        index = [j, k + j, size - 1][:p]
        scaled = np.nan_to_num(residual[:, j] / noise[j], nan=np.inf)
        inside = np.abs(scaled) < HUBER
        influence = np.where(np.isfinite(scaled), np.clip(scaled, -HUBER, HUBER), 0.0) / noise[j]
        rows = jacobian[:, j]
        curvature[np.ix_(index, index)] += (rows * inside[:, None]).T @ rows / noise[j] ** 2
        scores[:, index] += np.add.reduceat(rows * influence[:, None], first_rows)
    norm = np.sqrt(np.diag(curvature))
    inverse = np.linalg.pinv(curvature / np.outer(norm, norm), hermitian=True) / np.outer(norm, norm)
    covariance = inverse @ (scores.T @ scores) @ inverse * n_stretches / max(n_stretches - 1, 1)
    half = STUDENT * np.sqrt(np.diag(covariance))
    return np.stack([half[:k], half[k : 2 * k]], -1), float(half[-1]) if p == 3 else None


def _warnings(fit: LineFit, x: np.ndarray, name: str) -> tuple[str, ...]:
    found = []
    for k in range(len(fit.slope)):
        range_y = abs(fit.slope[k]) * np.nanstd(x[:, k])
        width = np.ptp(fit.slope_interval[k]) / 2 / abs(fit.slope[k])
        for bad, reason in (
            (fit.n_rows[k] < MIN_ROWS, f"{fit.n_rows[k]} rows, expected {MIN_ROWS} or more"),
            (
                range_y < 5 * fit.noise[k],
                f"lengths spread by {range_y:.3g} only, noise being {fit.noise[k]:.3g}: "
                "slope and offset can hardly be told apart",
            ),
            (
                not fit.held_out_rms[k] < 1.5 * fit.rms[k],
                f"held-out error {fit.held_out_rms[k]:.3g}, on its own rows {fit.rms[k]:.3g}",
            ),
            (not width < 0.02, f"slope known to {100 * width:.2g} % only"),
            (
                fit.n_outliers[k] > 0.1 * fit.n_rows[k],
                f"{fit.n_outliers[k]} of {fit.n_rows[k]} rows are outliers of a straight line",
            ),
        ):
            if bad:
                found.append(f"{name}{k}: {reason}")
    return tuple(found)


def _compensation_warnings(interval_h: tuple[float, float], unit_h: float) -> tuple[str, ...]:
    width_h = (interval_h[1] - interval_h[0]) / 2
    if width_h < 0.02 * unit_h:
        return ()
    return (
        f"compensation: known to {width_h:.3g} H only, beside {unit_h:.3g} H of the whole circuit: the "
        "lengths do not reach far enough to tell it from beta and delta",
    )
