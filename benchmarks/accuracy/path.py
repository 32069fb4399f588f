"""The paper's circle on a twin, in time and stop by stop, by policies trained at rest and in motion."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.accuracy.arms import run_command
from mjx_softarm._support.errors import InputError

IN_TIME = {
    "mean [mm]": "way_mm",
    "95 % [mm]": "way_95_mm",
    "largest [mm]": "way_max_mm",
    "behind [s]": "lag_s",
    "mean without that [mm]": "way_without_lag_mm",
}
STOPPING = {"mean [mm]": "translation_mm", "largest [mm]": "max_mm", "seconds": "seconds"}


def measure(
    policies: tuple[Path, ...],
    arm: str = "twin:0",
    seconds: tuple[float, ...] = (10.0, 20.0, 40.0),
    points: int = 80,
    stops: int = 40,
) -> dict[str, Any]:
    """Follow a circle in time, and stop by stop, with policies for a twin.

    Args:
        policies: files that `python -m train export` wrote, for the arm
        arm: the twin
        seconds: once around in so long [s]
        points: of the circle, passed without a stop
        stops: points at which the arm comes to rest, and its time is taken

    Raises:
        InputError: there are no policies, or one cannot be measured.
    """
    if not policies:
        raise InputError("--policies: got none, expected files that `python -m train export` wrote")
    in_time, stopping = [], []
    with tempfile.TemporaryDirectory() as folder:
        for policy in policies:
            for duration in seconds:
                found = _measured(Path(folder), policy, arm, "--points", points, "--seconds", duration)
                in_time.append({"policy": policy.stem, "once around [s]": duration, **_named(IN_TIME, found)})
            found = _measured(Path(folder), policy, arm, "--points", stops)
            stopping.append({"policy": policy.stem, **_named(STOPPING, found)})
    return {"arm": arm, "in time": in_time, "stop by stop": stopping}


def _measured(folder: Path, policy: Path, arm: str, *options: Any) -> dict[str, Any]:
    out = Path(tempfile.mkdtemp(dir=folder)) / "measured"
    run_command("mjx_softarm.deploy", "measure", policy, "--arm", arm, *options, "--out", out)
    return json.loads((out / "accuracy.json").read_text("utf-8"))


def _named(names: dict[str, str], found: dict[str, Any]) -> dict[str, Any]:
    return {name: found[key] for name, key in names.items()}
