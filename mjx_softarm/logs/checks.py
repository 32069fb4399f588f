"""Checks of the rows of a log: detectors take arrays, and return a mask of the faulty rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_softarm._support.errors import InputError


class Finding(NamedTuple):
    """A fault of a log."""

    file: str
    rows: tuple[int, int] | None  # first and last faulty line, counted from 1; None: the whole file
    column: str  # name of the faulty column, or ""
    problem: str  # "got X, expected Y"
    n_dropped: int = 0  # number of dropped rows; a row with two faults counts in both findings

    def __str__(self) -> str:
        first, last = self.rows or (0, 0)
        rows = f"line {first}" if first == last else f"lines {first} to {last}"
        cost = f"; costs {self.n_dropped} rows" if self.n_dropped else ""
        place = (self.file, self.rows and rows, self.column)
        return ": ".join([*filter(None, place), f"{self.problem}{cost}"])


class LogError(InputError):
    """A log that cannot be used; the message has a line for each finding."""

    def __init__(self, findings: Sequence[Finding]):
        super().__init__("\n".join(map(str, findings)))
        self.findings = tuple(findings)


_UNIT_TOLERANCE = 0.01  # error of a quaternion's length
_TURN_DEG = 150.0  # smallest step of orientation that counts as a jump by 180 degrees
_MOTION_DEG = 15.0  # largest median step of one motion; with larger steps, rows are separate poses
_SPIKE_SIGMA = 20.0  # smallest deviation of a spike, in standard deviations of the column
_SPIKE_LOCAL = 10.0  # smallest deviation of a spike, in spreads of its neighbours
_GAP_STEPS = 10.0  # smallest gap, in median time steps


def stale_rows(values: np.ndarray) -> np.ndarray:
    """Mask (n,) the rows of (n, k) that equal the row before: readings that were not renewed."""
    return np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])


def not_unit_rows(quaternion: np.ndarray) -> np.ndarray:
    """Mask (n,) the quaternions (n, 4) whose length is not 1."""
    return np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > _UNIT_TOLERANCE


def turned_rows(quaternion: np.ndarray) -> np.ndarray:
    """Mask (n,) the rows where motion capture has a body turned by 180 degrees, by unit quaternions (n, 4).

    Motion capture confuses the markers of a symmetric body for some rows, then jumps back. Of the two
    orientations, the one with fewer rows counts as turned. Rows of separate poses cannot be checked: none
    counts as turned.
    """
    cos_half = np.abs((quaternion[1:] * quaternion[:-1]).sum(axis=1))
    step_deg = 2.0 * np.degrees(np.arccos(np.minimum(cos_half, 1.0)))
    moving_deg = step_deg[~stale_rows(quaternion)[1:]]
    if len(moving_deg) == 0 or np.median(moving_deg) > _MOTION_DEG:
        return np.zeros(len(quaternion), bool)
    turned = np.cumsum(np.concatenate([[0], step_deg > _TURN_DEG])) % 2 == 1
    return turned if turned.sum() <= len(turned) / 2 else ~turned


def same_sign(quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose the signs of quaternions (n, 4) so that neighbours are alike; q and -q are one rotation.

    The mask (n,) marks the rows where only the sign jumped: q followed about -q.
    """
    cos_half = (quaternion[1:] * quaternion[:-1]).sum(axis=1)
    sign = np.cumprod(np.where(cos_half < 0.0, -1.0, 1.0))
    flipped = cos_half < -np.cos(np.radians(_MOTION_DEG))
    return quaternion * np.concatenate([[1.0], sign])[:, None], np.concatenate([[False], flipped])


def late_rows(time_s: np.ndarray) -> np.ndarray:
    """Mask (n,) the rows whose time does not increase: repeated or backwards.

    A single row out of order, early or late, is faulty itself. Otherwise all rows are faulty up to the row
    whose time exceeds all times before.
    """
    alone = np.zeros(len(time_s), bool)
    before, here, after = time_s[:-2], time_s[1:-1], time_s[2:]
    alone[1:-1] = (before < after) & ((here <= before) | (here > after))
    ordered = np.where(alone, -np.inf, time_s)
    so_far = np.concatenate([[-np.inf], np.maximum.accumulate(ordered)[:-1]])
    return alone | (time_s <= so_far)


def gap_rows(time_s: np.ndarray) -> np.ndarray:
    """Mask (n,) the rows before which rows are missing, by increasing times (n,)."""
    step_s = np.diff(time_s)
    if len(step_s) == 0:
        return np.zeros(len(time_s), bool)
    return np.concatenate([[False], step_s > _GAP_STEPS * np.median(step_s)])


def outlier_rows(values: np.ndarray, least: float) -> np.ndarray:
    """Mask (n,) the spikes in a column (n,), one or two rows long.

    A value is compared with the two values before and the two after it. A spike deviates from their median by
    20 standard deviations of the column (from the median absolute deviation), by 10 times the spread of the
    middle two of the four, and by `least`. A step or a fast swing spreads the middle two; constant or
    quantised columns stay below `least`.
    """
    outlier = np.zeros(len(values), bool)
    if len(values) < 5:
        return outlier
    a, b, c, d = values[:-4], values[1:-3], values[3:-1], values[4:]
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    off = np.abs(values[2:-2] - 0.5 * (low + high))  # low and high are the middle two, in either order
    sigma = 1.4826 * np.median(off)
    usual = np.maximum(_SPIKE_SIGMA * sigma, least)
    outlier[2:-2] = off > np.maximum(usual, _SPIKE_LOCAL * np.abs(high - low))
    return outlier
