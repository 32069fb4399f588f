"""Poses at rest: the one rule by which arms are recorded and logs are read.

A log is cut into holds: stretches in which each pressure stays within 1 kPa of its first value, the payload
stays, and rows are at most 3 s apart. The last second of a hold counts, provided that

- the hold has lasted for 3 s by then, three times the slowest time constant of the paper's arm. In a gap
  before a hold, or after its first row, the pressures are assumed to have been held: poses may be logged one
  by one;
- the tip moves by less than 1 mm/s, or by no more than its own noise can explain, and stays within 2 mm.

Rows with a missing number in a column of NEEDED are left out. Rows that count are averaged to one pose, so a
long hold weighs no more than a short one.
"""

from __future__ import annotations

import itertools

import numpy as np

NEEDED = ("time_s", "payload_kg", "pressure_kpa", "tip_m", "tip_quaternion")  # finite in a row, where logged
HOLD_KPA = 1.0  # a held pressure stays this close to its first value
MIN_HOLD_S = 3.0  # time that pressures are held before the rows that count
WINDOW_S = 1.0  # end of a hold, whose rows count
MAX_SPEED_M_S = 1e-3  # greatest speed of a tip at rest
MAX_SPREAD_M = 2e-3  # RMS distance to the mean position of a tip at rest
SPEED_SIGMA = 3.0  # standard deviations of the fitted speed that noise may add to it
ROUNDING_S = 1e-6  # error of logged times


def holds(time_s: np.ndarray, pressure_kpa: np.ndarray, payload_kg: np.ndarray) -> list[tuple[int, int]]:
    """Return first row, and row after the last, of each stretch at constant pressures and payload.

    Each row has a time (n,), commanded pressures (n, n_chambers) and a payload (n,).
    """
    breaks = np.concatenate([[True], (np.diff(time_s) > MIN_HOLD_S) | (np.diff(payload_kg) != 0)])
    starts = []
    for row in range(len(time_s)):
        if breaks[row] or leaves(pressure_kpa[row], pressure_kpa[starts[-1]]):
            starts.append(row)
    return list(itertools.pairwise([*starts, len(time_s)]))


def leaves(pressure_kpa: np.ndarray, first_kpa: np.ndarray) -> np.ndarray:
    """Return whether pressures (..., n) [kPa] end a hold that began at the pressures (n,)."""
    return np.any(np.abs(pressure_kpa - first_kpa) > HOLD_KPA, axis=-1)


def last_second(time_s: np.ndarray, start: int, stop: int) -> np.ndarray:
    """Return the rows that count of the hold from `start` to before `stop`, if any."""
    gaps_s = np.diff(time_s[max(start - 1, 0) :][:2])  # before the hold, or after the log's first row
    gap_s = gaps_s[0] if len(gaps_s) else 0.0
    since = time_s[start] - (gap_s if gap_s > MIN_HOLD_S else 0.0)
    rows = np.arange(start, stop)
    window = time_s[rows] >= time_s[stop - 1] - WINDOW_S - ROUNDING_S
    return rows[window & (time_s[rows] - since >= MIN_HOLD_S - ROUNDING_S)]


def moves(time_s: np.ndarray, tip_m: np.ndarray) -> bool:
    """Return whether the tip (n, 3) [m] moves over some rows of a hold; False for a single row."""
    off = tip_m - np.mean(tip_m, axis=0)
    if len(off) < 2:
        return False
    if np.sqrt(np.mean(np.sum(off**2, axis=1))) > MAX_SPREAD_M:
        return True
    time = time_s - np.mean(time_s)
    slope = time @ off / (time @ time)  # (3,) [m/s]
    left = off - time[:, None] * slope
    noise = np.sqrt(np.sum(left**2) / max(len(off) - 2, 1) / (time @ time))
    return bool(np.linalg.norm(slope) > MAX_SPEED_M_S + SPEED_SIGMA * noise)
