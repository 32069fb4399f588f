"""What the paper's open-space experiments are made of: jobs, each of which leaves its result in a folder.

    twinT/log.npz, twinT/calibration/     logged and calibrated through `ArmIO` and logs alone
    nominal-seedS/, twinT-seedS/          trained, evaluated and exported; the nominal ones know no twin
    results/CASE.npz                      a policy once around the circle on a twin

A job whose result is there is not done again; training goes on where it stopped. A job runs in a process of
its own, so it imports what it needs by itself.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from benchmarks.harness.parallel import Job, JobError
from benchmarks.paper.measure import Followed, load_followed, measure, save_followed

METHODS = {"without": "without S2R", "with": "with S2R", "gradient": "gradient descent"}
LOG_FILE, CALIBRATION = "log.npz", "calibration"
POLICY_FILE, EVALUATION_FILE = "policy.npz", "evaluation.json"
SETTINGS_FILE = "settings.json"


@dataclass(frozen=True)
class Settings:
    """What is done, and how large."""

    twins: tuple[int, ...] = (0, 1, 2)
    seeds: tuple[int, ...] = (0, 1, 2)
    preset: str = "paper"
    training: tuple[str, ...] = ()  # further settings, NAME=VALUE
    imitation: tuple[str, ...] = ()  # likewise, of learning from demonstrations
    n_poses: int = 500
    n_points: int = 40  # of the circle
    n_positions: int | None = None  # of a pipe's task, from the first; None is all
    loads_g: tuple[int, ...] = (35, 105, 220, 330, 500, 1000)

    def fixed(self) -> dict:
        """All that a folder's results share; twins and seeds may be added later."""
        data = json.loads(json.dumps(dataclasses.asdict(self)))
        return {name: value for name, value in data.items() if name not in ("twins", "seeds")}


SMOKE = Settings(
    twins=(0,),
    seeds=(0,),
    preset="quick",
    training=("total_env_steps=512", "warmup_env_steps=256", "n_arms=16", "updates_per_env_step=0.25"),
    imitation=("total_env_steps=512", "warmup_env_steps=128", "n_arms=16", "updates_per_env_step=0.25"),
    n_poses=80,
    n_points=4,
    n_positions=7,  # up to where the first thing lies
    loads_g=(500,),
)


def claim(folder: Path, settings: Settings) -> None:
    """Make the folder, or see that it is of these settings; one it does not know yet is as by default.

    Raises:
        JobError: it is of others.
    """
    from mjx_softarm._support.provenance import write_json

    file, wanted = folder / SETTINGS_FILE, settings.fixed()
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_json(file, wanted)
    found = {**Settings().fixed(), **json.loads(file.read_text("utf-8"))}
    if found != wanted:
        differing = [name for name in wanted if found[name] != wanted[name]]
        got = ", ".join(f"{name} {found[name]}, now {wanted[name]}" for name in differing)
        raise JobError(f"{file}: was made with other settings ({got}); choose another --out")


def calibrations(folder: Path, settings: Settings) -> list[Job]:
    """A job for each twin: log and calibrate it."""
    return [(f"log and calibrate twin {t}", learn_twin, (folder, settings, t)) for t in settings.twins]


def reach_policies(folder: Path, settings: Settings) -> list[Job]:
    """A job for each policy of a calibrated twin; they come after `calibrations`."""
    return [
        (f"train for twin {t}, seed {s}", train_policy, (folder, settings, t, s))
        for t in settings.twins
        for s in settings.seeds
    ]


class Case(NamedTuple):
    """One experiment: a way to find references, on one twin, with one load, of one training seed."""

    method: str  # key of METHODS
    twin: int
    seed: int
    load_g: int = 0

    @property
    def name(self) -> str:
        return f"{self.method}-twin{self.twin}-seed{self.seed}-{self.load_g}g"


def cases(settings: Settings) -> list[Case]:
    """All experiments; gradient descent has no training seed, so it runs once for each twin."""
    found = []
    for twin in settings.twins:
        for seed in settings.seeds:
            found += [Case("without", twin, seed), Case("with", twin, seed)]
            found += [Case("with", twin, seed, load_g) for load_g in settings.loads_g]
        found.append(Case("gradient", twin, settings.seeds[0]))
    return found


def learn_twin(folder: Path, settings: Settings, twin: int) -> None:
    """Record a twin's log and calibrate it.

    Raises:
        JobError: the recording ended early.
    """
    from calib.read.logs import read_log
    from calib.run import calibrate, write_calibration
    from mjx_softarm._support import xla
    from mjx_softarm._support.provenance import provenance
    from mjx_softarm.spec import ArmSpec

    here, spec = folder / f"twin{twin}", ArmSpec.default()
    here.mkdir(parents=True, exist_ok=True)
    if (here / CALIBRATION).exists():
        return
    if not (here / LOG_FILE).exists():
        _record(here / LOG_FILE, spec, settings.n_poses, twin)
    log, findings = read_log(here / LOG_FILE, spec.n_chambers)
    xla.enable_compilation_cache()
    calibration = calibrate([log], spec)
    write_calibration(
        here / CALIBRATION, calibration, [str(finding) for finding in findings], provenance("benchmarks")
    )


