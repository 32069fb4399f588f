"""What the experiments in confined spaces are made of: jobs, each of which leaves its result in a folder.

    twinT/demos-TASK.npz                recorded on the twin by the scripted expert, through `ArmIO` alone
    KIND-twinT-seedS/                   learned from them; see `KINDS`
    results/KIND-twinT-seedS-OBJECTS.npz   the policy on the twin, in its pipe, with things to pick and place

Calibrations and the policies that know no demonstrations are those of the open-space experiments, where both
are done in one folder. A job whose result is there is not done again.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.paper.confined_measure import Operated, load_operated, operate, save_operated
from benchmarks.paper.measure import Followed, load_followed
from benchmarks.paper.stages import (
    CALIBRATION,
    EVALUATION_FILE,
    POLICY_FILE,
    Case,
    Settings,
    command,
    policy_folder,
    result_file,
)
from mjx_softarm.mechanics.pipe import PIPES_MM


class Kind(NamedTuple):
    """A way to learn from demonstrations."""

    title: str
    task: str  # of `train.demos.waypoints.TASKS`, whose positions it learns
    preset: str  # of `python -m train imitate`
    settings: tuple[str, ...] = ()
    reward_of: str = ""  # kind whose learned reward it takes, and leaves as it is
    from_reach: bool = False  # begins with the policy that knows no demonstrations


KINDS = {
    "pipe": Kind("learned reward", "pipe300", "pipe"),
    "hand-made": Kind("hand-made reward", "pipe300", "hand-made"),
    "no-penalty": Kind("no gradient penalty", "pipe300", "pipe", ("gail.gradient_penalty=0",)),
    "narrow": Kind("hand-made, and learned in the wide pipe", "pipe250", "frozen", reward_of="pipe"),
    "circle": Kind("with demonstrations", "circle16", "circle", from_reach=True),
}
TASKS = ("pipe300", "pipe250", "circle16")
OBJECTS = ("as shown", "exchanged")
METRICS_FILE, CHECKPOINTS = "metrics.jsonl", "checkpoints"
TRIAL_SESSION = 2  # of the twins; demonstrations are recorded in their evaluation session, with other noise


class Trial(NamedTuple):
    """One run of a policy on a twin."""

    kind: str  # key of KINDS
    twin: int
    seed: int
    objects: str = "as shown"  # one of OBJECTS

    @property
    def name(self) -> str:
        return f"{self.kind}-twin{self.twin}-seed{self.seed}-{self.objects.replace(' ', '-')}"


class Learned(NamedTuple):
    """A training as it went."""

    rows: list[dict[str, Any]]  # of its metrics
    stage_ends: tuple[int, ...]  # epochs after which each stage but the last was over


class Results(NamedTuple):
    """All that was measured."""

    trials: dict[Trial, Operated]
    learned: dict[tuple[str, int, int], Learned]  # of kind, twin, seed
    circles: dict[Case, Followed]  # of the policies that know no demonstrations


def trainings(settings: Settings) -> list[tuple[str, int, int]]:
    """All (kind, twin, seed) to learn; without penalty on the first twin alone."""
    found = [(kind, t, s) for kind in KINDS for t in settings.twins for s in settings.seeds]
    return [item for item in found if item[0] != "no-penalty" or item[1] == settings.twins[0]]


def trials(settings: Settings) -> list[Trial]:
    """All runs on twins; what a policy without penalty does is told by its training."""
    found = []
    for kind, twin, seed in trainings(settings):
        if kind != "no-penalty":
            found.append(Trial(kind, twin, seed))
        if kind == "pipe":
            found.append(Trial(kind, twin, seed, "exchanged"))
    return found


def circles(settings: Settings) -> list[Case]:
    """Runs around the circle of the policies that know no demonstrations."""
    return [Case("with", twin, seed) for twin in settings.twins for seed in settings.seeds]


def pipe_mm(task: str) -> int | None:
    """Diameter of a task's pipe."""
    return PIPES_MM.get(task)


def demonstrations_file(folder: Path, twin: int, task: str) -> Path:
    """Where `demonstrate` leaves its file."""
    return folder / f"twin{twin}" / f"demos-{task}.npz"


def learned_folder(folder: Path, kind: str, twin: int, seed: int) -> Path:
    """Where a policy is learned from demonstrations."""
    return folder / f"{kind}-twin{twin}-seed{seed}"


def demonstrate(folder: Path, twin: int, task: str) -> None:
    """Record a task's demonstrations on a twin.

    Raises:
        JobError: the command failed.
    """
    file = demonstrations_file(folder, twin, task)
    if file.exists():
        return
    part = file.with_name(f"part-{file.name}")  # a recording that ends early leaves what it has
    part.unlink(missing_ok=True)
    arm = f"twin:{twin}" + (f":{task}" if pipe_mm(task) else "")
    options = ["--arm", arm, "--task", task, "--calibration", str(file.parent / CALIBRATION)]
    command(file.with_suffix(".log"), "demos", "record", *options, "--out", str(part))
    os.replace(part, file)


