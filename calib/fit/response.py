"""Response of a pneumatic section: from its pressures over time to its length.

A section lags behind its pressures. Air fills and vents through a tube with two time constants, and the wall
has hysteresis (a play: when the pressure reverses, nothing moves until it has changed by twice the
half-width). With s the mean pressure:

    x' = (s - x) / tau,   tau = tau_fill where s > x, else tau_vent   lag, exact for a pressure held for a row
    y  = the nearest to y within [x - r, x + r]                       play
    L  = c0 + c1 y + c2 y^2                                           rest length

The record is simulated from its first row to its last with measured pressures only. The c follow from the
other parameters by least squares, so optax fits three numbers.

Source: the play operator of Prandtl and Ishlinskii.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from calib.fit.blocks import folds

ITERATIONS = 150
LEARNING_RATE = 0.1  # falls to zero over the iterations
RIDGE = 1e-6  # on c1 and c2 in normalised variables
# The fit starts from the best of these: time constants to fill and to vent [s], half-width of the play over
# the range of s.
STARTS = tuple(itertools.product((0.2, 0.7, 2.0), (0.2, 0.7, 2.0, 6.0), (0.02, 0.1, 0.25)))
TAU_RANGE_S = (0.02, 20.0)


class Response(NamedTuple):
    """Length of a section as a function of the history of its mean pressure."""

    tau_fill_s: float
    tau_vent_s: float
    play_kpa: float  # half-width
    length_m: np.ndarray  # (3,) c0 [m], c1 [m/kPa], c2 [m/kPa^2]


class ResponseFit(NamedTuple):
    """Fitted response, and its errors on rows that it was not fitted to."""

    response: Response
    rms_m: float
    held_out_rms_m: float
    line_rms_m: float  # error of a straight line in all pressures of the section
    line_held_out_rms_m: float  # on the same rows as held_out_rms_m
    predicted_m: np.ndarray  # (n,) held-out prediction of each row
    n_rows: int
    warnings: tuple[str, ...]  # reasons not to trust the fit, each with its remedy


def simulate(response: Response, time_s: np.ndarray, pressure_kpa: np.ndarray) -> np.ndarray:
    """Return lengths (n,) [m] of a section that starts at rest, after a slow rise to the first pressures.

    Args:
        response: response of the section.
        time_s (n,): increasing, at any spacing.
        pressure_kpa (n, n_chambers): pressures of this section, finite.
    """
    with jax.enable_x64(True):
        drive = jnp.asarray(np.mean(pressure_kpa, axis=1))
        state = _simulate(
            jnp.array([response.tau_fill_s, response.tau_vent_s]), response.play_kpa, _steps(time_s), drive
        )
        return np.asarray(jnp.polyval(jnp.asarray(response.length_m[::-1]), state))


def fit_response(
    time_s: np.ndarray, pressure_kpa: np.ndarray, length_m: np.ndarray, block: int = 100, seed: int = 0
) -> ResponseFit:
    """Fit one section, with each row held out once in contiguous blocks.

    Args:
        time_s (n,): increasing.
        pressure_kpa (n, n_chambers): measured pressures of this section, finite.
        length_m (n,): measured lengths; a NaN is a missing one.
        block: number of rows held out together; they should last for several seconds.
        seed: seed that chooses which blocks form a fold.

    Raises:
        ValueError: the shapes do not match, time does not increase, a pressure is not finite, there are too
            few measured lengths, or pressures never change.
    """
    _check(time_s, pressure_kpa, length_m)
    known = np.isfinite(length_m)
    fold = folds(len(time_s), block, seed=seed)
    keep = np.stack([known, *(known & (fold != k) for k in range(fold.max() + 1))])  # all rows, then folds
    line = _lines(pressure_kpa, length_m, keep)
    drive = np.mean(pressure_kpa, axis=1)
    low, span = drive.min(), np.ptp(drive)
    centre, spread = np.nanmean(length_m), np.nanstd(length_m)
    with jax.enable_x64(True):
        target = np.where(known, (length_m - centre) / spread, 0.0)
        starts = jnp.array([_to_free(*start) for start in STARTS])
        q, coefficients, predicted = jax.device_get(
            _fit(starts, _steps(time_s), jnp.asarray((drive - low) / span), target, keep.astype(float))
        )
    predicted = centre + spread * predicted
    taus, play = jax.device_get(_from_free(q[0]))
    a, b, c = coefficients[0]  # of 1, z, z^2 with z = (y - low) / span
    slope, curve = b / span, c / span**2
    response = Response(
        float(taus[0]),
        float(taus[1]),
        float(play) * span,
        np.array([centre + spread * (a - slope * low + curve * low**2), spread * (slope - 2 * curve * low),
                  spread * curve]),
    )  # fmt: skip
    rows = np.arange(len(time_s))
    held_out = predicted[fold + 1, rows]
    error, line_error = predicted - length_m, line - length_m
    fit = ResponseFit(
        response=response,
        rms_m=_rms(error[0]),
        held_out_rms_m=_rms(held_out - length_m),
        line_rms_m=_rms(line_error[0]),
        line_held_out_rms_m=_rms(line_error[fold + 1, rows]),
        predicted_m=held_out,
        n_rows=int(known.sum()),
        warnings=(),
    )
    return fit._replace(warnings=_warnings(fit, np.diff(time_s)))


def _steps(time_s: np.ndarray) -> Array:
    return jnp.asarray(np.diff(time_s, prepend=time_s[0]))


def _simulate(taus: Array, play: Array | float, steps: Array, drive: Array) -> Array:
    """Return states (n,) after lag and play."""

    def row(state, now):
        lagged, held = state
        step, pressure = now
        gap = pressure - lagged
        lagged = lagged - jnp.expm1(-step / jnp.where(gap > 0, taus[0], taus[1])) * gap
        held = jnp.clip(held, lagged - play, lagged + play)
        return (lagged, held), held

    return jax.lax.scan(row, (drive[0], drive[0] - play), (steps, drive))[1]


def _to_free(tau_fill: float, tau_vent: float, play: float) -> tuple[float, float, float]:
    low, high = np.log(TAU_RANGE_S)
    share = (np.log([tau_fill, tau_vent]) - low) / (high - low)
    return (*np.log(share / (1 - share)), np.log(play / (0.5 - play)))


def _from_free(q: Array) -> tuple[Array, Array]:
    """Return time constants (2,) [s] in their range, and the half-width of the play, below half the range."""
    low, high = np.log(TAU_RANGE_S)
    return jnp.exp(low + (high - low) * jax.nn.sigmoid(q[:2])), 0.5 * jax.nn.sigmoid(q[2])


def _features(q: Array, steps: Array, drive: Array) -> Array:
    state = _simulate(*_from_free(q), steps, drive)
    return jnp.stack([jnp.ones_like(state), state, state**2], axis=1)  # (n, 3)


def _best_polynomial(features: Array, target: Array, weight: Array) -> Array:
    weighted = features * weight[:, None] / jnp.sum(weight)
    ridge = RIDGE * jnp.diag(jnp.array([0.0, 1.0, 1.0]))
    return jnp.linalg.solve(weighted.T @ features + ridge, weighted.T @ target)


def _loss(q: Array, steps: Array, drive: Array, target: Array, weight: Array) -> Array:
    features = _features(q, steps, drive)
    coefficients = _best_polynomial(features, target, weight)
    error = features @ coefficients - target
    return jnp.sum(weight * error**2) / jnp.sum(weight) + RIDGE * jnp.sum(coefficients[1:] ** 2)


@jax.jit
def _fit(starts: Array, steps: Array, drive: Array, target: Array, keep: Array):
    """Return free parameters (m, 3), polynomials (m, 3), predictions (m, n) for the rows of keep (m, n)."""

    def descend(start, weight) -> Any:
        def loss(q):
            return _loss(q, steps, drive, target, weight)

        optimiser = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, ITERATIONS))

        def iterate(carry, _):
            q, state = carry
            update, state = optimiser.update(jax.grad(loss)(q), state)
            return (optax.apply_updates(q, update), state), None

        return jax.lax.scan(iterate, (start, optimiser.init(start)), length=ITERATIONS)[0][0]

    def one(weight):
        losses = jax.vmap(lambda start: _loss(start, steps, drive, target, weight))(starts)
        q = descend(starts[jnp.argmin(losses)], weight)
        features = _features(q, steps, drive)
        coefficients = _best_polynomial(features, target, weight)
        return q, coefficients, features @ coefficients

    return jax.vmap(one)(keep)


def _lines(pressure_kpa: np.ndarray, length_m: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Return predictions (m, n) of a straight line in all pressures, for each row of keep (m, n)."""
    features = np.column_stack([pressure_kpa, np.ones(len(length_m))])
    slopes = (np.linalg.lstsq(features[kept], length_m[kept], rcond=None)[0] for kept in keep)
    return np.stack([features @ slope for slope in slopes])


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(error**2)))


