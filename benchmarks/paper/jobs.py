"""The stages' functions; one raises a `JobError` if a command or a recording fails.

Each runs in a process of its own, so it imports what it needs by itself.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness.parallel import JobError
from benchmarks.paper.engine import Settings, command, save_arrays
from benchmarks.paper.kinds import (
    KINDS,
    POLICY_FILE,
    Trial,
    arm_name,
    learned_run,
    reach_run,
    run_of,
)
from benchmarks.paper.measure import operate
from mjx_softarm.mechanics.pipe import PIPES_MM
from mjx_softarm.spec import ARM_FILE

CALIBRATION, COMPARISON_FILE = "calibration", "comparison.npz"
ALIKE = {
    "analytic",
    "payload",
}  # presets that differ in the payload alone, as do their runs
N_COMPARED = 40  # poses that a calibrated twin is compared at
COMPARED_SEED = 1000  # and up: other poses than the logs', whose seeds are the twins'
# Session of a twin in trials of demonstrated tasks; demonstrations are recorded in its evaluation session,
# with other noise.
TRIAL_SESSION = 2


def demonstrations_path(twin: int, task: str) -> str:
    """Return where a twin's demonstrations of a task are in the folder."""
    return f"twin{twin}/demos-{task}.npz"


def stand_in(settings: Settings) -> Any:
    """Return the class of the stand-ins for an arm."""
    from mjx_softarm.twin.arm import Twin
    from mjx_softarm.twin.rod_twin import RodTwin

    return RodTwin if settings.arm == "rod" else Twin


def calibrate_twin(folder: Path, settings: Settings, twin: int) -> None:
    """Record a twin's log, unless it exists, and calibrate the twin by it."""
    from calib.read.logs import read_log
    from calib.run import calibrate, write_calibration
    from mjx_softarm._support import xla
    from mjx_softarm._support.provenance import provenance
    from mjx_softarm.logs.schema import write_log
    from mjx_softarm.spec import ArmSpec
    from mjx_softarm.twin.instruments import S2R_SESSION

    here, spec = folder / f"twin{twin}", ArmSpec.default()
    here.mkdir(parents=True, exist_ok=True)
    file = here / "log.npz"
    if not file.exists():
        arm = stand_in(settings)(twin, spec, session=S2R_SESSION)
        write_log(file, _recorded(arm, settings.n_poses, twin))
    log, findings = read_log(file, spec.n_chambers)
    xla.enable_compilation_cache()
    calibration = calibrate([log], spec)
    write_calibration(here / CALIBRATION, calibration, [*map(str, findings)], provenance("benchmarks"))


def _recorded(arm: Any, n_poses: int, seed: int) -> Any:
    """Return the log of random poses of a stand-in.

    Raises:
        JobError: the recording ended early.
    """
    from mjx_softarm.deploy.record import record
    from mjx_softarm.mechanics.excitation import random_pressures
    from mjx_softarm.spec import ArmSpec

    spec = ArmSpec.default()
    recording = record(arm, spec, random_pressures(spec, n_poses, seed=seed))
    if cause := recording.ending.cause:
        raise JobError(f"log of {n_poses} poses: got a recording that ended early ({cause}), expected all")
    return recording.log


def compare_twin(folder: Path, settings: Settings, twin: int) -> None:
    """Compare a twin with its simulation, as specified and as calibrated, at poses of another session."""
    from benchmarks.paper.comparison import compare
    from mjx_softarm._support import xla
    from mjx_softarm.sensing.s2r import S2R_FILE, load_s2r
    from mjx_softarm.spec import ArmSpec
    from mjx_softarm.twin.instruments import EVALUATION_SESSION

    here = folder / f"twin{twin}"
    specified, calibrated = ArmSpec.default(), ArmSpec.from_toml(here / CALIBRATION / ARM_FILE)
    network = here / CALIBRATION / S2R_FILE  # absent where it would not help
    s2r = load_s2r(network, calibrated.n_chambers) if network.exists() else None
    arm = stand_in(settings)(twin, specified, session=EVALUATION_SESSION)
    xla.enable_compilation_cache()
    log = _recorded(arm, N_COMPARED, COMPARED_SEED + twin)
    save_arrays(here / COMPARISON_FILE, compare(log, specified, calibrated, s2r))


