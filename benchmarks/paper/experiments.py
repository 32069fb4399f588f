"""Command `python -m benchmarks paper`: the stages of each experiment, in their order, and its report.

Its folder has, by stage:

    twinT/log.npz, twinT/calibration/       recorded and calibrated through `ArmIO` and logs alone
    twinT/demos-TASK.npz                    demonstrations of the scripted expert on the twin
    KIND-nominal-seedS/, KIND-twinT-seedS/  runs and policies; the nominal ones know no twin
    trials/TRIAL.json, TRIAL-log.npz        figures of a trial on a twin, and its log
    independence/KIND-seedS.json            errors with payloads, see `benchmarks.paper.independence`
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from benchmarks.harness.common import RESULTS, names_of, show, status_of
from benchmarks.harness.stages import EVALUATION_FILE, WorkStage, claim, command, run_stages, train
from benchmarks.paper import independence
from benchmarks.paper.gradient_descent import gradient_descent
from benchmarks.paper.pictures import film
from benchmarks.paper.report import write_report
from benchmarks.paper.trial import operate
from benchmarks.paper.trials import (
    BESIDE,
    CALIBRATION,
    EXPERIMENTS,
    KINDS,
    MORE,
    N_IN_TIME,
    PIPE_KINDS,
    POLICY_FILE,
    SMOKE,
    Settings,
    Trial,
    arm_name,
    demonstrations_path,
    run_path,
    trials,
)
from calib.read.logs import read_log
from calib.run import calibrate, write_calibration
from mjx_softarm._support import cli, xla
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import provenance, write_json
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.record import record
from mjx_softarm.logs.schema import write_log
from mjx_softarm.mechanics.drawing.render import RenderError
from mjx_softarm.mechanics.excitation import circle_poses, random_pressures
from mjx_softarm.mechanics.pipe import PIPES
from mjx_softarm.policy.file import load_policy
from mjx_softarm.policy.runtime import PolicyRunner
from mjx_softarm.spec import ARM_FILE, ArmSpec
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import EVALUATION_SESSION, S2R_SESSION
from mjx_softarm.twin.rod_twin import RodTwin
from train.demos.demonstrations import load_demonstrations
from train.demos.waypoints import task as task_of

STAND_INS = {"twin": Twin, "rod": RodTwin}
# Session of a twin in trials of demonstrated tasks. Demonstrations are recorded in its evaluation session,
# with other noise.
TRIAL_SESSION = 2
# File, kind and objects of the trial that is filmed.
FILMS = {
    "open": ("paper-circle.gif", "with", ""),
    "confined": ("paper-confined-pipe.gif", "pipe", "as shown"),
}


def paper(
    smoke: bool = False,
    only: Literal["open", "confined", "independence"] | None = None,
    twins: cli.Integers | None = None,
    seeds: cli.Integers | None = None,
    loads: cli.Integers | None = None,
    arm: Literal["twin", "rod"] = "twin",
    beside: Annotated[tuple[str, ...], names_of(BESIDE)] = (),
    out: cli.MaybePath = None,
) -> int:
    """How close does the paper's method come on simulated stand-ins for an arm? Takes hours.

    The exit status is 1 if a target is missed. The same command continues what is in the working folder;
    twins, seeds, loads and presets may be added.

    Args:
        smoke: run everything, but tiny; says nothing about the arm
        only: one experiment; None: all
        twins: which twins; None: 0,1,2
        seeds: of training; None: 0,1,2
        loads: payloads in open space [g]; None: 35,105,220,330,500,1000
        arm: twin, or a rod, of other physics, in open space alone
        beside: further presets in open space, beside analytic
        out: working folder; None: runs/paper
    """
    if only != "open" and arm == "rod":
        raise InputError(f"--only: got {only}, expected open with --arm rod")
    given = {"twins": twins, "seeds": seeds, "loads_g": loads}
    chosen = {name: value for name, value in given.items() if value is not None}
    size = SMOKE if smoke else Settings()
    settings = dataclasses.replace(size, arm=arm, beside=beside, **chosen)
    out = out or Path("runs/paper-smoke" if smoke else "runs/paper")
    claim(out, {name: value for name, value in dataclasses.asdict(settings).items() if name not in MORE})
    results, status = out if smoke else RESULTS, 0
    for experiment in [only] if only else EXPERIMENTS:
        run_stages(out, settings, stages(experiment, settings))
        figures = write_report(experiment, out, results, settings)
        show({name: figures[name] for name in ("spreads", "targets") if name in figures}, experiment)
        status |= status_of(figures)
        if experiment in FILMS and settings.arm == "twin":  # a rod cannot be drawn
            name, kind, objects = FILMS[experiment]
            trial = Trial(kind, settings.twins[0], settings.seeds[0], objects)
            try:
                film(results / name, scene_of(out, settings, trial), trial)
            except RenderError as error:
                print(f"no film: {error}")
    return 0 if smoke else status


def stages(experiment: str, settings: Settings) -> list[list[WorkStage]]:
    """Return the stages of an experiment, group by group."""
    if experiment == "independence":
        keys = itertools.product((*independence.POLICIES, independence.SOLVER), settings.seeds)
        return [[WorkStage((independence.result(*key),), independence.measure, key) for key in keys]]
    calibrated = [WorkStage((f"twin{t}/{CALIBRATION}",), calibrate_twin, (t,)) for t in settings.twins]
    learned = _open_stages(settings) if experiment == "open" else _confined_stages(settings)
    tried = [WorkStage((trial.result,), try_out, (trial,)) for trial in trials(experiment, settings)]
    return [calibrated, *learned, tried]


def _open_stages(settings: Settings) -> list[list[WorkStage]]:
    """Return the stages that train and export the policies of open space."""
    keys: list[tuple[str, int | None, int]] = [("specified", None, seed) for seed in settings.seeds]
    keys += [(kind, *run) for kind in ("with", *settings.beside) for run in settings.runs]
    keys += [("chambers", twin, settings.seeds[0]) for twin in settings.twins]
    return [[_learn(reach, *key) for key in keys], [_export(twin, keys) for twin in (None, *settings.twins)]]


def _confined_stages(settings: Settings) -> list[list[WorkStage]]:
    """Return the stages of the policies of pipes; one that takes another's reward is trained after it."""
    keys = [(kind, *run) for kind in PIPE_KINDS for run in settings.runs]
    tasks = dict.fromkeys((twin, KINDS[kind].task) for kind, twin, _ in keys)
    return [
        [WorkStage((demonstrations_path(*key),), demonstrate, key) for key in tasks],
        [_learn(imitate, *key) for key in keys if not KINDS[key[0]].reward_of],
        [_learn(imitate, *key) for key in keys if KINDS[key[0]].reward_of],
        [_export(twin, keys) for twin in settings.twins],
    ]