def _check(time_s: np.ndarray, pressure_kpa: np.ndarray, length_m: np.ndarray) -> None:
    n = len(time_s)
    if np.ndim(pressure_kpa) != 2 or len(pressure_kpa) != n or np.shape(length_m) != (n,):
        raise ValueError(
            f"response: got pressures {np.shape(pressure_kpa)} and lengths {np.shape(length_m)}, "
            f"expected ({n}, n_chambers) and ({n},) for {n} times"
        )
    later = np.append(True, np.diff(time_s) > 0)
    for name, values, good, expected in (
        ("time_s", time_s, later, "a time after the row before"),
        ("pressure_kpa", pressure_kpa, np.isfinite(pressure_kpa).all(axis=1), "finite numbers"),
    ):
        if not good.all():
            row = int(np.argmin(good))
            raise ValueError(f"response: {name} row {row}: got {values[row]}, expected {expected}")
    if (n_known := np.isfinite(length_m).sum()) < 20:
        raise ValueError(f"response: length_m: got {n_known} measured lengths, expected 20 or more")
    if np.ptp(np.mean(pressure_kpa, axis=1)) == 0 or np.nanstd(length_m) == 0:
        raise ValueError("response: got pressures or lengths that never change, expected at least one step")


def _warnings(fit: ResponseFit, steps_s: np.ndarray) -> tuple[str, ...]:
    found = []
    if fit.held_out_rms_m > 2 * fit.rms_m:
        found.append(
            f"held-out error {1e3 * fit.held_out_rms_m:.2f} mm is more than twice the error on its own rows, "
            f"{1e3 * fit.rms_m:.2f} mm: log more steps of the pressures"
        )
    if fit.held_out_rms_m > fit.line_held_out_rms_m:
        found.append(
            "the straight line predicts held-out rows better: use it, or log more steps of the pressures"
        )
    for name, tau in (("fill", fit.response.tau_fill_s), ("vent", fit.response.tau_vent_s)):
        constant = f"time constant to {name}, {tau:.3g} s, is"
        if not 1.5 * TAU_RANGE_S[0] < tau < TAU_RANGE_S[1] / 1.5:
            found.append(f"{constant} at the edge of what is tried: log longer steps")
        elif tau < np.median(steps_s):
            found.append(f"{constant} shorter than the time between rows: log faster")
    return tuple(found)
