"""Static poses of logs: the arm at rest (`mjx_softarm.logs.rest`), to which equilibria are fitted.

In a log of the control loop the pressures change until each arrival. There a pose is the window that ends
with the last row of a goal that stood, if the springs are still over it by the loop's own rule. Windows after
earlier actions do not count: 2 s after an action a twin's tip is 3 to 4 mm from its rest at the same springs.
Two equal goals in a row are one goal of the log, and give one pose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mjx_softarm.control import Gains
from mjx_softarm.logs.rest import HOLD_KPA, NEEDED, holds, last_second, moves
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.workspace import settle_many
from mjx_softarm.policy.lag import law_lag_s, middle_kpa, rest_rule, still
from mjx_softarm.sensing.pose import rotation_from_quaternion
from mjx_softarm.spec import ArmSpec

POSE_COLUMNS = ("pressure_kpa", "tip_m", "tip_quaternion")  # needed in a log of poses
SAME_KG = 1e-6  # difference of payloads that count as the same


class StaticPoses(NamedTuple):
    """Poses of the arm at rest, in the order of the logs; a pose is the mean of some rows of a log."""

    pressure_kpa: np.ndarray  # (n, n_chambers)
    payload_kg: np.ndarray  # (n,)
    tip_m: np.ndarray  # (n, 3)
    tip_rotation: np.ndarray  # (n, 3, 3)
    spring_m: np.ndarray  # (n, n_springs), NaN where not measured; see `with_lengths`
    marker_m: np.ndarray  # (n, n_markers, 3), NaN where not measured
    readings: np.ndarray  # (n, n_max, n_springs) of each row; NaN beyond `n_rows` and without sensors
    n_rows: np.ndarray  # (n,) number of rows; one row cannot show whether the tip moved

    @property
    def n(self) -> int:
        """Number of poses."""
        return len(self.payload_kg)

    def take(self, poses: np.ndarray) -> StaticPoses:
        """Return some of the poses, chosen by indices or a mask (n,)."""
        return StaticPoses(*(value[poses] for value in self))

    def with_lengths(self, spec: ArmSpec) -> StaticPoses:
        """Return the poses with the spring lengths that the sensors of `spec` read.

        A length stays NaN if any of a pose's readings is faulty.
        """
        length_m = spec.spring_sensor.lengths(self.readings, np.nan).length_m
        counted = np.arange(length_m.shape[1]) < self.n_rows[:, None]
        mean_m = np.sum(length_m, axis=1, where=counted[..., None]) / self.n_rows[:, None]
        return self._replace(spring_m=np.where(np.isnan(self.spring_m), mean_m, self.spring_m))


def find_static_poses(logs: Sequence[Log], spec: ArmSpec) -> tuple[StaticPoses, dict[str, int]]:
    """Find the static poses of all logs together.

    Args:
        logs: each with pressures, and with tip poses unless the tips may be NaN.
        spec: arm, calibrated or not; its payload is that of a log without a payload.

    Returns:
        The poses, and the number of rows by use. A log with readings gives no spring lengths, but readings.
    """
    n_markers = max((log.marker_m.shape[1] for log in logs if log.marker_m is not None), default=0)
    row_uses = {"used": 0, "not finite": 0, "pressures not held long enough": 0, "tip still moving": 0}
    row_uses |= {"goal not held long enough": 0}
    rests = [pose for log in logs for pose in _static_poses_of(log, spec, n_markers, row_uses)]
    n, n_springs = len(rests), spec.n_springs
    # Stack the poses; pad the rows of readings.
    *columns, rows = list(zip(*rests, strict=True)) if rests else [[]] * 7
    shapes = ((spec.n_chambers,), (), (3,), (3, 3), (n_springs,), (n_markers, 3))
    arrays = [np.reshape(list(c), (n, *shape)) for c, shape in zip(columns, shapes, strict=True)]
    n_rows = np.array([len(readings) for readings in rows], int)
    padded = np.full((n, n_rows.max(initial=0), n_springs), np.nan)
    for pose, readings in zip(padded, rows, strict=True):
        pose[: len(readings)] = readings
    poses = StaticPoses(*arrays, readings=padded, n_rows=n_rows)
    # Give a chamber that was held in all poses one pressure: its noise would pass for changes.
    if n:
        held = np.ptp(poses.pressure_kpa, axis=0) < HOLD_KPA
        poses.pressure_kpa[:, held] = poses.pressure_kpa[:, held].mean(axis=0)
    return poses, row_uses


def _static_poses_of(log: Log, spec: ArmSpec, n_markers: int, row_uses: dict[str, int]) -> list[tuple]:
    """Return the fields of each pose of a log, its rows of readings last; count the rows by use."""
    # Leave out rows that are not finite.
    if log.payload_kg is None:
        log = dataclasses.replace(log, payload_kg=np.full(len(log), spec.mass.payload_kg))
    columns = [value for name, value in log.groups.items() if name in NEEDED]
    finite = np.all(np.isfinite(np.column_stack(columns)), axis=1)
    row_uses["not finite"] += int(np.count_nonzero(~finite))
    log = log.take(finite)
    assert log.pressure_kpa is not None and log.payload_kg is not None

    # Fill what the log does not have.
    def or_nan(value: np.ndarray | None, *shape: int) -> np.ndarray:
        return np.full((len(log), *shape), np.nan) if value is None else value

    readings = or_nan(log.readings, spec.n_springs)
    springs = or_nan(log.spring_m if log.readings is None else None, spec.n_springs)
    same_markers = log.marker_m is not None and log.marker_m.shape[1] == n_markers
    markers = or_nan(log.marker_m if same_markers else None, n_markers, 3)
    tips, rotation = or_nan(None, 3), or_nan(None, 3, 3)
    if log.tip_m is not None and log.tip_quaternion is not None:
        tips, rotation = log.tip_m, rotation_from_quaternion(log.tip_quaternion)
    # Average the rows at each rest.
    poses = []
    rests = _rests if log.goal is None else _rests_of_loop
    for rows in rests(log, spec, row_uses):
        row_uses["used"] += len(rows)
        pressure, tip, turn, spring, marker = (
            np.mean(x[rows], axis=0) for x in (log.pressure_kpa, tips, rotation, springs, markers)
        )
        payload = log.payload_kg[rows[0]]  # of all rows; a mean would round it
        turn = nearest_rotation(turn) if np.isfinite(turn).all() else turn
        poses.append((pressure, payload, tip, turn, spring, marker, readings[rows]))
    return poses


def _rests(log: Log, spec: ArmSpec, row_uses: dict[str, int]) -> Iterator[np.ndarray]:
    """Find the rows of each rest: the last second of a hold at whose end the tip rests."""
    assert log.pressure_kpa is not None and log.payload_kg is not None
    for start, stop in holds(log.time_s, log.pressure_kpa, log.payload_kg):
        rows = last_second(log.time_s, start, stop)
        row_uses["pressures not held long enough"] += stop - start - len(rows)
        moving = len(rows) > 0 and log.tip_m is not None and moves(log.time_s[rows], log.tip_m[rows])
        row_uses["tip still moving"] += moving * len(rows)
        if len(rows) > 0 and not moving:
            yield rows


def _rests_of_loop(log: Log, spec: ArmSpec, row_uses: dict[str, int]) -> Iterator[np.ndarray]:
    """Find the rows of each rest in a log of the control loop: the last window of each goal that stood."""
    assert log.goal is not None and log.payload_kg is not None
    n, still_m, _ = rest_rule(spec, _lag_s(spec))
    watched_m = log.lengths_m(spec.spring_sensor)
    # A goal that stands for a window, and no longer than the payload; a moving goal has no such rows
    asked = np.column_stack([log.goal, log.payload_kg])
    cuts = np.flatnonzero((asked[1:] != asked[:-1]).any(axis=1)) + 1
    for rows in np.split(np.arange(len(log)), cuts):
        if len(rows) < n or np.isnan(log.goal[rows[0]]).any():
            row_uses["goal not held long enough"] += len(rows)
            continue
        row_uses["goal not held long enough"] += len(rows) - n
        rows = _last_held(rows, log.reference_m, n)
        if watched_m is not None and still(watched_m[rows], still_m):
            yield rows
        else:
            row_uses["tip still moving"] += n


def _last_held(rows: np.ndarray, reference_m: np.ndarray | None, n: int) -> np.ndarray:
    """Return the last n rows with the same references: those of a way leave a stop before its goal does."""
    if reference_m is None:
        return rows[-n:]
    changed = (reference_m[rows[1:]] != reference_m[rows[:-1]]).any(axis=1)
    n_changes = np.append(0, np.cumsum(changed))
    ends = np.flatnonzero(n_changes[n - 1 :] == n_changes[: len(rows) - n + 1])
    return rows[ends[-1] : ends[-1] + n] if len(ends) else rows[-n:]


def _lag_s(spec: ArmSpec) -> np.ndarray:
    """Return the lags (n_springs, n_springs) [s] of the springs under the law, by the simulated arm."""
    gains, n = Gains.from_spec(spec), spec.n_chambers

    def springs(pressure_kpa: np.ndarray) -> np.ndarray:
        settled = settle_many(spec, pressure_kpa.reshape(-1, n))
        # A chamber counts as moving nothing where one of its two arms does not settle.
        known = np.asarray(np.asarray(settled.settled).reshape(2, n).all(axis=0))
        return np.where(known[:, None], np.asarray(settled.spring_m, float).reshape(2, n, -1), 0.0)

    return law_lag_s(gains, springs, middle_kpa(gains, n))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation (..., 3, 3) closest to a matrix, such as a mean of similar rotations."""
    left, _, right = np.linalg.svd(matrix)
    left[..., :, 2] *= np.linalg.det(left @ right)[..., None]
    return left @ right
