"""Parts of a log that follow a moving arm row by row, at regular times."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mjx_softarm.logs.schema import Log

MAX_STEP_S = 0.05  # largest time between rows of a part


def dense_parts(
    log: Log, every_s: float, ends: np.ndarray | None = None
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Cut a log at gaps of time, and find the rows that were in force at regular times.

    Args:
        log: rows in the order of time.
        every_s: time between the regular times.
        ends (n - 1,) bool: rows after which a part ends, too.

    Yields:
        Rows (m,) of a part; regular times (k,) [s] within it; the newest row (k,) at each of them, as an
        index within the part.
    """
    last = np.diff(log.time_s) > MAX_STEP_S
    last = last if ends is None else last | ends
    for rows in np.split(np.arange(len(log)), np.flatnonzero(last) + 1):
        time_s = log.time_s[rows]
        grid = np.arange(time_s[0], time_s[-1], every_s)
        yield rows, grid, np.searchsorted(time_s, grid + 1e-6, side="right") - 1


def clusters(errors: np.ndarray, size: int) -> np.ndarray:
    """Cut errors (n, k) into clusters (m, size, k) of neighbouring rows; the last is NaN-padded."""
    padded = np.pad(errors, ((0, -len(errors) % size), (0, 0)), constant_values=np.nan)
    return padded.reshape(-1, size, errors.shape[1])