def learn(folder: Path, settings: Settings, kind: str, twin: int, seed: int) -> None:
    """Train a policy from demonstrations.

    Raises:
        JobError: a command failed.
    """
    run, of = learned_folder(folder, kind, twin, seed), KINDS[kind]
    log = run.with_suffix(".log")
    if not (run / EVALUATION_FILE).exists():
        saved = any(path.name.isdecimal() for path in (run / CHECKPOINTS).glob("*"))
        if saved and (run / "config.json").exists():  # which is written last
            command(log, "imitate", "--resume", str(run))
        else:
            shutil.rmtree(run, ignore_errors=True)  # maybe without the parts that it begins with
            options = ["--preset", of.preset, "--seed", str(seed), "--out", str(run)]
            options += ["--calibration", str(folder / f"twin{twin}" / CALIBRATION)]
            if diameter_mm := pipe_mm(of.task):
                options += ["--pipe", str(diameter_mm)]
            if of.reward_of:
                options += ["--reward", str(learned_folder(folder, of.reward_of, twin, seed))]
            if of.from_reach:
                options += ["--agent", str(policy_folder(folder, twin, seed))]
            for text in (*of.settings, *settings.imitation):
                options += ["--set", text]
            command(log, "imitate", str(demonstrations_file(folder, twin, of.task)), *options)


def export(folder: Path, settings: Settings, twin: int) -> None:
    """Export all policies of a twin at once: they share what is distilled for its arm.

    Raises:
        JobError: the command failed.
    """
    tried = {(trial.kind, trial.seed) for trial in trials(settings) if trial.twin == twin}
    runs = [learned_folder(folder, kind, twin, seed) for kind, seed in sorted(tried)]
    if new := [str(run) for run in runs if not (run / POLICY_FILE).exists()]:
        command(folder / f"export-twin{twin}.log", "export", *new)


class Scene(NamedTuple):
    """What a trial needs."""

    twin: Any
    controller: Any
    goals: Any  # (p, 6) [mm, deg]
    names: list[str]  # of the positions


def scene_of(folder: Path, settings: Settings, trial: Trial) -> Scene:
    """A trial's twin, in its pipe if it has one, its policy, and where it is to go."""
    from mjx_softarm.deploy.loop import Controller
    from mjx_softarm.mechanics.pipe import CrossPipe
    from mjx_softarm.mechanics.workspace import circle_poses
    from mjx_softarm.policy.file import load_policy
    from mjx_softarm.twin.arm import Twin
    from train.demos.demonstrations import load_demonstrations
    from train.demos.waypoints import task as task_of

    of = KINDS[trial.kind]
    policy = load_policy(learned_folder(folder, trial.kind, trial.twin, trial.seed) / POLICY_FILE)
    if diameter_mm := pipe_mm(of.task):
        demonstrations = load_demonstrations(demonstrations_file(folder, trial.twin, of.task), policy.spec)
        goals = demonstrations.positions[: settings.n_positions].astype(float)
        waypoints = task_of(of.task, policy.spec).waypoints
        names = [waypoint.name for waypoint in waypoints[: settings.n_positions]]
    else:
        goals, names = circle_poses(settings.n_points).astype(float), [""] * settings.n_points
    pipe = CrossPipe.of_mm(diameter_mm) if diameter_mm else None
    twin = Twin(trial.twin, session=TRIAL_SESSION, pipe=pipe)
    return Scene(twin, Controller.of(policy), goals, names)


def try_out(folder: Path, settings: Settings, trial: Trial) -> None:
    """Run a policy on its twin: pick and place in the pipe, or the whole circle."""
    path = trial_file(folder, trial)
    if path.exists():
        return
    path.parent.mkdir(exist_ok=True)
    save_operated(path, operate(*scene_of(folder, settings, trial), trial.objects))


def trial_file(folder: Path, trial: Trial) -> Path:
    """Where `try_out` leaves what it measured."""
    return folder / "results" / f"{trial.name}.npz"


def load_results(folder: Path, settings: Settings) -> Results:
    """What all trainings and trials gave."""
    return Results(
        trials={trial: load_operated(trial_file(folder, trial)) for trial in trials(settings)},
        learned={item: _load_learned(learned_folder(folder, *item)) for item in trainings(settings)},
        circles={case: load_followed(result_file(folder, case)) for case in circles(settings)},
    )


def _load_learned(run: Path) -> Learned:
    from train.config import ImitationConfig, from_dict

    config = from_dict(json.loads((run / "config.json").read_text("utf-8"))["train"])
    assert isinstance(config, ImitationConfig)  # as of all `trainings`
    lines = (run / METRICS_FILE).read_text("utf-8").splitlines()
    return Learned([json.loads(line) for line in lines], tuple(e for e in config.stage_epochs if e))