def _learn(job: Callable[..., None], kind: str, twin: int | None, seed: int) -> WorkStage:
    return WorkStage((f"{run_path(kind, twin, seed)}/{EVALUATION_FILE}",), job, (kind, twin, seed))


def _export(twin: int | None, keys: Iterable[tuple[str, int | None, int]]) -> WorkStage:
    policies = tuple(f"{run_path(*key)}/{POLICY_FILE}" for key in keys if key[1] == twin)
    return WorkStage(policies, export, (twin, policies))


def calibrate_twin(folder: Path, settings: Settings, twin: int) -> None:
    """Record a twin, and calibrate it by the log's file, as a user would."""
    home, spec = folder / arm_name(twin), ArmSpec.default()
    home.mkdir(parents=True, exist_ok=True)
    arm: Any = STAND_INS[settings.arm](twin, spec, session=S2R_SESSION)
    recording = record(arm, spec, random_pressures(spec, settings.n_poses, seed=twin))
    if cause := recording.ending.cause:
        raise InputError(f"log of twin {twin}: got a recording that ended early ({cause}), expected all")
    write_log(home / "log.npz", recording.log)
    log, findings = read_log(home / "log.npz", spec)
    xla.enable_compilation_cache()
    lines = [str(finding) for finding in findings]
    write_calibration(home / CALIBRATION, calibrate([log], spec), lines, provenance("benchmarks"))


