"""Static poses of logs: the arm at rest (`mjx_softarm.logs.rest`), to which equilibria are fitted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calib.errors import FitError
from mjx_softarm.logs.rest import NEEDED, holds, last_second, moves
from mjx_softarm.logs.schema import Log
from mjx_softarm.sensing.pose import rotation_from_quaternion
from mjx_softarm.sensing.sensors import SensorFault
from mjx_softarm.spec import ArmSpec


class StaticPoses(NamedTuple):
    """Poses of the arm at rest, in the order of the logs."""

    pressure_kpa: np.ndarray  # (n, n_chambers)
    payload_kg: np.ndarray  # (n,)
    tip_m: np.ndarray  # (n, 3)
    tip_rotation: np.ndarray  # (n, 3, 3)
    spring_m: np.ndarray  # (n, n_chambers), NaN where not measured
    marker_m: np.ndarray  # (n, n_markers, 3), NaN where not measured
    single: np.ndarray  # (n,) bool, whether it is one row, which cannot show whether the tip moved

    @property
    def n(self) -> int:
        return len(self.payload_kg)

    def take(self, poses: np.ndarray) -> StaticPoses:
        """Return some of the poses, chosen by indices or a mask (n,)."""
        return StaticPoses(*(value[poses] for value in self))


def find_static_poses(logs: Sequence[Log], spec: ArmSpec) -> tuple[StaticPoses, dict[str, int]]:
    """Find the static poses of all logs together.

    Args:
        logs: each with pressures and tip poses; readings are those of the sensors of `spec` where a log
            has no spring lengths.
        spec: the arm; its payload is that of a log that does not say.

    Returns:
        The poses, and the number of rows by use.

    Raises:
        FitError: a log has no pressures or tip poses, or another number of chambers.
    """
    n_markers = max((log.marker_m.shape[1] for log in logs if log.marker_m is not None), default=0)
    row_uses = {"used": 0, "not finite": 0, "pressures not held long enough": 0, "tip still moving": 0}
    poses = [pose for log in logs for pose in _static_poses_of(log, spec, n_markers, row_uses)]
    shapes = ((spec.n_chambers,), (), (3,), (3, 3), (spec.n_chambers,), (n_markers, 3), ())
    columns = zip(*poses, strict=True) if poses else [()] * len(shapes)
    arrays = [np.reshape(list(c), (len(poses), *shape)) for c, shape in zip(columns, shapes, strict=True)]
    return StaticPoses(*arrays[:-1], single=arrays[-1].astype(bool)), row_uses


def _static_poses_of(log: Log, spec: ArmSpec, n_markers: int, row_uses: dict[str, int]) -> list[tuple]:
    _check(log, spec)
    payload = np.full(len(log), spec.mass.payload_kg) if log.payload_kg is None else log.payload_kg
    columns = [value for name in NEEDED if (value := getattr(log, name)) is not None]
    finite = np.all(np.isfinite(np.column_stack(columns)), axis=1)
    row_uses["not finite"] += int(np.count_nonzero(~finite))
    log, payload = log.take(finite), payload[finite]
    assert log.pressure_kpa is not None and log.tip_m is not None  # else `_check` raises
    springs = spring_lengths(log, spec)
    markers = np.full((len(log), n_markers, 3), np.nan)
    if log.marker_m is not None and log.marker_m.shape[1] == n_markers:
        markers = log.marker_m
    rotation = rotation_from_quaternion(log.tip_quaternion)
    found = []
    for start, stop in holds(log.time_s, log.pressure_kpa, payload):
        rows = last_second(log.time_s, start, stop)
        row_uses["pressures not held long enough"] += stop - start - len(rows)
        if len(rows) == 0:
            continue
        if moves(log.time_s[rows], log.tip_m[rows]):
            row_uses["tip still moving"] += len(rows)
            continue
        row_uses["used"] += len(rows)
        pressure, tip, turn, spring, marker = (
            np.mean(x[rows], axis=0) for x in (log.pressure_kpa, log.tip_m, rotation, springs, markers)
        )
        kept = payload[rows[0]]  # the same in all, which a mean would round
        found.append((pressure, kept, tip, nearest_rotation(turn), spring, marker, len(rows) == 1))
    return found


def spring_lengths(log: Log, spec: ArmSpec) -> np.ndarray:
    """Return spring lengths (n, n_chambers) [m]: from the readings, else as logged, else NaN."""
    readings = log.readings_of(spec.sensor)
    if readings is None:
        return np.full((len(log), spec.n_chambers), np.nan) if log.spring_m is None else log.spring_m
    reading = spec.spring_sensor.lengths(readings)
    return np.where(reading.fault == SensorFault.OK, reading.length_m, np.nan)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation (..., 3, 3) closest to a matrix, such as a mean of similar rotations."""
    left, _, right = np.linalg.svd(matrix)
    left[..., :, 2] *= np.linalg.det(left @ right)[..., None]
    return left @ right


def _check(log: Log, spec: ArmSpec) -> None:
    for name in ("pressure_kpa", "tip_m", "tip_quaternion"):
        if getattr(log, name) is None:
            raise FitError(f"{log.source}: {name}: got no such columns, expected pressures and tip poses")
    for name in ("pressure_kpa", "spring_m", "readings"):
        value = getattr(log, name)
        if value is not None and value.shape[1] != spec.n_chambers:
            raise FitError(f"{log.source}: {name}: got {value.shape[1]} columns, expected {spec.n_chambers}")