def _record(path: Path, spec, n_poses: int, twin: int) -> None:
    from mjx_softarm.deploy.record import record
    from mjx_softarm.logs.schema import write_log
    from mjx_softarm.mechanics.excitation import random_pressures
    from mjx_softarm.twin.arm import S2R_SESSION, Twin

    recording = record(
        Twin(twin, spec, session=S2R_SESSION), spec, random_pressures(spec, n_poses, seed=twin)
    )
    if recording.problem:
        raise JobError(f"{path}: recording twin {twin} ended early: {recording.problem}")
    write_log(path, recording.log)


def train_policy(folder: Path, settings: Settings, twin: int | None, seed: int) -> None:
    """Train and export a policy of the nominal arm, or of a twin's calibration.

    Raises:
        JobError: a command failed.
    """
    run = policy_folder(folder, twin, seed)
    log = run.with_suffix(".log")
    if not (run / EVALUATION_FILE).exists():
        if (run / "config.json").exists():
            command(log, "reach", "--resume", str(run))
        else:
            arm = [] if twin is None else ["--calibration", str(folder / f"twin{twin}" / CALIBRATION)]
            more = [part for text in settings.training for part in ("--set", text)]
            options = ["--preset", settings.preset, "--seed", str(seed), "--out", str(run), *arm, *more]
            command(log, "reach", *options)
    if not (run / POLICY_FILE).exists():
        command(log, "export", str(run))


def policy_folder(folder: Path, twin: int | None, seed: int) -> Path:
    """Where a policy is trained."""
    return folder / f"{'nominal' if twin is None else f'twin{twin}'}-seed{seed}"


def command(log: Path, *arguments: str) -> None:
    """`python -m train ...`, its output appended to a file.

    Raises:
        JobError: it failed; the message has the last lines.
    """
    with log.open("a", encoding="utf-8") as file:
        done = subprocess.run(
            [sys.executable, "-m", "train", *arguments], stdout=file, stderr=subprocess.STDOUT, check=False
        )
    if done.returncode:
        last = "\n".join(log.read_text("utf-8").splitlines()[-5:])
        raise JobError(
            f"python -m train {' '.join(arguments)}: exit status {done.returncode}; {log} ends with\n{last}"
        )


def follow_circle(folder: Path, settings: Settings, case: Case) -> None:
    """Go around the circle on a twin in its evaluation session."""
    from mjx_softarm.deploy.session import follow
    from mjx_softarm.mechanics.workspace import circle_poses
    from mjx_softarm.twin.arm import EVALUATION_SESSION, Twin

    path = result_file(folder, case)
    if path.exists():
        return
    path.parent.mkdir(exist_ok=True)
    chosen, goals = controller(folder, case), circle_poses(settings.n_points).astype(float)
    arm = Twin(case.twin, payload_kg=1e-3 * case.load_g, session=EVALUATION_SESSION)
    save_followed(path, measure(follow(arm, chosen, goals), chosen, goals))


def controller(folder: Path, case: Case):
    """How a case finds its references, in the very same loop.

    Without S2R, the policy of the nominal arm plans spring lengths, and only the springs are calibrated.
    """
    from benchmarks.paper.gradient_descent import gradient_descent
    from mjx_softarm.deploy.loop import Controller
    from mjx_softarm.policy.file import load_policy
    from mjx_softarm.policy.runtime import PolicyRunner

    policy = load_policy(policy_folder(folder, case.twin, case.seed) / POLICY_FILE)
    if case.method == "with":
        return Controller.of(policy)
    if case.method == "gradient":
        return Controller.of(policy, gradient_descent(policy))
    nominal = load_policy(policy_folder(folder, None, case.seed) / POLICY_FILE)
    runner = PolicyRunner(nominal)
    calibrated_springs = dataclasses.replace(nominal, sensor=policy.sensor)
    return Controller.of(calibrated_springs, lambda pose, goal, _: runner.act(pose, goal).length_m)


def result_file(folder: Path, case: Case) -> Path:
    """Where `follow_circle` leaves what it measured."""
    return folder / "results" / f"{case.name}.npz"


def load_results(folder: Path, settings: Settings) -> dict[Case, Followed]:
    """What all experiments measured."""
    return {case: load_followed(result_file(folder, case)) for case in cases(settings)}
