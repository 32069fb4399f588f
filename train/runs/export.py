"""Command `python -m train export`: a run's newest policy as the file that the deployed arm loads.

The policy's file holds the actor and all that the arm's computer needs besides, such as networks that
estimate pose and payload. With `--weights` the command writes the actor alone, for other programs: a sealed
npz archive that any npz reader opens, with layers in float32 and other numbers in float64.

    actor.n_layers      () int
    actor.activation    ()           "relu" or "swish", after each layer but the last
    actor.<k>.weight    (in, out)    layer k = 0, 1, ...; the last one gives the actions before tanh
    actor.<k>.bias      (out,)
    obs_layout          (O,) text    names of the observation's entries, with their units
    obs_centre          (O,)
    obs_scale           (O,)         the actor reads (entry - centre) / scale; inf: it does not see the entry
    action_layout       (n,) text    names of the sensors' readings that the actions ask for
    action_centre       (n,)
    action_scale        (n,)         reading = centre + scale action
    provenance_json     ()           how the actor came about: config, versions, commit

What simulates is imported where it is needed, so that weights are written within seconds.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm._support import cli
from mjx_softarm._support.archive import Entries, layer_entries, write_sealed
from mjx_softarm._support.errors import InputError
from mjx_softarm.mdp.actions import N_ACTIONS, SHIFT_LIMIT, ActionMap
from mjx_softarm.mdp.observation import (
    Observation,
    ObsScale,
    layouts,
    observe_motion,
    observe_payload,
    rate_ticks,
)
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy.file import (
    Policy,
    action_layout,
    actor_layers,
    load_policy,
    policy_from_actor,
    save_policy,
)
from mjx_softarm.sensing.estimator import POSE_ERROR_MM
from mjx_softarm.spec import ArmSpec
from train.options import ArmOptions, start
from train.runs.folder import DEMONSTRATIONS_FILE, Run

if TYPE_CHECKING:
    from train.runs.arm_model import DistilledArm

WEIGHTS = "weights"  # kind of the file with the actor alone
# A policy needs no training while no error grows by more than this factor; chosen by hand.
ENOUGH = 1.3
# Figures that count: over the workspace median and 95 %, at demonstrated poses median and largest.
ERRORS = {"median": "median_mm", "95 %": "p95_mm", "largest": "max_mm"}
Runs = Annotated[
    tyro.conf.Positional[tuple[Path, ...]],
    tyro.conf.arg(metavar="RUN [RUN ...]", help="folders of runs", help_behavior_hint="(required)"),
]


def export(
    folders: Runs,
    out: cli.MaybePath = None,
    weights: cli.MaybePath = None,
    onnx: bool = False,
    cpp: cli.MaybePath = None,
    calibration: cli.MaybePath = None,
) -> int:
    """Write policies as npz files, and for other runtimes.

    Args:
        out: file to write, for one run; None: policy.npz in its folder
        weights: file for the actor alone, of one run, with centres and scales; no other file is written
        onnx: write ONNX graphs and golden rows beside it
        cpp: folder for a C++ header, programs and golden rows, for one run
        calibration: later calibration of the same arm, whose models the policies get without training; None
            for the file means policy-NAME.npz after this folder. Exit status 1 if a policy needs training
    """
    alone = out or cpp or weights
    if not folders or (alone and len(folders) > 1):
        expected = "one folder of a run" + ("" if alone else " or more")
        raise InputError(f"RUN: got {len(folders)}, expected {expected}")
    others = {"--out": out, "--onnx": onnx, "--cpp": cpp, "--calibration": calibration}
    if weights and (given := [name for name, value in others.items() if value]):
        raise InputError(f"--weights: got {' and '.join(given)} too, expected it alone")
    console = start()
    if not weights:
        n_enough = sum(_export(path, out, onnx, cpp, calibration, console) for path in folders)
        return 0 if n_enough == len(folders) else 1
    entries = actor_entries(Run.open(next(iter(folders))))
    write_sealed(weights, entries, WEIGHTS)
    layers = [entries[f"actor.{k}.weight"] for k in range(int(entries["actor.n_layers"]))]
    console.print(f"weights: {weights}, {_size(weights)}: actor {_widths(layers)}")
    return 0


def _export(
    path: Path, out: Path | None, onnx: bool, cpp: Path | None, calibration: Path | None, console: Console
) -> bool:
    """Write the policy of a run; return whether it needs no training on a later calibration."""
    from mjx_softarm.export.write import export_cpp, export_onnx
    from train.runs.arm_model import arm_model

    run, file, keeps, enough = Run.open(path), out, path, True
    actor_of(run)  # before the networks are distilled, which takes a minute
    # A later calibration takes the place of the run's
    if calibration:
        later = renewed(run, ArmOptions(calibration=calibration).read_arm(console))
        enough = policy_still_accurate(run, later, calibration, console)
        run, file, keeps = later, out or path / f"policy-{calibration.name}.npz", calibration
    # Distil the arm's networks, unless they are kept; write the policy and say what it holds
    arm = arm_model(run.arm, keeps, lambda step: console.print(f"{step} ..."))
    policy = export_run(run, arm, file)
    console.print(f"policy: {policy}, {_size(policy)}")
    for line in contents(load_policy(policy)):
        console.print(f"  {line}")
    for written in [*(export_onnx(policy) if onnx else []), *(export_cpp(policy, cpp) if cpp else [])]:
        console.print(f"  {written}")
    return enough


def renewed(run: Run, arm: CalibratedArm) -> Run:
    """Return a run with another calibration of its arm; raise InputError if it is another arm.

    Its actions stay readings of the same spring lengths: the range of lengths remains that of the training.
    """
    counts = [(spec.structure.n_sections, spec.n_chambers, spec.n_springs) for spec in (run.spec, arm.spec)]
    if counts[0] != counts[1]:
        expected, got = (f"{s} sections, {c} chambers and {n} springs" for s, c, n in counts)
        raise InputError(f"--calibration: got an arm of {got}, expected {expected}, as in {run.path}")
    limits = {name: getattr(run.spec.springs, name) for name in ("length_min_m", "length_max_m")}
    return Run(run.path, run.config, arm._replace(spec=arm.spec.replace(springs=limits)))


def policy_still_accurate(before: Run, now: Run, calibration: Path, console: Console) -> bool:
    """Evaluate a policy in simulation on both calibrations; print and return whether it needs no training.

    Goals are corrected by the whole error that an action leaves. The control loop does so for goals that
    stand, and tries less as well. So an error that the loop removes does not count, and a chamber at a limit
    counts by the error that it makes. Policies of motion are evaluated without correction. Errors are those
    of the tip's position; the models' own error counts with both calibrations.

    Measured once, not stored: policies of twins 0 to 2, each with the calibration of another twin,
    have medians of 0.1, 0.1, 3.6, 4.3, 9.2 and 13.2 mm with corrected goals, 17 to 42 mm without. On the
    circle of that twin they are 0.7, 0.7, 4.4, 5.7, 12.1 and 14.4 mm off.
    """
    from calib.changes import MIN_TIP_MM

    old, new = (_errors_mm(run) for run in (before, now))
    models_mm = max(MIN_TIP_MM, 0.0 if now.arm.s2r is None else float(now.arm.s2r.error_mm))
    for name, old_mm in old.items():
        console.print(
            f"tip error in simulation, {name}: {old_mm:.2f} mm on the arm of the training, "
            f"{new[name]:.2f} mm on the later one",
        )
    console.print(f"besides, simulation is about {models_mm:.2f} mm off the arm")
    if all(np.hypot(new[name], models_mm) <= ENOUGH * np.hypot(old[name], models_mm) for name in old):
        console.print("enough without training")
        return True
    # The command that goes on, with the preset that the run began with; further settings are the user's
    shown = before.config.learner.FROM_DEMONSTRATIONS
    task = f"imitate {before.path / DEMONSTRATIONS_FILE}" if shown else "reach"
    preset = before.origin()["preset"]
    options = f"--agent {before.path} --calibration {calibration}" + (f" --preset {preset}" if preset else "")
    console.print(f"NOT enough: go on training: python -m train {task} {options}")
    return False


def _errors_mm(run: Run) -> dict[str, float]:
    """Return errors of a policy in simulation, with corrected goals at rest."""
    from train.runs import run as runs

    evaluate = runs.task_of_run(run).evaluate
    if not run.config.env.in_motion:  # the loop corrects the last references of policies of motion instead
        evaluate = dataclasses.replace(evaluate, shift_limit=SHIFT_LIMIT)
    figures = evaluate(run.policy())[0].to_dict()
    return {name: figures[key] for name, key in ERRORS.items() if key in figures}


def export_run(run: Run, arm: DistilledArm, path: Path | None = None) -> Path:
    """Write the policy of a run's newest checkpoint; return the file, by default `policy.npz` in the run.

    `arm` is the model that `arm_model` makes of `run.arm`.

    Raises:
        InputError: the policy is not one that the file can hold, or the file cannot be written.
    """
    provenance = {
        **run.origin(),
        "epoch": run.checkpoints.latest,
        "estimator_errors": arm.errors,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    env = run.config.env
    try:
        policy = policy_from_actor(
            run.policy(),
            run.spec,
            env.reward,
            arm.model,
            provenance,
            activation=run.config.learner.activation,
            observation=env.observation,
            n_actions=N_ACTIONS,
            action_s=env.dynamic_step_s if env.in_motion else 0.0,
        )
    except ValueError as error:
        raise InputError(f"{run.path}: {error}") from error
    path = path or run.path / "policy.npz"
    save_policy(path, policy)
    return path


def actor_of(run: Run) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return weight and bias of each layer of a run's newest actor; raise InputError if it has no such."""
    try:
        return actor_layers(run.policy(), run.spec)
    except (ValueError, AttributeError) as error:
        raise InputError(f"{run.path}: {error}") from error


