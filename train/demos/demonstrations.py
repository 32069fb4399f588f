"""Demonstrations: static poses to which an expert brought the arm, each with the action that leads there.

A file of demonstrations is a log (`mjx_softarm.logs.schema`) of rows at rest, with the sensors' readings, the
tip's pose, and the id of a sequence. A row's action is its own readings: as spring references they lead to
the row's pose from any start. The row's pose is the goal of this action, and every other pose may be its
start. A file has few rows, and a fault in one of them refuses it.

Source: the paper's representation of demonstration data, g' = the pose of s_{t+1}.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_softarm.logs.checks import Finding, not_unit_rows
from mjx_softarm.logs.files import LogMatrix, read_matrix, refuse
from mjx_softarm.logs.schema import UNITS, Column, Log
from mjx_softarm.mdp.actions import ActionMap
from mjx_softarm.posture import hangs, posture
from mjx_softarm.sensing.pose import pose_from_quaternion
from mjx_softarm.spec import ArmSpec

NEEDED = ("readings", "tip_m", "tip_quaternion", "sequence")


class Demonstrations(NamedTuple):
    """m demonstrated poses; float32, ids int32."""

    positions: np.ndarray  # (m, 6) [mm, deg]
    actions: np.ndarray  # (m, n_springs) in [-1, 1] that lead to the poses
    sequence: np.ndarray  # (m,)


def load_demonstrations(path: str | Path, spec: ArmSpec) -> Demonstrations:
    """Return the demonstrations of a file, CSV or npz, for an arm; see `read_demonstrations`."""
    return from_log(read_demonstrations(path, spec)[0], spec)


def read_demonstrations(path: str | Path, spec: ArmSpec) -> tuple[Log, list[Finding]]:
    """Return the checked rows of a file, and findings on its unknown columns.

    Raises LogError for a file that cannot be used; its message has a line for each finding.
    """
    matrix, extra = read_matrix(path, spec, NEEDED)
    refuse(list(_not_finite(matrix)))
    refuse(list(_out_of_range(matrix, spec)))
    refuse(list(_out_of_order(matrix)))
    return matrix.log(), extra


def from_log(log: Log, spec: ArmSpec) -> Demonstrations:
    """Return the demonstrations of checked rows."""
    actions = ActionMap.from_spec(spec).from_readings(log.readings)
    assert log.sequence is not None  # one of `NEEDED`
    positions = pose_from_quaternion(log.tip_m, log.tip_quaternion)
    return Demonstrations(
        positions.astype(np.float32), actions.astype(np.float32), log.sequence.astype(np.int32)
    )


def shown_before(sequence: np.ndarray) -> np.ndarray:
    """Return which position (m,) was shown before each; the first of a sequence stands for itself."""
    return np.arange(len(sequence)) - (np.diff(sequence, prepend=-1) == 0)


def _not_finite(matrix: LogMatrix) -> Iterator[Finding]:
    needed = matrix.indices("time_s", *NEEDED)
    for row, k in np.argwhere(~np.isfinite(matrix.values[:, needed])):
        column = matrix.columns[needed[k]]
        yield _finding(matrix, row, column.name, f"got {matrix.values[row, needed[k]]}, expected a number")


def _out_of_range(matrix: LogMatrix, spec: ArmSpec) -> Iterator[Finding]:
    actions = ActionMap.from_spec(spec)
    for k, *limits in zip(matrix.indices("readings"), actions.low, actions.high, strict=True):
        column, values = matrix.columns[k], matrix.values[:, k]
        low, high = (_shown(column, limit) for limit in limits)
        for row in np.flatnonzero((values < min(limits)) | (values > max(limits))):
            got = f"got {_shown(column, values[row])} {column.unit}"
            yield _finding(matrix, row, column.name, f"{got}, expected {low} to {high}, the arm's range")
    tip_m = matrix.values[:, matrix.indices("tip_m")]
    reach_m = sum(spec.per_section(spec.springs.length_max_m))
    behind, side = tip_m @ posture(spec)[:, 2] > 0.0, "below" if hangs(spec) else "before"
    for row in np.flatnonzero((np.linalg.norm(tip_m, axis=1) > reach_m) | behind):
        got = ", ".join(f"{1e3 * value:.4g}" for value in tip_m[row])
        expected = f"a tip {side} the base and within {1e3 * reach_m:.4g} mm of it"
        yield _finding(matrix, row, "tip_x..z", f"got {got} mm, expected {expected}")
    quaternion = matrix.values[:, matrix.indices("tip_quaternion")]
    for row in np.flatnonzero(not_unit_rows(quaternion)):
        got = f"got length {np.linalg.norm(quaternion[row]):.4g}"
        yield _finding(matrix, row, "tip_qw..qz", f"{got}, expected unit quaternions")
    sequence = matrix.values[:, matrix.indices("sequence")[0]]
    for row in np.flatnonzero((sequence < 0.0) | (sequence > 1e6) | (sequence != np.round(sequence))):
        got = f"got {sequence[row]:g}"
        yield _finding(matrix, row, "sequence", f"{got}, expected a whole number from 0 to 1000000")


def _out_of_order(matrix: LogMatrix) -> Iterator[Finding]:
    time_s, sequence = matrix.values[:, 0], matrix.values[:, matrix.indices("sequence")[0]]
    same = sequence[1:] == sequence[:-1]
    for row in 1 + np.flatnonzero(same & (time_s[1:] <= time_s[:-1])):
        problem = f"got {time_s[row]:g} s after {time_s[row - 1]:g} s, expected time's order in a sequence"
        yield _finding(matrix, row, "time", problem)
    starts = np.concatenate([[0], 1 + np.flatnonzero(~same)])
    for k in range(1, len(starts)):
        now, before = sequence[starts[k]], sequence[starts[:k]]
        if now in before:
            problem = f"got {now:g} again after {before[-1]:g}, expected a sequence in one piece"
            yield _finding(matrix, starts[k], "sequence", problem)


def _finding(matrix: LogMatrix, row: int | np.integer, column: str, problem: str) -> Finding:
    line = int(matrix.row[row])
    return Finding(matrix.file, (line, line), column, problem)


def _shown(column: Column, value: float) -> str:
    """Return a number in the file's unit, as text."""
    return f"{value / UNITS[column.kind][column.unit]:.7g}"
