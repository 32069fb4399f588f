"""Which rows of a log show the arm at rest: quasi-static fits use these alone."""

from __future__ import annotations

import numpy as np

from mjx_softarm.logs import Log

REST_S = 2.0  # the arm swings for about a second
PRESSURE_TOLERANCE_KPA = 1.0  # over REST_S
TIP_TOLERANCE_M = 1.5e-3


def rows_at_rest(log: Log) -> np.ndarray:
    """One row for each time that the arm is at rest, as indices in time's order.

    A row is at rest if in the `REST_S` before it neither pressures nor tip have moved by more than the
    tolerances, as far as they were logged. A row that follows the one before by more than `REST_S` is
    taken as a pose of its own that was logged once the arm had come to rest. Of several rows in a row the
    last is taken.
    """
    n = len(log)
    if n == 0:
        return np.zeros(0, int)
    step_s = np.diff(log.time_s)
    alone = np.concatenate([step_s[:1] >= REST_S if n > 1 else [True], step_s >= REST_S])
    at_rest = alone | _still(log)
    ends = np.append(alone[1:] | ~at_rest[1:], True)  # the next row begins anew
    return np.flatnonzero(at_rest & ends)


def _still(log: Log) -> np.ndarray:
    """Rows (n,) before which nothing has moved for `REST_S`."""
    n, time_s = len(log), log.time_s
    first = np.searchsorted(time_s, time_s - REST_S, side="right") - 1  # the last row at least so long ago
    still = first >= 0
    for shift in range(1, int(np.max(np.arange(n) - first, initial=0)) + 1):
        rows = np.flatnonzero(still & (np.arange(n) - shift >= np.maximum(first, 0)))
        for values, tolerance in (
            (log.pressure_kpa, PRESSURE_TOLERANCE_KPA),
            (log.tip_m, TIP_TOLERANCE_M),
        ):
            if values is not None:
                still[rows] &= np.all(np.abs(values[rows] - values[rows - shift]) <= tolerance, axis=1)
    return still
