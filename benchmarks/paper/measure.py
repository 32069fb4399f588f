"""What a run around the circle gave: errors by motion capture at each arrival, saturation, traces.

Motion capture is noisy: an error is the mean over the window in which the springs had settled.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.control import saturated
from mjx_softarm.deploy import faults
from mjx_softarm.deploy.loop import Controller
from mjx_softarm.deploy.session import Run
from mjx_softarm.sensing.pose import pose_error, pose_from_quaternion
from mjx_softarm.sensing.sensors import length_from_frequency

AT_LIMIT_KPA = 0.1  # from a limit, of a window's mean of measured pressures
TRACE_S = 0.5  # between the rows of a trace


class Followed(NamedTuple):
    """A run over p points, of an arm with n springs; what was not reached is NaN."""

    goal: Any  # (p, 6) [mm, deg]
    error: Any  # (p, 6) [mm, deg] of the tip by motion capture
    believed: Any  # (p, 6) [mm, deg] pose that the loop believed in, less the goal
    saturated: Any  # (p, n) chambers at a limit with their springs off the references, at the arrivals
    events: Any  # (faults,) how often the loop told each of `faults.Fault`
    latency_s: Any  # (2,) median and 99.9 % of a tick's computing
    time_s: Any  # (k,) of the trace
    point: Any  # (k,) index of the goal, -1 without one
    reference_m: Any  # (k, n)
    spring_m: Any  # (k, n) as read
    pressure_kpa: Any  # (k, n) as measured


class Driven:
    """A twin of which something is noted each time it was driven; else the twin itself."""

    def __init__(self, twin: Any, note: Callable[[], None]):
        self._twin, self._note = twin, note

    def __getattr__(self, name: str) -> Any:
        return getattr(self._twin, name)

    def read_frequencies(self) -> np.ndarray:
        """Read the twin; see `ArmIO`."""
        return self._twin.read_frequencies()

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Drive the twin; see `ArmIO`."""
        self._twin.write_pressures(pressure_kpa)
        self._note()


def measure(run: Run, controller: Controller, goals: np.ndarray) -> Followed:
    """Errors, saturation and traces of a run towards goals (p, 6) [mm, deg]."""
    log, policy, window = run.log, controller.policy, controller.window
    assert log.pressure_kpa is not None and log.reference_m is not None and log.goal is not None
    spring_m = length_from_frequency(log.frequency_hz, policy.sensor, np.nan).length_m
    seen = pose_from_quaternion(log.tip_m, log.tip_quaternion)
    error, believed = np.full((2, *goals.shape), np.nan)
    mask = np.zeros((len(goals), policy.spec.n_chambers), bool)
    gains = policy.gains._replace(
        pressure_min_kpa=policy.gains.pressure_min_kpa + AT_LIMIT_KPA,
        pressure_max_kpa=policy.gains.pressure_max_kpa - AT_LIMIT_KPA,
    )
    for arrival in run.arrivals:
        point = point_of(arrival.goal, goals)
        rows = slice(max(0, arrival.row + 1 - window), arrival.row + 1)
        error[point] = pose_error(seen[rows], arrival.goal).mean(axis=0)
        believed[point] = pose_error(np.asarray(arrival.estimate, float), arrival.goal)
        mask[point] = saturated(
            log.pressure_kpa[rows].mean(axis=0),
            log.reference_m[arrival.row],
            spring_m[rows].mean(axis=0),
            gains,
            faults.TOLERANCE_M,
        )
    counts = run.counts()
    every = slice(None, None, max(1, round(TRACE_S / controller.dt_s)))
    return Followed(
        goal=goals,
        error=error,
        believed=believed,
        saturated=mask,
        events=np.array([counts.get(fault, 0) for fault in faults.Fault]),
        latency_s=np.quantile(run.latency_s, (0.5, 0.999)),
        time_s=log.time_s[every],
        point=np.array([point_of(goal, goals) for goal in log.goal[every]]),
        reference_m=log.reference_m[every],
        spring_m=spring_m[every],
        pressure_kpa=log.pressure_kpa[every],
    )


def point_of(goal: np.ndarray, goals: np.ndarray) -> int:
    """Index of a goal among the goals (p, 6); -1 where there is none."""
    return -1 if np.isnan(goal).any() else int(np.argmin(np.abs(goals - goal).sum(axis=1)))


def save_followed(path: Path, followed: Followed) -> None:
    """Write a result whole or not at all."""
    save_arrays(path, followed._asdict())


def load_followed(path: Path) -> Followed:
    """The result that `save_followed` wrote."""
    return Followed(**load_arrays(path, Followed._fields))


def save_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays by name as npz, whole or not at all."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            np.savez_compressed(file, **arrays)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def load_arrays(path: Path, names: Iterable[str]) -> dict[str, Any]:
    """Arrays of those names that `save_arrays` wrote."""
    with np.load(path) as file:
        return {name: file[name] for name in names}


def figures(followed: Followed) -> dict[str, Any]:
    """The figures of one run that stand in tables, over the points that were reached."""
    n_reached, error = reached(followed.error)
    away = np.linalg.norm(error[:, :3], axis=1)
    yaw, pitch, roll = np.abs(error[:, 3:]).mean(axis=0)
    per_point = followed.saturated.sum(axis=1)
    events = told(followed.events)
    return {
        "points": len(followed.goal),
        "reached": n_reached,
        "translation_mm": float(away.mean()),
        "rmse_mm": float(np.sqrt(np.mean(away**2))),
        "max_mm": float(away.max()),
        "yaw_deg": float(yaw),
        "pitch_deg": float(pitch),
        "roll_deg": float(roll),
        "believed_mm": _believed_mm(followed),
        "saturated_points": int(np.count_nonzero(per_point)),
        "saturated_chambers_max": int(per_point.max()),
        "saturation_events": events.get(faults.Fault.SATURATED.value, 0),
        "events": events,
        "seconds": float(followed.time_s[-1]),
        "latency_ms": [round(1e3 * float(value), 3) for value in followed.latency_s],
    }


def reached(error: np.ndarray) -> tuple[int, np.ndarray]:
    """How many of the points were reached, and their rows of the errors (p, 6); without any, a row of NaN."""
    rows = error[np.isfinite(error).all(axis=1)]
    return len(rows), rows if len(rows) else np.full((1, error.shape[1]), np.nan)


def told(events: np.ndarray) -> dict[str, int]:
    """How often the loop told each fault (faults,) that it told at all, by name."""
    return {fault.value: int(n) for fault, n in zip(faults.Fault, events, strict=True) if n}


def _believed_mm(followed: Followed) -> float:
    away = np.linalg.norm(followed.believed[:, :3], axis=1)
    return float(away[np.isfinite(away)].mean()) if np.isfinite(away).any() else float("nan")
