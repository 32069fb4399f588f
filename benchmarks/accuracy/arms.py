"""Arms of several kinds: recorded and calibrated, trained, measured.

Each is a rod twin with seed 0, or one whose rod is SoRoMoX's. The commands are those of `docs/your-arm.md`.
Each arm is measured around a circle and at a grid of goals over its workspace. With `--loads` it follows the
circle with payloads, too, which the loop does not know. The same command goes on where it ended.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from benchmarks.harness.common import names_of, target
from benchmarks.harness.peers import peer_python
from benchmarks.harness.stages import WorkStage, claim, command, run_stages
from mjx_softarm._support import cli
from mjx_softarm._support.fields import scaled
from mjx_softarm._support.provenance import write_json
from mjx_softarm.spec import ArmSpec

N_MOVING = 8  # poses of a log of all ticks, to which the regulators are fitted
WITHIN = 0.005  # target: mean error on the circle, as a share of the arm's length

# Turns [deg] of the base. An arm that stands must do so without pressure, before it is calibrated: the arm of
# the paper, of 4.7 kg, falls over, a tenth of it stands.
HANGS, STANDS = (0.0, 0.0, 0.0), (180.0, 0.0, 0.0)
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


@dataclass(frozen=True)
class ArmSettings:
    """Size of the measurement."""

    poses: int
    preset: str
    steps: int | None
    points: int
    loads: tuple[int, ...]


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
        InputError: a command failed, or the folder has other settings.
        PeerError: SoRoMoX could not be installed.
    """
    settings, out = ArmSettings(poses, preset, steps, points, loads), keep.absolute()
    claim(out, settings)
    run_stages(out, settings, [[WorkStage(arm, (f"{arm}/figures.json",), take, (arm,)) for arm in arms]])
    figures = {arm: json.loads((out / arm / "figures.json").read_text("utf-8")) for arm in arms}
    return {"targets": [_target(arm, row) for arm, row in figures.items()], **figures}


def _target(arm: str, row: dict[str, Any]) -> dict[str, str]:
    length_mm = row["length [mm]"]
    share = row["circle, mean [mm]"] / length_mm
    n_refused = row["circle, goals"] - row["circle, measured"]
    return target(
        f"{arm}: circle within {WITHIN:.1%} of {length_mm:g} mm, no goal refused",
        f"{share:.2%} in the mean, {n_refused} of {row['circle, goals']} goals refused",
        share <= WITHIN and not n_refused,
    )


def take(out: Path, settings: ArmSettings, arm: str) -> None:
    """Take an arm through all commands, leaving out those whose results are there; write its figures."""
    # The arm, and its stand-in
    folder, kind = out / arm, ARMS[arm]
    folder.mkdir(parents=True, exist_ok=True)
    file, calibration, run = folder / "arm.toml", folder / "calibration", folder / "run"
    spec = ArmSpec.of(Path(kind.name))
    masses = {part: scaled(getattr(spec.mass, part), kind.mass_share) for part in ("arm_kg", "gripper_kg")}
    spec = spec.replace(mass=masses, mounting={"base_turn_deg": kind.turn_deg})
    spec.to_toml(file)
    stand_in = "--arm", kind.arm(file)
    logs = {folder / "poses.npz": (settings.poses,), folder / "moving.npz": (N_MOVING, "--transients")}

    def ensure(made: Path, *words: Any, on_arm: bool = False) -> None:
        """Run a command unless what it makes exists."""
        if not made.exists():
            python = kind.python if on_arm else sys.executable
            command(folder / "commands.log", *words, makes=made, python=python)

    # Record, calibrate, train and export
    record = ("mjx_softarm.deploy", "record", *stand_in, "--spec", file)
    for log, options in logs.items():
        ensure(log, *record, "--poses", *options, "--out", log, on_arm=True)
    ensure(calibration / "report.json", "calib", "run", *logs, "--spec", file, "--out", calibration)
    steps = ("--learner.total-env-steps", settings.steps) if settings.steps else ()
    begin = ("--preset", settings.preset, "--calibration", calibration, *steps, "--out", run)
    resumed = (run / "config.json").exists()
    ensure(run / "evaluation.json", "train", "reach", *(("--resume", run) if resumed else begin))
    policy = run / "policy.npz"
    ensure(policy, "train", "export", run)

    # Measure the policy on its arm
    figures = {"length [mm]": 1e3 * spec.length_m, **_calibration_figures(calibration)}
    measured = {"circle": ("circle", 0), "grid": ("grid", 0)}
    measured |= {f"circle, {load_g} g": ("circle", load_g) for load_g in settings.loads}
    for title, (goals, load_g) in measured.items():
        new = folder / title.replace(", ", "-").replace(" ", "")
        options = ("--goals", goals, "--points", settings.points, *(("--payload", load_g) if load_g else ()))
        asked = ("mjx_softarm.deploy", "measure", policy, *stand_in, *options, "--out", new)
        ensure(new / "accuracy.json", *asked, on_arm=True)
        accuracy = json.loads((new / "accuracy.json").read_text("utf-8"))
        figures |= {f"{title}, {what}": accuracy[key] for what, key in FIGURES.items()}
        if load_g:
            figures[f"{title}, estimated [g]"] = accuracy["load_estimate_g"]
    write_json(folder / "figures.json", figures)


def _calibration_figures(calibration: Path) -> dict[str, Any]:
    """Return figures of a calibration's report."""
    report = json.loads((calibration / "report.json").read_text("utf-8"))
    chambers, network = (report["parts"][title]["figures"] for title in ("Chambers", "Sim-to-real network"))
    return {
        "calibration without warnings": report["trustworthy"],
        "unknown directions": len(chambers["weak"]),
        "tip without S2R, held out [mm]": network["test_uncorrected"]["translation_mean_mm"],
        "tip with S2R, held out [mm]": network["test"]["translation_mean_mm"],
    }