def actor_entries(run: Run) -> dict[str, np.ndarray]:
    """Return the entries of the file with a run's actor alone; the module lists them.

    Raises InputError for an actor of other sizes than observation and action, or that is not finite.
    """
    spec, env = run.spec, run.config.env
    layout, actions = layouts(spec)[env.observation], ActionMap.from_spec(spec)
    obs_centre, obs_scale = observation_scaling(spec, env.reward, env.observation)
    entries = layer_entries("actor", actor_of(run)) | {
        "actor.activation": run.config.learner.activation,
        "obs_layout": layout,
        "obs_centre": obs_centre,
        "obs_scale": obs_scale,
        "action_layout": action_layout(spec),
        "action_centre": (actions.high + actions.low) / 2,
        "action_scale": (actions.high - actions.low) / 2,
        "provenance_json": json.dumps({**run.origin(), "epoch": run.checkpoints.latest}),
    }
    arrays = {name: np.asarray(value) for name, value in entries.items()}
    Entries(arrays, str(run.path)).layers("actor", len(layout), spec.n_springs)
    return arrays


def observation_scaling(
    spec: ArmSpec, reward: RewardConfig, observation: Observation
) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and scale (O,) of an observation's entries, in the units that `layouts` names.

    Lengths are in m, rates of springs in m/s, velocities in mm/s, integrals in kPa. The actor reads
    (entry - centre) / scale, after angles are wrapped. The scale is inf where the actor does not see the
    entry: an axis that a goal does not ask for.
    """
    # Pose, goal, and their difference
    pose, asked = ObsScale.from_spec(spec), np.array(reward.asked)
    with np.errstate(divide="ignore"):
        error_scale = 1.0 / np.array(reward.weights)
    centres = [pose.centre, pose.centre, np.zeros(6)]
    scales = [pose.scale, np.where(asked, pose.scale, np.inf), error_scale]
    # More entries are linear: their values at 0 and at 1 give centre and scale.
    ends = [_more_entries(value, spec, observation) for value in (0.0, 1.0)]
    slope = ends[1] - ends[0]
    return np.concatenate([*centres, -ends[0] / slope]), np.concatenate([*scales, 1.0 / slope])


def _more_entries(value: float, spec: ArmSpec, observation: Observation) -> np.ndarray:
    """Return what an actor reads besides pose, goal and error where each of these entries has one value."""
    if observation == "pose":
        return np.zeros(0)
    if observation == "payload":
        return observe_payload(np.float64(value), spec)
    rate_hz = spec.control.rate_hz
    before = value * (1.0 - rate_ticks(rate_hz) / rate_hz)  # at a rate of this value
    springs, tip, chambers = np.ones(spec.n_springs), np.ones(3), np.ones(spec.n_chambers)
    moves = value * springs, before * springs, value * tip, before * tip
    return observe_motion(*moves, value * chambers, value * springs, spec)


def contents(policy: Policy) -> list[str]:
    """Return lines that say what a policy's file holds."""
    errors = policy.provenance.get("estimator_errors", {})
    medians = [
        f"{what} {next(iter(errors[name].values()))['median']:.2g} {unit}"  # without payload
        for what, name, unit in (
            ("tip", "tip_mm", "mm"),
            ("payload", "load_kg", "kg"),
            ("springs", "spring_mm", "mm"),
        )
        if name in errors
    ]
    observed = "pose and goal" + ("" if policy.observation == "pose" else f", {policy.observation}")
    correction = "none" if policy.s2r is None else f"left error about {float(policy.s2r.error_mm):.2g} mm"
    lines = [
        f"actor of {observed}: {_widths([weight for weight, _ in policy.layers])}, {policy.activation}",
        f"estimators of pose, payload and springs; median errors: {', '.join(medians) or 'not known'}",
    ]
    worst_mm = max((error["p95"] for error in errors.get("tip_mm", {}).values()), default=0.0)
    if worst_mm > POSE_ERROR_MM:
        lines.append(
            f"warning: 95 % of the estimated poses are within {worst_mm:.2g} mm of the simulation, expected "
            f"{POSE_ERROR_MM:g} mm; the arm may be about to buckle at its pressures' limits: narrow them"
        )
    return [
        *lines,
        f"correction of simulated poses: {correction}",
        f"{len(policy.workspace):,} poses of the workspace; the arm, its sensors and its control law",
    ]


def _widths(weights: list[np.ndarray]) -> str:
    """Return the widths of a network's layers, such as 18-256-256-9."""
    return "-".join(map(str, [len(weights[0]), *(weight.shape[1] for weight in weights)]))


def _size(path: Path) -> str:
    return f"{path.stat().st_size / 1e3:,.0f} kB"
