"""One moment of an arm, from a tick of the loop or a row of a log, as all pictures of it are made from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.control import TOLERANCE_M, Gains, saturated
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.logs.schema import Log
from mjx_softarm.sensing.pose import pose_error, pose_from_quaternion
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import ArmSpec


class Look(NamedTuple):
    """Numbers to show; NaN where one is not known."""

    time_s: float
    spring_m: np.ndarray  # (n,)
    reference_m: np.ndarray  # (n,)
    pressure_kpa: np.ndarray  # (n,)
    estimate: np.ndarray  # (6,) [mm, deg] tip pose believed in
    goal: np.ndarray  # (6,) [mm, deg]
    seen: np.ndarray  # (6,) [mm, deg] tip pose by motion capture
    marker_m: np.ndarray  # (k, 3)
    payload_kg: float = 0.0

    @property
    def tip(self) -> np.ndarray:
        """Tip pose (6,) to draw the arm with: the believed one, or the seen one where none is logged."""
        return self.estimate if np.isfinite(self.estimate).all() else self.seen

    def error_mm(self, pose: np.ndarray) -> float:
        """Return the distance [mm] of a pose (6,) from the goal."""
        return float(np.linalg.norm(pose_error(pose, self.goal)[:3]))


class Limits(NamedTuple):
    """Limits of pressures and springs, for scales and marks."""

    gains: Gains
    spring_m: tuple[float, float]

    @classmethod
    def of(cls, spec: ArmSpec) -> Limits:
        return cls(Gains.from_spec(spec), (spec.springs.length_min_m, spec.springs.length_max_m))

    def saturated(self, look: Look) -> np.ndarray:
        """Return which chambers (n,) are at a limit with their springs off the references."""
        gains = self.gains.measured()
        return saturated(look.pressure_kpa, look.reference_m, look.spring_m, gains, TOLERANCE_M)


def look_at(row: Mapping[str, Any], spring_m: np.ndarray, payload_kg: float = 0.0) -> Look:
    """Return the look of a row as the loop logs it, or as a log has it, with its springs (n,) [m]."""
    unknown, pose = np.full(len(spring_m), np.nan), np.full(6, np.nan)
    seen = pose
    if "tip_m" in row and "tip_quaternion" in row and np.isfinite(row["tip_quaternion"]).all():
        seen = pose_from_quaternion(row["tip_m"], row["tip_quaternion"])
    return Look(
        time_s=float(row["time_s"]),
        spring_m=spring_m,
        reference_m=row.get("reference_m", unknown),
        pressure_kpa=row.get("pressure_kpa", unknown),
        estimate=row.get("estimate", pose),
        goal=row.get("goal", pose),
        seen=seen,
        marker_m=row.get("marker_m", np.empty((0, 3))),
        payload_kg=float(row.get("payload_kg", payload_kg)),
    )


def looks(log: Log, sensor: Sensor) -> Callable[[int], Look]:
    """Return what makes the look of each row of a log.

    Raises:
        LogError: the log has neither readings of this sensor nor spring lengths.
    """
    readings = log.readings_of(sensor)
    spring_m = log.spring_m if readings is None else sensor.lengths(readings, np.nan).length_m
    if spring_m is None:
        problem = f"got neither {sensor.reading_name}0.. nor spring0.., expected springs to draw the arm by"
        raise LogError([Finding(log.source, None, "", problem)])
    groups = ("time_s", "pressure_kpa", "tip_m", "tip_quaternion", "marker_m")
    names = (*groups, "payload_kg", "reference_m", "goal", "estimate")
    present = {name: value for name in names if (value := getattr(log, name)) is not None}
    return lambda k: look_at({name: value[k] for name, value in present.items()}, spring_m[k])
