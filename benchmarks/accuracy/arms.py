"""Arms of several kinds: recorded and calibrated from their own rod twins, trained, measured.

The commands are those of `docs/your-arm.md`. Each arm is measured around a circle and at a grid of goals over
its workspace. An arm is one job, whose results stay in its folder: the same command goes on where it ended.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from benchmarks.harness.common import names_of, target
from benchmarks.harness.parallel import in_parallel
from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.fields import scaled
from mjx_softarm.spec import ArmSpec

DONE = (0, 1)  # exit statuses after which there are results
N_MOVING = 8  # poses of a log of all ticks, to which the regulators are fitted
WITHIN = 0.005  # target: mean error on the circle, as a share of the arm's length


# Arms that ship, the turn of their bases, and the share of their masses. An arm that stands must do so
# without pressure, before it is calibrated: the paper's arm, of 4.7 kg, falls over, a tenth of it stands.
HANGS, STANDS = (0.0, 0.0, 0.0), (180.0, 0.0, 0.0)
ARMS = {
    "paper": ("paper", HANGS, 1.0),
    "sopra": ("sopra", HANGS, 1.0),
    "stiff-flop": ("stiff-flop", HANGS, 1.0),
    "four-chamber": ("four-chamber", HANGS, 1.0),
    "upright": ("paper", STANDS, 0.1),
}


def measure(
    arms: Annotated[tuple[str, ...], names_of(ARMS)] = tuple(ARMS),
    poses: int = 300,
    preset: str = "analytic",
    steps: int | None = None,
    points: int = 40,
    keep: cli.MaybePath = None,
) -> dict[str, Any]:
    """How well do arms of several kinds follow goals, from recording to measurement, by the same commands?

    Each is recorded, calibrated, trained and measured on a rod twin with seed 0.

    Args:
        arms: names of arms
        poses: random poses of each calibration
        preset: of each training
        steps: environment steps of each training; None: the preset's
        points: goals of the circle, and of the grid at most
        keep: folder for logs, calibrations and runs, to go on with later; without one they are deleted
    """
    with tempfile.TemporaryDirectory() as folder:
        home = (keep or Path(folder)).absolute()
        jobs = [(arm, _measure, (arm, home / arm, poses, preset, steps, points)) for arm in arms]
        found = in_parallel(jobs)
    return {"targets": targets([found[arm] for arm in arms], arms), **{arm: found[arm] for arm in arms}}


def targets(figures: Sequence[dict[str, Any]], arms: Sequence[str]) -> list[dict[str, str]]:
    """Return the target of each arm's circle."""
    rows = []
    for arm, row in zip(arms, figures, strict=True):
        share, length_mm = row["circle, mean [mm]"] / row["length [mm]"], row["length [mm]"]
        n, n_measured = row["circle, goals"], row["circle, measured"]
        rows.append(
            target(
                f"{arm}: circle within {WITHIN:.1%} of {length_mm:g} mm, no goal refused",
                f"{share:.2%} in the mean, {n - n_measured} of {n} goals refused",
                share <= WITHIN and n == n_measured,
            )
        )
    return rows


def _measure(
    arm: str, folder: Path, poses: int, preset: str, steps: int | None, points: int
) -> dict[str, Any]:
    """Take an arm through all commands; leave out those whose results are there."""
    # The arm, and its stand-in
    folder.mkdir(parents=True, exist_ok=True)
    (name, turn_deg, share), file = ARMS[arm], folder / "arm.toml"
    spec = ArmSpec.of(Path(name))
    masses = {part: scaled(getattr(spec.mass, part), share) for part in ("arm_kg", "gripper_kg")}
    spec = spec.replace(mass=masses, mounting={"base_turn_deg": turn_deg})
    spec.to_toml(file)
    twin, calibration = f"twin:rod:0@{file}", folder / "calibration"
    run, policy = folder / "run", folder / "run/policy.npz"
    logs = {folder / "poses.npz": (poses,), folder / "moving.npz": (N_MOVING, "--transients")}

    # Record, calibrate, train and export
    record = ("mjx_softarm.deploy", "record", "--arm", twin, "--spec", file)
    for log, options in logs.items():
        if not log.exists():
            run_command(*record, "--poses", *options, "--out", log, makes=log)
    if not calibration.exists():
        report = calibration / "report.json"
        run_command("calib", "run", *logs, "--spec", file, "--out", calibration, makes=report)
    if not (run / "evaluation.json").exists():
        options = ("--learner.total-env-steps", steps) if steps else ()
        anew = ("--preset", preset, "--calibration", calibration, *options, "--out", run)
        arguments = ("--resume", run) if (run / "config.json").exists() else anew
        run_command("train", "reach", *arguments, makes=run / "evaluation.json")
    if not policy.exists():
        run_command("train", "export", run, makes=policy)

    # Measure the policy on the twin
    figures = {"length [mm]": 1e3 * spec.length_m, **_figures(folder)}
    for goals in ("circle", "grid"):
        out = folder / goals
        if not (out / "accuracy.json").exists():
            accuracy_of(policy, twin, out, "--goals", goals, "--points", points)
        accuracy = json.loads((out / "accuracy.json").read_text("utf-8"))
        figures |= {f"{goals}, {what}": accuracy[key] for what, key in FIGURES.items()}
    return figures


FIGURES = {
    "goals": "points",
    "measured": "measured",
    "reached": "reached",
    "mean [mm]": "translation_mm",
    "95 % [mm]": "translation_95_mm",
    "largest [mm]": "max_mm",
    "mean [deg]": "rotation_deg",
    "saturated": "saturated_points",
}


def _figures(folder: Path) -> dict[str, Any]:
    """Return figures of a calibration's report."""
    report = json.loads((folder / "calibration/report.json").read_text("utf-8"))
    chambers, network = (report["parts"][title]["figures"] for title in ("Chambers", "Sim-to-real network"))
    return {
        "calibration without warnings": report["trustworthy"],
        "unknown directions": len(chambers["weak"]),
        "tip without S2R, held out [mm]": network["test_uncorrected"]["translation_mean_mm"],
        "tip with S2R, held out [mm]": network["test"]["translation_mean_mm"],
    }


def accuracy_of(policy: Path, arm: str, out: Path, *options: Any) -> dict[str, Any]:
    """Measure a policy on an arm by `deploy measure`; return the figures, which stay in the new folder `out`.

    Raises:
        InputError: the command failed, or arrived at no goal.
    """
    file = out / "accuracy.json"
    run_command("mjx_softarm.deploy", "measure", policy, "--arm", arm, *options, "--out", out, makes=file)
    return json.loads(file.read_text("utf-8"))


def run_command(*words: Any, makes: Path) -> int:
    """Run a command of this project, its output shown; return its exit status, one of `DONE`.

    Args:
        words: of the command line, after `python -m`.
        makes: file that the command writes. A command that ends with an exception has status 1, too.

    Raises:
        InputError: the command ended with none of `DONE`, or without the file.
    """
    command = [str(word) for word in words]
    status = subprocess.run([sys.executable, "-m", *command], check=False).returncode
    asked = f"python -m {' '.join(command)}"
    if status not in DONE:
        raise InputError(f"{asked}: got exit status {status}, expected {' or '.join(map(str, DONE))}")
    if not makes.exists():
        raise InputError(f"{asked}: got no file {makes}, expected its results")
    return status