def reach(folder: Path, settings: Settings, kind: str, twin: int | None, seed: int) -> None:
    """Train on the nominal arm, on a twin's calibration, or on this without its S2R network ("chambers")."""
    calibration = folder / arm_name(twin) / CALIBRATION
    arm = ("--spec", calibration / ARM_FILE) if kind == "chambers" else ("--calibration", calibration)
    changes = _options([*KINDS[kind].settings, *settings.reach])
    options = ("--preset", KINDS[kind].preset, *(arm if twin is not None else ()), "--seed", seed)
    train(folder / run_path(kind, twin, seed), "reach", *options, *changes)


def imitate(folder: Path, settings: Settings, name: str, twin: int, seed: int) -> None:
    """Train a policy from demonstrations."""
    kind = KINDS[name]
    calibration = folder / arm_name(twin) / CALIBRATION
    options = ["--preset", kind.preset, "--seed", seed, "--calibration", calibration]
    options += ["--pipe", f"{PIPES[kind.task].diameter_mm:g}"]
    if kind.reward_of:
        options += ["--reward", folder / run_path(kind.reward_of, twin, seed)]
    options += _options([*kind.settings, *settings.imitation])
    demonstrations = folder / demonstrations_path(twin, kind.task)
    train(folder / run_path(name, twin, seed), "imitate", demonstrations, *options)


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


def export(folder: Path, settings: Settings, twin: int | None, policies: tuple[str, ...]) -> None:
    """Export an arm's policies at once: they share the networks that are distilled for the arm."""
    pending = [folder / policy for policy in policies if not (folder / policy).exists()]
    log = folder / f"export-{arm_name(twin)}.log"
    command(log, "train", "export", *(policy.parent for policy in pending), makes=pending[-1])


def try_out(folder: Path, settings: Settings, trial: Trial) -> None:
    """Run a trial, and save its figures and, where it is drawn over time, its log."""
    figures, log = operate(*scene_of(folder, settings, trial), trial)
    (folder / trial.log).parent.mkdir(exist_ok=True)
    if trial.logged:
        write_log(folder / trial.log, log)
    write_json(folder / trial.result, {**trial._asdict(), "variant": trial.variant, **figures})


def scene_of(folder: Path, settings: Settings, trial: Trial) -> tuple[Any, Controller, np.ndarray, list[str]]:
    """Return a trial's twin, in its pipe if it has one, its controller, its goals (p, 6) and their names."""
    controller, task = controller_of(folder, trial), KINDS[trial.kind].task
    spec = controller.policy.spec
    inside: dict[str, Any] = {"session": EVALUATION_SESSION, "payload_kg": 1e-3 * trial.load_g}
    if task:
        inside |= {"session": TRIAL_SESSION, "pipe": PIPES[task]}
        demonstrations = load_demonstrations(folder / demonstrations_path(trial.twin, task), spec)
        goals = demonstrations.positions[: settings.n_positions].astype(float)
        names = [waypoint.name for waypoint in task_of(task, spec)[0][: settings.n_positions]]
    else:
        goals = circle_poses(spec, N_IN_TIME if trial.lap_s else settings.n_points).astype(float)
        names = [""] * len(goals)
    return STAND_INS[settings.arm](trial.twin, **inside), controller, goals, names


def controller_of(folder: Path, trial: Trial) -> Controller:
    """Return the controller of a trial's kind; all kinds run in the same loop."""
    policy = load_policy(folder / run_path(trial.kind, trial.twin, trial.seed) / POLICY_FILE)
    if trial.kind == "gradient":
        return Controller.of(policy, gradient_descent(policy))
    if trial.kind != "without":
        return Controller.of(policy)
    # The nominal arm's policy plans lengths; the loop reads its sensors as calibrated.
    nominal = load_policy(folder / run_path("specified", None, trial.seed) / POLICY_FILE)
    runner = PolicyRunner(nominal)
    calibrated_springs = dataclasses.replace(nominal, actions=nominal.actions._replace(sensor=policy.sensor))
    return Controller.of(
        calibrated_springs, lambda pose, goal, _, sensed: runner.act(pose, goal, sensed).length_m
    )