def train_reach(folder: Path, settings: Settings, twin: int | None, seed: int) -> None:
    """Train a policy of the nominal arm or of a twin's calibration."""
    arm = [] if twin is None else ["--calibration", folder / f"twin{twin}" / CALIBRATION]
    _reach(folder / reach_run(twin, seed), seed, *_chosen(settings), *arm)


def train_other(folder: Path, settings: Settings, name: str, twin: int, seed: int) -> None:
    """Train a policy of another preset, or of a twin's calibration without its S2R network."""
    calibration, preset = folder / f"twin{twin}" / CALIBRATION, KINDS[name].reach
    if preset:
        options = ["--preset", preset, "--calibration", calibration]
        if {preset, settings.preset} == ALIKE or preset == settings.preset:
            options += _further(settings)
    else:
        options = [*_chosen(settings), "--spec", calibration / ARM_FILE]
    _reach(folder / learned_run(name, twin, seed), seed, *options)


def _chosen(settings: Settings) -> list[str]:
    """Return the options of the experiment's own policies."""
    return ["--preset", settings.preset, *_further(settings)]


def _further(settings: Settings) -> list[str]:
    """Return the options of their further settings."""
    return [f"--{text}" for text in settings.training]


def _reach(run: Path, seed: int, *options: Any) -> None:
    """Train a policy with these options, or resume an interrupted run."""
    log = run.with_suffix(".log")
    if (run / "config.json").exists():
        command(log, "reach", "--resume", str(run))
    else:
        command(log, "reach", *map(str, options), "--seed", str(seed), "--out", str(run))


def demonstrate(folder: Path, settings: Settings, twin: int, task: str) -> None:
    """Record a task's demonstrations on a twin."""
    file = folder / demonstrations_path(twin, task)
    part = file.with_name(f"part-{file.name}")  # a recording that ends early keeps what it has
    part.unlink(missing_ok=True)
    arm = f"twin:{twin}:{task}" if task in PIPES_MM else f"twin:{twin}"
    options = ["--arm", arm, "--task", task, "--calibration", str(file.parent / CALIBRATION)]
    command(file.with_suffix(".log"), "demos", "record", *options, "--out", str(part))
    os.replace(part, file)


def learn(folder: Path, settings: Settings, name: str, twin: int, seed: int) -> None:
    """Train a policy from demonstrations; resume what was interrupted."""
    run, kind = folder / learned_run(name, twin, seed), KINDS[name]
    log = run.with_suffix(".log")
    saved = any(path.name.isdecimal() for path in (run / "checkpoints").glob("*"))
    if saved and (run / "config.json").exists():  # written last
        command(log, "imitate", "--resume", str(run))
        return
    shutil.rmtree(run, ignore_errors=True)  # it may lack what it begins with
    options = ["--preset", kind.preset, "--seed", str(seed), "--out", str(run)]
    options += ["--calibration", str(folder / f"twin{twin}" / CALIBRATION)]
    if diameter_mm := PIPES_MM.get(kind.task):
        options += ["--pipe", str(diameter_mm)]
    if kind.reward_of:
        options += ["--reward", str(folder / learned_run(kind.reward_of, twin, seed))]
    if kind.begins_with:
        options += ["--agent", str(folder / learned_run(kind.begins_with, twin, seed))]
    options += [f"--{text}" for text in (*kind.settings, *settings.imitation)]
    command(log, "imitate", str(folder / demonstrations_path(twin, kind.task)), *options)


