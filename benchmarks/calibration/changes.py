"""Arms that change after their calibration, and come back by one circle's log, without training.

The commands are those of `docs/why.md`. An aged twin is the same arm with shifted zeros and softer chambers.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.accuracy.arms import accuracy_of, run_command
from benchmarks.harness.common import target, three_of
from mjx_softarm._support.errors import InputError

WITHIN = 1.3  # target: error on the circle once back, over the error before the change


def measure(arms: tuple[str, ...], points: int = 16) -> dict[str, Any]:
    """Is an arm whose zeros have shifted by 1 mm and whose chambers are 5 % softer back after one circle?

    Args:
        arms: ARM=RUN=CALIBRATION of each, such as twin:0=runs/mine=mine: a twin, an exported run of its
            calibration, and this calibration
        points: of the circle

    Raises:
        InputError: there are no arms, one has another form, or a command failed.
    """
    if not arms:
        raise InputError("--arms: got none, expected ARM=RUN=CALIBRATION of each")
    with tempfile.TemporaryDirectory() as folder:
        rows = [_measure(Path(folder) / str(k), text, points) for k, text in enumerate(arms)]
    return {"targets": [_target(row) for row in rows], "arms": rows}


def _measure(folder: Path, text: str, points: int) -> dict[str, Any]:
    """Measure an arm, the aged arm, and the aged arm once its calibration has gone on."""
    arm, run, calibration = three_of(text, "--arms", "ARM=RUN=CALIBRATION")
    folder.mkdir()
    # The circle, before and after the arm has aged
    policy, later, renewed = Path(run) / "policy.npz", folder / "later", folder / "renewed.npz"
    circle = "--points", points
    first = accuracy_of(policy, arm, folder / "first", *circle)
    aged = accuracy_of(policy, f"{arm}:aged", folder / "aged", *circle)
    # The calibration goes on with the aged circle's log; the policy gets its models
    go_on = "calib", "run", folder / "aged/log.npz", "--since", calibration, "--out", later
    run_command(*go_on, makes=later)
    export = "train", "export", run, "--calibration", later, "--out", renewed
    enough = run_command(*export, makes=renewed) == 0
    back = accuracy_of(renewed, f"{arm}:aged", folder / "back", *circle)
    changes = json.loads((later / "report.json").read_text("utf-8"))["parts"]["Changes"]["figures"]
    return {
        "arm": arm,
        "before [mm]": first["translation_mm"],
        "aged [mm]": aged["translation_mm"],
        "back [mm]": back["translation_mm"],
        "back, over before": back["translation_mm"] / first["translation_mm"],
        "largest part, aged": aged["budget"]["largest"],
        "this part [mm]": aged["budget"]["parts_mm"][aged["budget"]["largest"]],
        "payload told: before, aged, back [g]": "{:.0f}, {:.0f}, {:.0f}".format(
            *(one["load_estimate_g"] for one in (first, aged, back))
        ),
        "springs' zeros found [mm]": ", ".join(f"{1e3 * x:+.1f}" for x in changes["zero_m"]),
        "without training": enough,
    }


def _target(row: dict[str, Any]) -> dict[str, str]:
    ratio = row["back, over before"]
    return target(
        f"{row['arm']}: back within {WITHIN} times the error before",
        f"{ratio:.2f} times, without training: {row['without training']}",
        ratio <= WITHIN and row["without training"],
    )
