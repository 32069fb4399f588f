"""One moment of an arm, from a tick of the loop or a row of a log, for all pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.control import TOLERANCE_M, Gains, saturated
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.logs.schema import Log
from mjx_softarm.sensing.pose import pose_error, pose_from_quaternion
from mjx_softarm.spec import ArmSpec


class Look(NamedTuple):
    """Numbers to show; NaN if unknown."""

    time_s: float
    spring_m: np.ndarray  # (n_springs,)
    reference_m: np.ndarray  # (n_springs,)
    pressure_kpa: np.ndarray  # (n_chambers,)
    saturated: np.ndarray  # (n_chambers,) bool, chambers at a limit whose springs are off their references
    estimate: np.ndarray  # (6,) [mm, deg] estimated tip pose
    goal: np.ndarray  # (6,) [mm, deg]
    seen: np.ndarray  # (6,) [mm, deg] tip pose from motion capture
    marker_m: np.ndarray  # (k, 3)
    payload_kg: float = 0.0
    load_kg: float = np.nan  # payload that the loop believes

    @property
    def tip(self) -> np.ndarray:
        """Tip pose (6,) for the picture: the estimated pose, or the seen pose if no estimate is logged."""
        return self.estimate if np.isfinite(self.estimate).all() else self.seen

    def error_mm(self, pose: np.ndarray) -> float:
        """Return the distance [mm] of a pose (6,) from the goal."""
        return float(np.linalg.norm(pose_error(pose, self.goal)[:3]))


def look_at(
    row: Mapping[str, Any],
    spring_m: np.ndarray,
    spec: ArmSpec,
    tolerance_m: float = TOLERANCE_M,
    payload_kg: float = 0.0,
) -> Look:
    """Return the look of a row of the loop or of a log of an arm, with spring lengths (n_springs,) [m].

    A chamber at a limit is saturated where its spring is off by more than the tolerance.
    """
    seen = pose = np.full(6, np.nan)
    if "tip_m" in row and "tip_quaternion" in row and np.isfinite(row["tip_quaternion"]).all():
        seen = pose_from_quaternion(row["tip_m"], row["tip_quaternion"])
    reference_m = row.get("reference_m", np.full(spec.n_springs, np.nan))
    pressure_kpa = row.get("pressure_kpa", np.full(spec.n_chambers, np.nan))
    gains = Gains.from_spec(spec).measured()
    return Look(
        time_s=float(row["time_s"]),
        spring_m=spring_m,
        reference_m=reference_m,
        pressure_kpa=pressure_kpa,
        saturated=saturated(pressure_kpa, reference_m, spring_m, gains, tolerance_m),
        estimate=row.get("estimate", pose),
        goal=row.get("goal", pose),
        seen=seen,
        marker_m=row.get("marker_m", np.empty((0, 3))),
        payload_kg=float(row.get("payload_kg", payload_kg)),
        load_kg=float(row.get("load_kg", np.nan)),
    )


def looks(log: Log, spec: ArmSpec) -> Callable[[int], Look]:
    """Return a function from the rows of an arm's log to their looks.

    Raises:
        LogError: the log has neither readings nor spring lengths.
    """
    sensor = spec.spring_sensor
    spring_m = log.lengths_m(sensor)
    if spring_m is None:
        problem = f"got neither {sensor.reading_name}0.. nor spring0.., expected springs to draw the arm by"
        raise LogError([Finding(log.source, None, "", problem)])
    groups = ("time_s", "pressure_kpa", "tip_m", "tip_quaternion", "marker_m")
    names = (*groups, "payload_kg", "load_kg", "reference_m", "goal", "estimate")
    present = {name: value for name in names if (value := getattr(log, name)) is not None}
    return lambda k: look_at({name: value[k] for name, value in present.items()}, spring_m[k], spec)
