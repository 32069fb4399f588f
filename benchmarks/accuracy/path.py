"""The paper's circle on twins, in time and stop by stop, by policies trained at rest and in motion."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from benchmarks.accuracy.arms import accuracy_of
from benchmarks.harness.common import target
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


class _Chosen(NamedTuple):
    """A policy and its arm."""

    trained: str  # "at rest" or "in motion"
    arm: str
    file: Path

    @classmethod
    def of(cls, text: str) -> Self:
        """Read ARM=FILE."""
        arm, separator, file = text.partition("=")
        if not separator:
            raise InputError(f"--policies: got {text}, expected ARM=FILE, such as twin:0=policy.npz")
        return cls("in motion" if load_policy(file).action_s else "at rest", arm, Path(file))


def measure(
    policies: tuple[str, ...],
    seconds: tuple[float, ...] = (10.0, 20.0, 40.0),
    points: int = 80,
    stops: int = 40,
) -> dict[str, Any]:
    """Follow a circle in time, and stop by stop, with policies for twins.

    Args:
        policies: ARM=FILE of each, such as twin:0=runs/mine/policy.npz, as `python -m train export` wrote it
        seconds: once around in so long [s]
        points: of the circle, passed without a stop
        stops: points at which the arm comes to rest, and its time is taken

    Raises:
        InputError: there are no policies, one cannot be measured, or means would be of different arms.
    """
    if not policies:
        raise InputError("--policies: got none, expected ARM=FILE of each policy")
    chosen = [_Chosen.of(text) for text in policies]
    arms = {of: sorted(each.arm for each in chosen if each.trained == of) for of in ("at rest", "in motion")}
    if all(arms.values()) and arms["at rest"] != arms["in motion"]:
        got = "; ".join(f"{of} {', '.join(names)}" for of, names in arms.items())
        raise InputError(f"--policies: got {got}, expected the same arms of both, since means are compared")
    in_time, stopping = [], []
    with tempfile.TemporaryDirectory() as folder:
        for trained, arm, policy in chosen:
            told = {"trained": trained, "arm": arm, "policy": str(policy)}
            for duration in seconds:
                found = _measured(Path(folder), policy, arm, "--points", points, "--seconds", duration)
                in_time.append({**told, "once around [s]": duration, **_named(IN_TIME, found)})
            found = _measured(Path(folder), policy, arm, "--points", stops)
            stopping.append({**told, **_named(STOPPING, found)})
    means = {
        "means in time": means_over(in_time, ("trained", "once around [s]"), IN_TIME),
        "means stop by stop": means_over(stopping, ("trained",), STOPPING),
    }
    return {
        "targets": targets(means["means in time"]),
        **means,
        "in time": in_time,
        "stop by stop": stopping,
    }


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
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return [
        dict(zip(keys, values, strict=True))
        | {"policies": len(group)}
        | {name: float(np.mean([row[name] for row in group])) for name in names}
        for values, group in groups.items()
    ]


def _measured(folder: Path, policy: Path, arm: str, *options: Any) -> dict[str, Any]:
    """Return the figures of one measurement.

    Raises:
        InputError: a goal of it was refused or not measured.
    """
    out = Path(tempfile.mkdtemp(dir=folder)) / "measured"
    found = accuracy_of(policy, arm, out, *options)
    n_measured, n_goals = found["measured"], found["points"]
    if "way_mm" not in found and n_measured < n_goals:
        raise InputError(f"--policies: {arm}={policy}: got {n_measured} of {n_goals} goals, expected all")
    return found


def _named(names: dict[str, str], found: dict[str, Any]) -> dict[str, Any]:
    return {name: found[key] for name, key in names.items()}