def export(folder: Path, settings: Settings, twin: int | None, runs: tuple[str, ...]) -> None:
    """Export an arm's policies at once: they share what is distilled for it."""
    pending = [str(folder / run) for run in runs if not (folder / run / POLICY_FILE).exists()]
    command(folder / f"export-{arm_name(twin)}.log", "export", *pending)


class Scene(NamedTuple):
    """Inputs of a trial."""

    twin: Any
    controller: Any
    goals: np.ndarray  # (p, 6) [mm, deg]
    names: list[str]  # of the goals, such as "pick left"; "" on the circle


def scene_of(folder: Path, settings: Settings, trial: Trial) -> Scene:
    """Return a trial's twin, in its pipe if it has one, its controller and its goals."""
    from mjx_softarm.mechanics.excitation import circle_poses
    from mjx_softarm.mechanics.pipe import CrossPipe
    from mjx_softarm.twin.instruments import EVALUATION_SESSION
    from train.demos.demonstrations import load_demonstrations
    from train.demos.waypoints import task as task_of

    controller, task = controller_of(folder, trial), KINDS[trial.kind].task
    inside: dict[str, Any] = {}
    if task in PIPES_MM:
        spec, inside = controller.policy.spec, {"pipe": CrossPipe.of_mm(PIPES_MM[task])}
        demonstrations = load_demonstrations(folder / demonstrations_path(trial.twin, task), spec)
        goals = demonstrations.positions[: settings.n_positions].astype(float)
        names = [waypoint.name for waypoint in task_of(task, spec).waypoints[: settings.n_positions]]
    else:
        goals = circle_poses(controller.policy.spec, settings.n_points).astype(float)
        names = [""] * len(goals)
    session = TRIAL_SESSION if task else EVALUATION_SESSION
    twin = stand_in(settings)(trial.twin, payload_kg=1e-3 * trial.load_g, session=session, **inside)
    return Scene(twin, controller, goals, names)


def controller_of(folder: Path, trial: Trial) -> Any:
    """Return a trial's controller: its way to find references, in the same loop.

    With calibrated springs alone, the policy of the nominal arm plans spring lengths; as specified, not even
    the springs are calibrated.
    """
    from benchmarks.paper.gradient_descent import gradient_descent
    from mjx_softarm.deploy.controller import Controller
    from mjx_softarm.policy.file import load_policy
    from mjx_softarm.policy.runtime import PolicyRunner

    policy = load_policy(folder / run_of(trial) / POLICY_FILE)
    if trial.kind == "gradient":
        return Controller.of(policy, gradient_descent(policy))
    if trial.kind != "without":
        return Controller.of(policy)
    nominal = load_policy(folder / reach_run(None, trial.seed) / POLICY_FILE)
    runner = PolicyRunner(nominal)
    calibrated_springs = dataclasses.replace(nominal, actions=nominal.actions._replace(sensor=policy.sensor))
    return Controller.of(
        calibrated_springs, lambda pose, goal, _, sensed: runner.act(pose, goal, sensed).length_m
    )


def try_out(folder: Path, settings: Settings, trial: Trial) -> None:
    """Run a trial and save its outcome."""
    path = folder / trial.result
    path.parent.mkdir(exist_ok=True)
    save_arrays(path, operate(*scene_of(folder, settings, trial), trial.objects, trial.moves))


def film(folder: Path, settings: Settings, trials: tuple[Trial, ...], file: str) -> str:
    """Film a trial, or several side by side; returns why they cannot be drawn, or ""."""
    from benchmarks.paper.film import film_scene, film_side_by_side
    from mjx_softarm.mechanics.render import RenderError

    scenes = [(scene_of(folder, settings, trial), trial) for trial in trials]
    try:
        if len(scenes) == 1:
            film_scene(folder / file, *scenes[0])
        else:
            film_side_by_side(folder / file, scenes)
    except RenderError as error:
        return str(error)
    return ""
