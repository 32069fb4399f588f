"""Every simulation against every other: policies that learned in one of them, measured in all.

All arms have the numbers of the specification and the links of the run: simulations differ in their physics
alone. The twin is C MuJoCo with hysteresis and friction. The rod bends, shears and twists without joints. The
control loop does not correct the goal, so the errors are the policies' own.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from benchmarks.accuracy.correction import CASES
from benchmarks.harness.common import target
from mjx_softarm._support import xla
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.accuracy.measure import figures, read_goals
from mjx_softarm.deploy.accuracy.measure import measure as accuracy
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.session import follow
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.policy.file import load_policy
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import Build
from mjx_softarm.twin.rod_twin import RodTwin
from train.runs.evaluate import Evaluator
from train.runs.folder import Run
from train.runs.run import task_of_run

N_ACTIONS, ACTION_S = 12, 0.5  # of each goal, in motion
N_GOALS = 32  # held-out goals, beside the circle
WITHIN = 2.0  # target: error over that in the simulation that taught the policy
MOVING = {"mode": "dynamic", "dynamic_step_s": ACTION_S}
SIMULATIONS = {
    "chain at rest": {"mode": "quasistatic", "engine": "chain"},
    "own step in motion": MOVING | {"engine": "chain", "simulation_step_s": 0.02},
    "mjx.step in motion": MOVING | {"engine": "mjx", "simulation_step_s": 0.01},
}


def measure(runs: tuple[Path, ...], points: int = 12) -> dict[str, Any]:
    """How well do policies of each simulation do in all of them, on the circle?

    Args:
        runs: folders of exported runs on an arm without a calibration
        points: of the circle, on twin and rod

    Raises:
        InputError: there are no runs.
        RunError: a folder holds no finished run.
    """
    if not runs:
        raise InputError("--runs: got none, expected folders of exported runs")
    xla.enable_compilation_cache()
    rows = [_row(Run.open(folder), points) for folder in runs]
    return {"targets": [target_of(row) for row in rows], "circle, mean [mm]": rows}


def taught_in(config: EnvConfig) -> str:
    """Return the name of the simulation that taught a policy."""
    own = {"engine": config.engine, "mode": config.mode}
    return next(name for name, changes in SIMULATIONS.items() if changes.items() >= own.items())


def _row(run: Run, points: int) -> dict[str, Any]:
    task, policy, config = task_of_run(run), run.policy(), run.config.env
    row: dict[str, Any] = {"policy": run.path.name, "learned in": taught_in(config)}

    # Simulations of training; at rest there are no rates to observe
    for name, changes in SIMULATIONS.items():
        if config.observation == "motion" and changes["mode"] == "quasistatic":
            continue
        env = ReachEnv(run.spec, dataclasses.replace(config, **changes))
        found = Evaluator(env, task.job.learner, N_GOALS, N_ACTIONS)(policy)[0]
        row[name] = found.circle_mean_mm
        print(row, flush=True)

    # Stand-ins for an arm
    controller = Controller.of(load_policy(run.path / "policy.npz"), config=CASES["without [mm]"])
    own = controller.policy.spec
    links = own.structure.links_per_section
    goals = read_goals("circle", controller.policy, points)
    for name, arm in {
        "twin": Twin(0, own, build=Build(gap=0.0, per_section=links)),
        "rod": RodTwin(0, own, build=Build(gap=0.0)),
    }.items():
        result = follow(arm, controller, list(goals))
        row[name] = figures(accuracy(result, controller, goals), result.counts())["translation_mm"]
        print(row, flush=True)
    return row


def target_of(row: dict[str, Any]) -> dict[str, str]:
    """Return the target of a policy: its worst error in all simulations, over that in its own."""
    own = row[row["learned in"]]
    off = {name: mm / own for name, mm in row.items() if isinstance(mm, float)}
    worst = max(off, key=lambda name: off[name])
    return target(
        f"{row['policy']}: at most {WITHIN:g} times the error of {row['learned in']}",
        f"{off[worst]:.1f} times in {worst}",
        off[worst] <= WITHIN,
    )
