"""The paper's circle on twins, in time and stop by stop, by policies trained at rest and in motion."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy.arms import accuracy_of
from benchmarks.harness.common import arms_and_files, grouped, target
from mjx_softarm._support.errors import InputError
from mjx_softarm.policy.file import load_policy

IN_TIME = {
    "mean [mm]": "way_mm",
    "95 % [mm]": "way_95_mm",
    "largest [mm]": "way_max_mm",
    "behind [s]": "lag_s",
    "mean without that [mm]": "way_without_lag_mm",
}
WITHIN_MM, AROUND_S = 4.0, 20.0  # target: mean error [mm] on a circle that takes so long [s]
STOPPING = {"mean [mm]": "translation_mm", "largest [mm]": "max_mm", "seconds": "seconds"}


def measure(
    policies: tuple[str, ...],
    seconds: tuple[float, ...] = (10.0, 20.0, 40.0),
    points: int = 80,
    stops: int = 40,
) -> dict[str, Any]:
    """How far is the tip off the circle in time and with stops, trained at rest and in motion?

    Args:
        policies: ARM=FILE of each, such as twin:0=runs/mine/policy.npz, as `python -m train export` wrote it
        seconds: once around in so long [s]
        points: of the circle, passed without a stop
        stops: points at which the arm comes to rest, and its time is taken

    Raises:
        InputError: there are no policies, one cannot be measured, or means would be of different arms.
    """
    in_time, stopping = [], []
    chosen = _chosen(policies)
    with tempfile.TemporaryDirectory() as folder:
        for told in chosen:
            # In time, at each pace.
            for duration in seconds:
                found = _measured(Path(folder), told, "--points", points, "--seconds", duration)
                figures = {name: found[key] for name, key in IN_TIME.items()}
                in_time.append({**told, "once around [s]": duration, **figures})
            # Stop by stop.
            found = _measured(Path(folder), told, "--points", stops)
            stopping.append({**told, **{name: found[key] for name, key in STOPPING.items()}})
    means_in_time = means_over(in_time, ("trained", "once around [s]"), IN_TIME)
    return {
        "targets": targets(means_in_time),
        "means in time": means_in_time,
        "means stop by stop": means_over(stopping, ("trained",), STOPPING),
        "in time": in_time,
        "stop by stop": stopping,
    }


def _chosen(policies: Sequence[str]) -> list[dict[str, str]]:
    """Return how each policy was trained, its arm and its file.

    Raises:
        InputError: there are none, one is no ARM=FILE, or arms at rest and in motion differ.
    """
    chosen, arms = [], {"at rest": [], "in motion": []}
    for arm, file in arms_and_files(policies):
        trained = "in motion" if load_policy(file).action_s else "at rest"
        chosen.append({"trained": trained, "arm": arm, "policy": file})
        arms[trained].append(arm)
    if all(arms.values()) and sorted(arms["at rest"]) != sorted(arms["in motion"]):
        got = "; ".join(f"{trained} {', '.join(sorted(names))}" for trained, names in arms.items())
        raise InputError(f"--policies: got {got}, expected the same arms of both, since means are compared")
    return chosen


def targets(means: Sequence[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the target at `AROUND_S` for policies trained at rest, and for those trained in motion."""
    return [
        target(
            f"trained {row['trained']}, once around in {AROUND_S:g} s: mean at most {WITHIN_MM:g} mm",
            f"{row['mean [mm]']:.2f} mm",
            row["mean [mm]"] <= WITHIN_MM,
        )
        for row in means
        if row["once around [s]"] == AROUND_S
    ]


def means_over(
    rows: Sequence[dict[str, Any]], keys: Sequence[str], names: Iterable[str]
) -> list[dict[str, Any]]:
    """Return a row of means for each combination of the keys' values, in the order of their first rows."""
    return [
        dict(zip(keys, values, strict=True))
        | {"policies": len(group)}
        | {name: float(np.mean([row[name] for row in group])) for name in names}
        for values, group in grouped(rows, keys).items()
    ]


def _measured(folder: Path, told: dict[str, str], *options: Any) -> dict[str, Any]:
    """Return the figures of one measurement.

    Raises:
        InputError: a goal of it was refused or not measured.
    """
    out, arm, policy = Path(tempfile.mkdtemp(dir=folder)) / "measured", told["arm"], told["policy"]
    found = accuracy_of(Path(policy), arm, out, *options)
    n_measured, n_goals = found["measured"], found["points"]
    if "way_mm" not in found and n_measured < n_goals:
        raise InputError(f"--policies: {arm}={policy}: got {n_measured} of {n_goals} goals, expected all")
    return found
