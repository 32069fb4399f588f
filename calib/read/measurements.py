"""Measurements of one arm: its logs, and its poses at rest in them, found once for all steps."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from calib.read.logs import NEEDED
from calib.read.static_poses import POSE_COLUMNS, StaticPoses, find_static_poses
from mjx_softarm.logs.checks import Finding
from mjx_softarm.logs.files import refuse
from mjx_softarm.logs.schema import Log
from mjx_softarm.spec import ArmSpec

_FACTORS = {"readings": 1.25, "spring_m": 1.5, "tip_m": 1.5}  # between the ranges of two logs of one arm


class Measurements(NamedTuple):
    """Data of a calibration; none of it depends on what the calibration fits."""

    logs: tuple[Log, ...]
    poses: StaticPoses  # poses at rest in the logs with pressures and tip poses
    row_uses: Mapping[str, int]  # number of rows of these logs, by use


def measure(logs: Sequence[Log], spec: ArmSpec, needed: Sequence[str] = POSE_COLUMNS) -> Measurements:
    """Return logs of one arm with its poses at rest.

    Args:
        logs: logs, see `calib.read.logs.read_log`.
        spec: arm, calibrated or not; see `calib.read.static_poses.find_static_poses`.
        needed: columns of a log whose poses count.

    Raises:
        LogError: the logs are of different arms.
    """
    for first, other in itertools.combinations(logs, 2):
        file = f"{first.source} and {other.source}"
        refuse([Finding(file, None, name, problem) for name, problem in _differences(first, other)])
    with_poses = [log for log in logs if log.groups.keys() >= set(needed)]
    return Measurements(tuple(logs), *find_static_poses(with_poses, spec))


def _differences(first: Log, other: Log) -> Iterator[tuple[str, str]]:
    """Find shared columns whose number or range shows that two logs are of different arms."""
    for name in (*NEEDED, "tip_quaternion", "marker_m"):
        a, b = getattr(first, name), getattr(other, name)
        if a is None or b is None:
            continue  # springs on a ruler need no motion capture, poses no ruler
        if a.shape[1:] != b.shape[1:]:
            yield name, f"got {a.shape[1]} and {b.shape[1]} in a row, expected logs of one arm"
        elif name in _FACTORS:
            sizes = [np.linalg.norm(value, axis=1) if name == "tip_m" else value for value in (a, b)]
            low, high = zip(*(np.percentile(size, [1, 99]) for size in sizes), strict=True)
            if max(low) > _FACTORS[name] * min(high):
                ranges = " and ".join(f"{low[k]:.4g} to {high[k]:.4g}" for k in range(2))
                yield name, f"got {ranges}, expected ranges that meet in logs of one arm"
