"""The stages' functions. Each runs in a process of its own, and imports its packages by itself."""

from __future__ import annotations

import dataclasses
import itertools
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness.stages import command, save_arrays
from benchmarks.paper.trials import (
    CALIBRATION,
    EVALUATION_FILE,
    KINDS,
    N_IN_TIME,
    POLICY_FILE,
    Settings,
    Trial,
    arm_name,
    demonstrations_path,
    run_path,
    s2r_path,
    traced,
)
from mjx_softarm._support.errors import InputError
from mjx_softarm.mechanics.pipe import PIPES
from mjx_softarm.spec import ARM_FILE

MOVING, N_MOVING = "moving.npz", 8  # log of a rod in motion, and its number of poses
# Session of a twin in trials of demonstrated tasks. Demonstrations are recorded in its evaluation session,
# with other noise.
TRIAL_SESSION = 2


def calibrate_twin(folder: Path, settings: Settings, twin: int) -> None:
    """Record a twin's logs, unless they exist, and calibrate the twin by them.

    A rod's regulators are slow; they are fitted to a second log, of all ticks between a few poses.

    Raises:
        InputError: the recording ended early.
    """
    from calib.read.logs import read_log
    from calib.run import calibrate, write_calibration
    from mjx_softarm._support import xla
    from mjx_softarm._support.provenance import provenance
    from mjx_softarm.deploy.record import record
    from mjx_softarm.logs.schema import write_log
    from mjx_softarm.mechanics.excitation import random_pressures
    from mjx_softarm.spec import ArmSpec
    from mjx_softarm.twin.instruments import S2R_SESSION

    home, spec = folder / arm_name(twin), ArmSpec.default()
    home.mkdir(parents=True, exist_ok=True)
    n_of_logs = _n_of_logs(settings)
    # Record random poses.
    for name, n in n_of_logs.items():
        if (home / name).exists():
            continue
        arm = _stand_in(settings)(twin, spec, session=S2R_SESSION)
        recording = record(arm, spec, random_pressures(spec, n, seed=twin))
        if cause := recording.ending.cause:
            raise InputError(f"log of {n} poses: got a recording that ended early ({cause}), expected all")
        write_log(home / name, recording.log)
    # Calibrate from the files, as a user would.
    logs, findings = zip(*(read_log(home / name, spec) for name in n_of_logs), strict=True)
    findings = [*itertools.chain(*findings)]
    xla.enable_compilation_cache()
    calibration = calibrate(logs, spec)
    write_calibration(home / CALIBRATION, calibration, [*map(str, findings)], provenance("benchmarks"))


def _n_of_logs(settings: Settings) -> dict[str, int]:
    """Return the names of an arm's logs with their numbers of poses."""
    return {"log.npz": settings.n_poses} | ({MOVING: N_MOVING} if settings.arm == "rod" else {})


def compare_s2r(folder: Path, settings: Settings, twin: int) -> None:
    """Write the errors of S2R as the paper prints it and of ours, at the same held-out poses of an arm."""
    from calib.arm import CalibratedArm
    from calib.read.logs import read_log
    from calib.read.measurements import measure
    from calib.steps import s2r_errors
    from mjx_softarm._support import xla
    from mjx_softarm._support.provenance import write_json

    xla.enable_compilation_cache()
    arm = CalibratedArm.read(folder / arm_name(twin) / CALIBRATION)
    logs = [read_log(folder / arm_name(twin) / name, arm.spec)[0] for name in _n_of_logs(settings)]
    errors = s2r_errors(measure(logs, arm.spec), arm)
    rows = {name: dataclasses.asdict(error) for name, error in errors.items()}
    write_json(folder / s2r_path(twin), rows)


def train(folder: Path, settings: Settings, kind: str, twin: int | None, seed: int) -> None:
    """Train a policy without demonstrations, or resume an interrupted run.

    It learns the nominal arm, a twin's calibration, or this without its S2R network (the kind "chambers").
    """
    run = folder / run_path(kind, twin, seed)
    log, made = run.with_suffix(".log"), run / EVALUATION_FILE
    if (run / "config.json").exists():
        command(log, "train", "reach", "--resume", run, makes=made)
        return
    arm: list[Any] = []
    if twin is not None:
        calibration = folder / arm_name(twin) / CALIBRATION
        whole = ["--calibration", calibration]
        arm = ["--spec", calibration / ARM_FILE] if kind == "chambers" else whole
    options = ["--preset", KINDS[kind].preset or "analytic", *arm, "--seed", seed, "--out", run]
    changes = _options([*KINDS[kind].settings, *settings.reach])
    command(log, "train", "reach", *options, *changes, makes=made)


def _options(settings: Iterable[str]) -> list[str]:
    """Return the options of further settings NAME=VALUE of a training; the last value of a name counts."""
    values = dict(text.split("=", 1) for text in settings)
    return [f"--{name}={value}" for name, value in values.items()]


def demonstrate(folder: Path, settings: Settings, twin: int, task: str) -> None:
    """Record a task's demonstrations on a twin."""
    file = folder / demonstrations_path(twin, task)
    part = file.with_name(f"part-{file.name}")  # a recording that ends early keeps its part
    part.unlink(missing_ok=True)
    options = ["--arm", f"twin:{twin}:{task}", "--task", task, "--calibration", file.parent / CALIBRATION]
    command(file.with_suffix(".log"), "train", "demos", "record", *options, "--out", part, makes=part)
    os.replace(part, file)


