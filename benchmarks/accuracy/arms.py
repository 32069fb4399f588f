"""Arms of several kinds: recorded, calibrated, trained and measured by the commands of `docs/your-arm.md`.

With several numbers of poses a picture shows the errors over the minutes of recording.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness.common import RESULTS, Row, grouped, labels_once, names_of, target
from benchmarks.harness.peers import peer_python
from benchmarks.harness.stages import EVALUATION_FILE, WorkStage, claim, command, run_stages, train
from calib.read.logs import read_log
from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.fields import scaled
from mjx_softarm.spec import ArmSpec
from train.runs.plots import BLUE, DPI, GREY, INK, ORANGE, dress

WITHIN = 0.005  # target: mean error on the circle, as a share of the arm's length

# Turns [deg] of the base. An arm that stands must do so without pressure, before it is calibrated: the arm of
# the paper, of 4.7 kg, falls over, a tenth of it stands.
HANGS, STANDS = (0.0, 0.0, 0.0), (180.0, 0.0, 0.0)
FIGURES = {
    "goals": "points",
    "measured": "measured",
    "mean [mm]": "translation_mm",
    "largest [mm]": "max_mm",
    "mean [deg]": "rotation_deg",
    "saturated": "saturated_points",
}


class Kind(NamedTuple):
    """An arm that ships, and the stand-in for it."""

    name: str  # as for `--spec`
    turn_deg: tuple[float, float, float] = HANGS  # of its base
    mass_share: float = 1.0
    driver: str = "twin:rod:{seed}@{file}"  # for `--arm`
    peer: str = ""  # library of `benchmarks.harness.peers` in whose environment the driver runs


ARMS = {
    "paper": Kind("paper"),
    "sopra": Kind("sopra"),
    "stiff-flop": Kind("stiff-flop"),
    "four-chamber": Kind("four-chamber"),
    "upright": Kind("paper", STANDS, 0.1),
    "twin": Kind("paper", driver="twin:{seed}@{file}"),
    "soromox": Kind("paper", driver="benchmarks.accuracy.soromox_arm:Arm", peer="soromox"),
}

KINDS = tuple(name for name in ARMS if name not in ("twin", "soromox"))  # unless others are asked for
TITLES = {"twin": "twins", "paper": "rods, of other physics"}
GOALS = "circle", "grid"
RECORDING, ACCURACY = "poses.npz", "accuracy.json"


class Case(NamedTuple):
    """One arm with one recording."""

    arm: str  # name in ARMS
    seed: int  # of the stand-in
    poses: int  # number of random poses asked for

    @property
    def folder(self) -> str:
        return f"{self.arm}-{self.seed}-{self.poses}-poses"


class ArmSettings(NamedTuple):
    """Size of the measurement."""

    steps: int | None
    points: int
    goals: tuple[str, ...]


def measure(
    arms: Annotated[tuple[str, ...], names_of(ARMS)] = KINDS,
    seeds: cli.Integers = (0,),
    poses: cli.Integers = (300,),
    steps: int | None = None,
    points: int = 40,
    goals: Annotated[tuple[str, ...], names_of(GOALS)] = GOALS,
    keep: Path = Path("runs/arms"),
) -> dict[str, Any]:
    """How well do arms of several kinds follow goals, from recording to measurement, by the same commands?

    Args:
        arms: names of arms; twin and paper are stand-ins for the same one, of other physics; soromox needs
            SoRoMoX's environment
        seeds: of the stand-ins
        poses: random poses of each recording, which ends earlier where more bring nothing
        steps: environment steps of each training; None: the preset's
        points: goals of the circle, and of the grid at most
        goals: circle, or circle and grid
        keep: working folder: the same command continues, and arms, seeds and poses may be added
    """
    if "circle" not in goals:
        raise InputError(f"--goals: got {','.join(goals)}, expected circle among them")
    settings, out = ArmSettings(steps, points, goals), keep.absolute()
    claim(out, settings._asdict())
    cases = [Case(*case) for case in itertools.product(arms, seeds, poses)]
    stages = [
        WorkStage(tuple(f"{case.folder}/{name}/{ACCURACY}" for name in goals), take, (case,))
        for case in cases
    ]
    run_stages(out, settings, [stages])
    rows = [figures_of(out, settings, case) for case in cases]
    if len(poses) > 1:
        figure = minutes_figure(rows)
        figure.savefig(RESULTS / "arms-minutes.png", dpi=DPI)
    return {"targets": [_target(row) for row in rows], "arms": rows}


def take(out: Path, settings: ArmSettings, case: Case) -> None:
    """Take an arm through all commands, leaving out those whose results are there."""
    kind, folder = ARMS[case.arm], out / case.folder
    file, calibration, run = folder / "arm.toml", folder / "calibration", folder / "run"
    spec = ArmSpec.of(Path(kind.name))
    masses = {part: scaled(getattr(spec.mass, part), kind.mass_share) for part in ("arm_kg", "gripper_kg")}
    folder.mkdir(parents=True, exist_ok=True)
    spec.replace(mass=masses, mounting={"base_turn_deg": kind.turn_deg}).to_toml(file)
    stand_in = "--arm", kind.driver.format(seed=case.seed, file=file)
    python = peer_python(kind.peer) if kind.peer else sys.executable

    def ensure(made: Path, *words: Any, python: Path | str = sys.executable) -> None:
        """Run a command unless what it makes exists."""
        if not made.exists():
            command(folder / "commands.log", *words, makes=made, python=python)

    # Record, calibrate, train and export
    log = folder / RECORDING
    record = ("mjx_softarm.deploy", "record", *stand_in, "--spec", file, "--poses", case.poses)
    ensure(log, *record, "--out", log, python=python)
    ensure(calibration / "report.json", "calib", "run", log, "--spec", file, "--out", calibration)
    steps = ("--learner.total-env-steps", settings.steps) if settings.steps else ()
    if not (run / EVALUATION_FILE).exists():
        train(run, "reach", "--preset", "analytic", "--calibration", calibration, *steps)
    ensure(run / "policy.npz", "train", "export", run)

    # Measure the policy on its arm
    asked = ("mjx_softarm.deploy", "measure", run / "policy.npz", *stand_in, "--points", settings.points)
    for goals in settings.goals:
        options = ("--goals", goals, "--out", folder / goals)
        ensure(folder / goals / ACCURACY, *asked, *options, python=python)


def figures_of(out: Path, settings: ArmSettings, case: Case) -> dict[str, Any]:
    """Return the figures of an arm's recording and measurements."""
    folder = out / case.folder
    spec = ArmSpec.from_toml(folder / "arm.toml")
    time_s = read_log(folder / RECORDING, spec)[0].time_s
    figures: dict[str, Any] = {"arm": case.arm, "seed": case.seed, "poses": case.poses}
    figures |= {"recording [min]": float(np.ptp(time_s)) / 60, "length [mm]": 1e3 * spec.length_m}
    for goals in settings.goals:
        accuracy = json.loads((folder / goals / ACCURACY).read_text("utf-8"))
        figures |= {f"{goals}, {name}": accuracy[key] for name, key in FIGURES.items()}
    return figures


