"""Arms of several kinds: recorded and calibrated, trained, measured.

Each is a rod twin with seed 0, or one whose rod is SoRoMoX's. The commands are those of `docs/your-arm.md`.
Each arm is measured around a circle and at a grid of goals over its workspace. With `--loads` it follows the
circle with payloads, too, which the loop does not know. The same command goes on where it ended.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from benchmarks.harness.common import names_of, target
from benchmarks.harness.peers import peer_python
from benchmarks.harness.stages import EVALUATION_FILE, WorkStage, claim, command, run_stages, train
from mjx_softarm._support import cli
from mjx_softarm._support.fields import scaled
from mjx_softarm.spec import ArmSpec

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
    driver: str = ""  # for `--arm`; "": a rod twin
    peer: str = ""  # library of `benchmarks.harness.peers` in whose environment the driver runs


ARMS = {
    "paper": Kind("paper"),
    "sopra": Kind("sopra"),
    "stiff-flop": Kind("stiff-flop"),
    "four-chamber": Kind("four-chamber"),
    "upright": Kind("paper", STANDS, 0.1),
    "soromox": Kind("paper", driver="benchmarks.accuracy.soromox_arm:Arm", peer="soromox"),
}


class ArmSettings(NamedTuple):
    """Size of the measurement."""

    poses: int
    preset: str
    steps: int | None
    points: int
    loads: tuple[int, ...]

    @property
    def goals(self) -> dict[str, tuple[str, int]]:
        """Goals and payload [g] of each measurement, by its title."""
        loaded = {f"circle, {load_g} g": ("circle", load_g) for load_g in self.loads}
        return {"circle": ("circle", 0), "grid": ("grid", 0), **loaded}


def measure(
    arms: Annotated[tuple[str, ...], names_of(ARMS)] = tuple(name for name in ARMS if not ARMS[name].peer),
    poses: int = 300,
    preset: str = "analytic",
    steps: int | None = None,
    points: int = 40,
    loads: cli.Integers = (),
    keep: Path = Path("runs/arms"),
) -> dict[str, Any]:
    """How well do arms of several kinds follow goals, from recording to measurement, by the same commands?

    Args:
        arms: names of arms; all but soromox, which needs SoRoMoX's environment, unless given
        poses: random poses of each calibration
        preset: of each training
        steps: environment steps of each training; None: the preset's
        points: goals of the circle, and of the grid at most
        loads: payloads with which the circle is followed, too [g]
        keep: working folder: the same command continues, and arms may be added

    Raises:
        InputError: a command failed, the folder has other settings, or SoRoMoX could not be installed.
    """
    settings, out = ArmSettings(poses, preset, steps, points, loads), keep.absolute()
    claim(out, settings._asdict())
    made = {arm: tuple(str(accuracy_file(Path(arm), title)) for title in settings.goals) for arm in arms}
    run_stages(out, settings, [[WorkStage(arm, made[arm], take, (arm,)) for arm in arms]])
    figures = {arm: figures_of(out / arm, settings) for arm in arms}
    return {"targets": [_target(arm, row) for arm, row in figures.items()], **figures}


def take(out: Path, settings: ArmSettings, arm: str) -> None:
    """Take an arm through all commands, leaving out those whose results are there."""
    # The arm, and its stand-in
    kind, folder = ARMS[arm], out / arm
    file, calibration, run = folder / "arm.toml", folder / "calibration", folder / "run"
    spec = ArmSpec.of(Path(kind.name))
    masses = {part: scaled(getattr(spec.mass, part), kind.mass_share) for part in ("arm_kg", "gripper_kg")}
    folder.mkdir(parents=True, exist_ok=True)
    spec.replace(mass=masses, mounting={"base_turn_deg": kind.turn_deg}).to_toml(file)
    stand_in = "--arm", kind.driver or f"twin:rod:0@{file}"
    python = peer_python(kind.peer) if kind.peer else sys.executable

    def ensure(made: Path, *words: Any, python: Path | str = sys.executable) -> None:
        """Run a command unless what it makes exists."""
        if not made.exists():
            command(folder / "commands.log", *words, makes=made, python=python)

    # Record, calibrate, train and export
    log = folder / "poses.npz"
    record = ("mjx_softarm.deploy", "record", *stand_in, "--spec", file, "--poses", settings.poses)
    ensure(log, *record, "--out", log, python=python)
    ensure(calibration / "report.json", "calib", "run", log, "--spec", file, "--out", calibration)
    steps = ("--learner.total-env-steps", settings.steps) if settings.steps else ()
    if not (run / EVALUATION_FILE).exists():
        train(run, "reach", "--preset", settings.preset, "--calibration", calibration, *steps)
    ensure(run / "policy.npz", "train", "export", run)

    # Measure the policy on its arm
    asked = ("mjx_softarm.deploy", "measure", run / "policy.npz", *stand_in, "--points", settings.points)
    for title, (goals, load_g) in settings.goals.items():
        made = accuracy_file(folder, title)
        options = ("--goals", goals, *(("--payload", load_g) if load_g else ()), "--out", made.parent)
        ensure(made, *asked, *options, python=python)


def accuracy_file(folder: Path, title: str) -> Path:
    """Return the file of a measurement in the folder of an arm."""
    return folder / title.replace(", ", "-").replace(" ", "") / "accuracy.json"


def figures_of(folder: Path, settings: ArmSettings) -> dict[str, Any]:
    """Return the figures of an arm's measurements."""
    figures = {"length [mm]": 1e3 * ArmSpec.from_toml(folder / "arm.toml").length_m}
    for title, (_, load_g) in settings.goals.items():
        accuracy = json.loads(accuracy_file(folder, title).read_text("utf-8"))
        figures |= {f"{title}, {name}": accuracy[key] for name, key in FIGURES.items()}
        if load_g:
            figures[f"{title}, estimated [g]"] = accuracy["load_estimate_g"]
    return figures


def _target(arm: str, row: dict[str, Any]) -> dict[str, str]:
    length_mm = row["length [mm]"]
    share = row["circle, mean [mm]"] / length_mm
    n_refused = row["circle, goals"] - row["circle, measured"]
    return target(
        f"{arm}: circle within {WITHIN:.1%} of {length_mm:g} mm, no goal refused",
        f"{share:.2%} in the mean, {n_refused} of {row['circle, goals']} goals refused",
        share <= WITHIN and not n_refused,
    )
