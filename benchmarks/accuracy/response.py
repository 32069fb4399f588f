"""Response of a pneumatic section: from its pressures over time to its length.

A section lags behind its pressures. Air fills and vents through a tube with two time constants, and the wall
has hysteresis (a play: when the pressure reverses, nothing moves until it has changed by twice the
half-width). With s the mean pressure:

    x' = (s - x) / tau,   tau = tau_fill where s > x, else tau_vent   lag, exact for a pressure held for a row
    y  = the nearest to y within [x - r, x + r]                       play
    L  = c0 + c1 y + c2 y^2                                           rest length

The record is simulated from its first row to its last with measured pressures only. The c follow from the
other parameters by linear least squares.

Source: the play operator of Prandtl and Ishlinskii.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from calib.fit.blocks import folds

# The fit starts from the best of these: time constants to fill and to vent [s], half-width of the play over
# the range of s.
STARTS = tuple(itertools.product((0.2, 0.7, 2.0), (0.2, 0.7, 2.0, 6.0), (0.02, 0.1, 0.25)))
LOW, HIGH = (0.02, 0.02, 0.001), (20.0, 20.0, 0.5)


class ResponseFit(NamedTuple):
    """Fitted response of a section, and predictions of each row by a fit that it took no part in."""

    tau_fill_s: float
    tau_vent_s: float
    play_kpa: float  # half-width
    held_out_m: np.ndarray  # (n,) length
    line_held_out_m: np.ndarray  # (n,) length by a straight line in all pressures of the section


def fit_response(time_s: np.ndarray, pressure_kpa: np.ndarray, length_m: np.ndarray) -> ResponseFit:
    """Fit one section, with each row held out once in contiguous blocks.

    Args:
        time_s (n,): increasing.
        pressure_kpa (n, n_chambers): measured pressures of this section.
        length_m (n,): measured lengths; a NaN is a missing one.
    """
    steps_s, drive = np.diff(time_s, prepend=time_s[0]), np.mean(pressure_kpa, axis=1)
    span = np.ptp(drive)
    drive = (drive - drive.min()) / span

    def predicted(log_p: np.ndarray, kept: np.ndarray) -> np.ndarray:
        fill_s, vent_s, play = np.exp(log_p)
        state = _states(fill_s, vent_s, play, steps_s, drive)
        return _linear(np.stack([state, state**2], axis=1), length_m, kept)

    def fit(kept: np.ndarray) -> np.ndarray:
        def residual(log_p: np.ndarray) -> np.ndarray:
            return 1e3 * (predicted(log_p, kept) - length_m)[kept]

        start = min(np.log(STARTS), key=lambda log_p: np.sum(residual(log_p) ** 2))
        return least_squares(residual, start, bounds=(np.log(LOW), np.log(HIGH)), diff_step=1e-3).x

    known, fold = np.isfinite(length_m), folds(len(time_s), by=np.mean(pressure_kpa, axis=1))
    held_out, line = np.empty_like(length_m), np.empty_like(length_m)
    for k in range(fold.max() + 1):
        out, kept = fold == k, known & (fold != k)
        held_out[out] = predicted(fit(kept), kept)[out]
        line[out] = _linear(pressure_kpa, length_m, kept)[out]
    fill, vent, play = np.exp(fit(known))
    return ResponseFit(fill, vent, play * span, held_out, line)


def _states(fill_s: float, vent_s: float, play: float, steps_s: np.ndarray, drive: np.ndarray) -> np.ndarray:
    """Return states (n,) after lag and play, of a section at rest after a slow rise to the first pressure."""
    lagged, held = drive[0], drive[0] - play
    states = []
    for step, now in zip(steps_s.tolist(), drive.tolist(), strict=True):
        lagged -= math.expm1(-step / (fill_s if now > lagged else vent_s)) * (now - lagged)
        held = min(max(held, lagged - play), lagged + play)
        states.append(held)
    return np.array(states)


def _linear(features: np.ndarray, y: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return predictions (n,) by the line in the features (n, k) that fits the kept rows best."""
    x = np.column_stack([features, np.ones(len(y))])
    return x @ np.linalg.lstsq(x[kept], y[kept], rcond=None)[0]