def imitate(folder: Path, settings: Settings, name: str, twin: int, seed: int) -> None:
    """Train a policy from demonstrations; resume an interrupted run."""
    run, kind = folder / run_path(name, twin, seed), KINDS[name]
    log, made = run.with_suffix(".log"), run / EVALUATION_FILE
    # Resume a run that has a checkpoint. Its config is written last: without one, the run starts anew,
    # since it may lack the reward that it begins with.
    saved = any(path.name.isdecimal() for path in (run / "checkpoints").glob("*"))
    if saved and (run / "config.json").exists():
        command(log, "train", "imitate", "--resume", run, makes=made)
        return
    shutil.rmtree(run, ignore_errors=True)
    # Start with the kind's options.
    options = ["--preset", kind.preset, "--seed", seed, "--out", run]
    options += ["--calibration", folder / arm_name(twin) / CALIBRATION]
    options += ["--pipe", f"{1e3 * PIPES[kind.task].diameter_m:g}"]
    if kind.reward_of:
        options += ["--reward", folder / run_path(kind.reward_of, twin, seed)]
    options += _options([*kind.settings, *settings.imitation])
    demonstrations = folder / demonstrations_path(twin, kind.task)
    command(log, "train", "imitate", demonstrations, *options, makes=made)


def export(folder: Path, settings: Settings, twin: int | None, runs: tuple[str, ...]) -> None:
    """Export an arm's policies at once: they share the networks that are distilled for the arm."""
    pending = [folder / run for run in runs if not (folder / run / POLICY_FILE).exists()]
    log = folder / f"export-{arm_name(twin)}.log"
    command(log, "train", "export", *pending, makes=pending[-1] / POLICY_FILE)


def try_out(folder: Path, settings: Settings, trial: Trial) -> None:
    """Run a trial, and save its outcome and, where it is drawn over time, its log."""
    from benchmarks.paper.trial import operate
    from mjx_softarm.logs.schema import write_log

    outcome, log = operate(*scene_of(folder, settings, trial), trial)
    if trial in traced(settings):
        (folder / trial.log).parent.mkdir(exist_ok=True)
        write_log(folder / trial.log, log)
    save_arrays(folder / trial.result, outcome)


class Scene(NamedTuple):
    """Inputs of a trial."""

    twin: Any
    controller: Any
    goals: np.ndarray  # (p, 6) [mm, deg]
    names: list[str]  # of the goals, such as "pick left"; "" on the circle


def scene_of(folder: Path, settings: Settings, trial: Trial) -> Scene:
    """Return the scene of a trial: its twin, in its pipe if it has one, its controller and its goals."""
    from mjx_softarm.mechanics.excitation import circle_poses
    from mjx_softarm.twin.instruments import EVALUATION_SESSION
    from train.demos.demonstrations import load_demonstrations
    from train.demos.waypoints import task as task_of

    controller, task = controller_of(folder, trial), KINDS[trial.kind].task
    spec = controller.policy.spec
    # The goals: demonstrated positions of a pipe's task, or points of the circle.
    inside: dict[str, Any] = {}
    if task:
        inside = {"pipe": PIPES[task]}
        demonstrations = load_demonstrations(folder / demonstrations_path(trial.twin, task), spec)
        goals = demonstrations.positions[: settings.n_positions].astype(float)
        names = [waypoint.name for waypoint in task_of(task, spec)[0][: settings.n_positions]]
    else:
        goals = circle_poses(spec, N_IN_TIME if trial.lap_s else settings.n_points).astype(float)
        names = [""] * len(goals)
    # The twin, with its payload.
    session = TRIAL_SESSION if task else EVALUATION_SESSION
    twin = _stand_in(settings)(trial.twin, payload_kg=1e-3 * trial.load_g, session=session, **inside)
    return Scene(twin, controller, goals, names)


def _stand_in(settings: Settings) -> Any:
    """Return the class of the stand-ins for an arm."""
    from mjx_softarm.twin.arm import Twin
    from mjx_softarm.twin.rod_twin import RodTwin

    return RodTwin if settings.arm == "rod" else Twin


def controller_of(folder: Path, trial: Trial) -> Any:
    """Return the controller of a trial's kind; all kinds run in the same loop."""
    from benchmarks.paper.gradient_descent import gradient_descent
    from mjx_softarm.deploy.controller import Controller
    from mjx_softarm.policy.file import load_policy
    from mjx_softarm.policy.runtime import PolicyRunner

    policy = load_policy(folder / run_path(trial.kind, trial.twin, trial.seed) / POLICY_FILE)
    if trial.kind == "gradient":
        return Controller.of(policy, gradient_descent(policy))
    if trial.kind != "without":
        return Controller.of(policy)
    # With calibrated springs alone, the nominal arm's policy plans lengths, and the loop reads its sensors
    # as calibrated.
    nominal = load_policy(folder / run_path("specified", None, trial.seed) / POLICY_FILE)
    runner = PolicyRunner(nominal)
    calibrated_springs = dataclasses.replace(nominal, actions=nominal.actions._replace(sensor=policy.sensor))
    return Controller.of(
        calibrated_springs, lambda pose, goal, _, sensed: runner.act(pose, goal, sensed).length_m
    )
