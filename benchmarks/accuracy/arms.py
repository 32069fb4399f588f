"""Arms that ship: recorded and calibrated from their own rod twins, trained, measured.

The commands are those of `docs/your-arm.md`. Each arm is measured at a grid of goals over its workspace, and
the paper's arm also around its circle.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

from benchmarks.harness.common import names_of
from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError

DONE = (0, 1)  # exit statuses after which there are results
N_MOVING = 8  # poses of a log of all ticks, to which the regulators are fitted

ARMS = ("paper", "sopra", "stiff-flop")


def measure(
    arms: Annotated[tuple[str, ...], names_of(ARMS)] = ARMS,
    poses: int = 300,
    steps: int | None = None,
    points: int = 40,
    keep: cli.MaybePath = None,
) -> dict[str, Any]:
    """How well do the arms that ship follow goals, from recording to measurement, by the same commands?

    Each is recorded, calibrated, trained and measured on a rod twin with seed 0.

    Args:
        arms: the package's names of arms
        poses: random poses of each calibration
        steps: environment steps of each training; None: the preset's
        points: goals of the grid, at most
        keep: folder for logs, calibrations and runs; without one they are deleted
    """
    with tempfile.TemporaryDirectory() as folder:
        return {arm: _measure(arm, (keep or Path(folder)) / arm, poses, steps, points) for arm in arms}


def _measure(arm: str, folder: Path, poses: int, steps: int | None, points: int) -> dict[str, Any]:
    # Record, calibrate, train and export.
    folder.mkdir(parents=True)
    twin, calibration = f"twin:rod:0@{arm}", folder / "calibration"
    logs = folder / "poses.csv", folder / "moving.csv"
    run, policy = folder / "run", folder / "run/policy.npz"
    record = ["mjx_softarm.deploy", "record", "--arm", twin, "--spec", arm]
    train = ["train", "reach", "--preset", "analytic", "--calibration", calibration, "--out", run]
    run_command(*record, "--poses", poses, "--out", logs[0])
    run_command(*record, "--poses", N_MOVING, "--transients", "--out", logs[1])
    distrusted = run_command("calib", "run", *logs, "--spec", arm, "--out", calibration)
    run_command(*train, *(("--learner.total-env-steps", steps) if steps else ()))
    run_command("train", "export", run)
    # Measure the policy on the twin.
    options = {"grid": ["--goals", "grid", "--points", points]}
    if arm == "paper":
        options["circle"] = ["--goals", "circle"]
    figures = _figures(folder, distrusted)
    for goals, given in options.items():
        accuracy = accuracy_of(policy, twin, folder / goals, *given)
        figures |= {f"{goals}, {what}": accuracy[key] for what, key in FIGURES.items()}
    return figures


FIGURES = {
    "goals": "points",
    "measured": "measured",
    "reached": "reached",
    "mean [mm]": "translation_mm",
    "95 % [mm]": "translation_95_mm",
    "mean [deg]": "rotation_deg",
    "saturated": "saturated_points",
}


def _figures(folder: Path, distrusted: int) -> dict[str, Any]:
    """Return figures of a calibration's report."""
    parts = json.loads((folder / "calibration/report.json").read_text())["parts"]
    chambers, network = (parts[title]["figures"] for title in ("Chambers", "Sim-to-real network"))
    return {
        "calibration's exit status": distrusted,
        "unknown directions": len(chambers["weak"]),
        "tip without S2R, held out [mm]": network["test_uncorrected"]["translation_mean_mm"],
        "tip with S2R, held out [mm]": network["test"]["translation_mean_mm"],
    }


def accuracy_of(policy: Path, arm: str, out: Path, *options: Any) -> dict[str, Any]:
    """Measure a policy on an arm by `deploy measure`; return the figures, which stay in the new folder `out`.

    Raises:
        InputError: the command failed, or no goal was arrived at.
    """
    run_command("mjx_softarm.deploy", "measure", policy, "--arm", arm, *options, "--out", out)
    file = out / "accuracy.json"
    if not file.exists():
        raise InputError(f"{arm}={policy}: got no measured goal, expected all")
    return json.loads(file.read_text("utf-8"))


def run_command(*words: Any) -> int:
    """Run a command of this project, its output shown; return its exit status.

    Raises:
        InputError: the command ended with none of `DONE`.
    """
    command = [str(word) for word in words]
    status = subprocess.run([sys.executable, "-m", *command], check=False).returncode
    if status not in DONE:
        expected = " or ".join(map(str, DONE))
        raise InputError(f"python -m {' '.join(command)}: got exit status {status}, expected {expected}")
    return status
