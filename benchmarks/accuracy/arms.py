"""Arms of several kinds: recorded and calibrated, trained, measured.

Each is a rod twin with seed 0, or one whose rod is SoRoMoX's. The commands are those of `docs/your-arm.md`.
Each arm is measured around a circle and at a grid of goals over its workspace. With `--loads` it follows the
circle with payloads, too, which the loop is not told. An arm is one job, whose results stay in its folder:
the same command goes on where it ended.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from benchmarks.harness.common import names_of, target
from benchmarks.harness.parallel import in_parallel
from benchmarks.harness.peers import peer_python
from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.fields import scaled
from mjx_softarm.spec import ArmSpec

DONE = (0, 1)  # exit statuses after which there are results
N_MOVING = 8  # poses of a log of all ticks, to which the regulators are fitted
WITHIN = 0.005  # target: mean error on the circle, as a share of the arm's length


# Turns [deg] of the base. An arm that stands must do so without pressure, before it is calibrated: the arm of
# the paper, of 4.7 kg, falls over, a tenth of it stands.
HANGS, STANDS = (0.0, 0.0, 0.0), (180.0, 0.0, 0.0)


class Kind(NamedTuple):
    """An arm that ships, and the stand-in for it."""

    name: str  # as for `--spec`
    turn_deg: tuple[float, float, float] = HANGS  # of its base
    mass_share: float = 1.0
    driver: str = ""  # "": a rod twin
    peer: str = ""  # library of `benchmarks.harness.peers` in whose environment the driver runs

    def arm(self, file: Path) -> str:
        """Return the stand-in's name for `--arm`; a rod twin has the specification of `file`."""
        return self.driver or f"twin:rod:0@{file}"

    @property
    def python(self) -> Path | str:
        """Interpreter for commands with the stand-in."""
        return peer_python(self.peer) if self.peer else sys.executable


ARMS = {
    "paper": Kind("paper"),
    "sopra": Kind("sopra"),
    "stiff-flop": Kind("stiff-flop"),
    "four-chamber": Kind("four-chamber"),
    "upright": Kind("paper", STANDS, 0.1),
    "soromox": Kind("paper", driver="benchmarks.accuracy.soromox_arm:Arm", peer="soromox"),
}


def measure(
    arms: Annotated[tuple[str, ...], names_of(ARMS)] = tuple(name for name in ARMS if not ARMS[name].peer),
    poses: int = 300,
    preset: str = "analytic",
    steps: int | None = None,
    points: int = 40,
    loads: cli.Integers = (),
    keep: cli.MaybePath = None,
) -> dict[str, Any]:
    """How well do arms of several kinds follow goals, from recording to measurement, by the same commands?

    Args:
        arms: names of arms; all but soromox, which needs SoRoMoX's environment, unless given
        poses: random poses of each calibration
        preset: of each training
        steps: environment steps of each training; None: the preset's
        points: goals of the circle, and of the grid at most
        loads: payloads with which the circle is followed, too [g]
        keep: folder for logs, calibrations and runs, to go on with later; without one they are deleted
    """
    with tempfile.TemporaryDirectory() as folder:
        home = (keep or Path(folder)).absolute()
        jobs = [(arm, _measure, (arm, home / arm, poses, preset, steps, points, loads)) for arm in arms]
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
    arm: str,
    folder: Path,
    poses: int,
    preset: str,
    steps: int | None,
    points: int,
    loads: Sequence[int] = (),
) -> dict[str, Any]:
    """Take an arm through all commands; leave out those whose results are there."""
    # The arm, and its stand-in
    folder.mkdir(parents=True, exist_ok=True)
    kind, file = ARMS[arm], folder / "arm.toml"
    spec = ArmSpec.of(Path(kind.name))
    masses = {part: scaled(getattr(spec.mass, part), kind.mass_share) for part in ("arm_kg", "gripper_kg")}
    spec = spec.replace(mass=masses, mounting={"base_turn_deg": kind.turn_deg})
    spec.to_toml(file)
    calibration = folder / "calibration"
    run, policy = folder / "run", folder / "run/policy.npz"
    logs = {folder / "poses.npz": (poses,), folder / "moving.npz": (N_MOVING, "--transients")}

    # Record, calibrate, train and export
    record = ("mjx_softarm.deploy", "record", "--arm", kind.arm(file), "--spec", file)
    for log, options in logs.items():
        if not log.exists():
            run_command(*record, "--poses", *options, "--out", log, makes=log, python=kind.python)
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

    # Measure the policy on its arm
    figures = {"length [mm]": 1e3 * spec.length_m, **_figures(folder)}
    measured = {"circle": ("circle", 0), "grid": ("grid", 0)}
    measured |= {f"circle, {load_g} g": ("circle", load_g) for load_g in loads}
    for title, (goals, load_g) in measured.items():
        out = folder / title.replace(", ", "-").replace(" ", "")
        if not (out / "accuracy.json").exists():
            options = "--goals", goals, "--points", points, *(("--payload", load_g) if load_g else ())
            accuracy_of(policy, kind.arm(file), out, *options, python=kind.python)
        accuracy = json.loads((out / "accuracy.json").read_text("utf-8"))
        figures |= {f"{title}, {what}": accuracy[key] for what, key in FIGURES.items()}
        if load_g:
            figures[f"{title}, told [g]"] = accuracy["load_estimate_g"]
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


def accuracy_of(
    policy: Path, arm: str, out: Path, *options: Any, python: Path | str = sys.executable
) -> dict[str, Any]:
    """Measure a policy on an arm by `deploy measure`; return the figures, which stay in the new folder `out`.

    Raises:
        InputError: the command failed, or arrived at no goal.
    """
    file = out / "accuracy.json"
    asked = ("measure", policy, "--arm", arm, *options, "--out", out)
    run_command("mjx_softarm.deploy", *asked, makes=file, python=python)
    return json.loads(file.read_text("utf-8"))


def run_command(*words: Any, makes: Path, python: Path | str = sys.executable) -> int:
    """Run a command of this project, its output shown; return its exit status, one of `DONE`.

    Args:
        words: of the command line, after `python -m`.
        makes: file that the command writes. A command that ends with an exception has status 1, too.
        python: interpreter, whose environment may have other packages.

    Raises:
        InputError: the command ended with none of `DONE`, or without the file.
    """
    command = [str(word) for word in words]
    status = subprocess.run([str(python), "-m", *command], check=False).returncode
    asked = f"python -m {' '.join(command)}"
    if status not in DONE:
        raise InputError(f"{asked}: got exit status {status}, expected {' or '.join(map(str, DONE))}")
    if not makes.exists():
        raise InputError(f"{asked}: got no file {makes}, expected its results")
    return status