def minutes_figure(rows: Sequence[Row]) -> Figure:
    """Draw the mean error on the circle over the minutes of recording, a line for each stand-in."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    panel = figure.subplots()
    dress(panel, "circle, one line for each stand-in", "recording [min]", "tip error [mm]")
    colours = dict(zip(dict.fromkeys(row["arm"] for row in rows), (BLUE, ORANGE, INK, GREY), strict=False))
    for (arm, _), group in grouped(rows, ("arm", "seed")).items():
        line = [[row["recording [min]"], row["circle, mean [mm]"]] for row in group]
        x, y = np.array(sorted(line)).T
        panel.plot(x, y, "o-", color=colours[arm], markersize=4.0, label=TITLES.get(arm, arm))
    panel.set_xlim(left=0.0)
    panel.set_ylim(bottom=0.0)
    panel.legend(*labels_once(panel), frameon=False)
    return figure


def _target(row: Row) -> dict[str, str]:
    length_mm = row["length [mm]"]
    share = row["circle, mean [mm]"] / length_mm
    n_refused = row["circle, goals"] - row["circle, measured"]
    return target(
        f"{row['arm']} {row['seed']}, {row['poses']} poses: "
        f"circle within {WITHIN:.1%} of {length_mm:g} mm, no goal refused",
        f"{share:.2%} in the mean, {n_refused} of {row['circle, goals']} goals refused",
        share <= WITHIN and not n_refused,
    )
