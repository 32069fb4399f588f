"""The scene of a trial: its twin, in its pipe if it has one, its controller and its goals."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.paper.engine import Settings
from benchmarks.paper.kinds import KINDS, POLICY_FILE, Trial, reach_run, run_of
from mjx_softarm.mechanics.pipe import PIPES

CALIBRATION = "calibration"  # folder of a twin's calibration
# Session of a twin in trials of demonstrated tasks. Demonstrations are recorded in its evaluation session,
# with other noise.
TRIAL_SESSION = 2


class Scene(NamedTuple):
    """Inputs of a trial."""

    twin: Any
    controller: Any
    goals: np.ndarray  # (p, 6) [mm, deg]
    names: list[str]  # of the goals, such as "pick left"; "" on the circle


def demonstrations_path(twin: int, task: str) -> str:
    """Return the path of a twin's demonstrations of a task in the folder."""
    return f"twin{twin}/demos-{task}.npz"


def stand_in(settings: Settings) -> Any:
    """Return the class of the stand-ins for an arm."""
    from mjx_softarm.twin.arm import Twin
    from mjx_softarm.twin.rod_twin import RodTwin

    return RodTwin if settings.arm == "rod" else Twin


def scene_of(folder: Path, settings: Settings, trial: Trial) -> Scene:
    """Return the scene of a trial."""
    from mjx_softarm.mechanics.excitation import circle_poses
    from mjx_softarm.twin.instruments import EVALUATION_SESSION
    from train.demos.demonstrations import load_demonstrations
    from train.demos.waypoints import task as task_of

    controller, task = controller_of(folder, trial), KINDS[trial.kind].task
    # The goals: demonstrated positions of a pipe's task, or points of the circle.
    inside: dict[str, Any] = {}
    if task in PIPES:
        spec, inside = controller.policy.spec, {"pipe": PIPES[task]}
        demonstrations = load_demonstrations(folder / demonstrations_path(trial.twin, task), spec)
        goals = demonstrations.positions[: settings.n_positions].astype(float)
        names = [waypoint.name for waypoint in task_of(task, spec)[0][: settings.n_positions]]
    else:
        goals = circle_poses(controller.policy.spec, settings.n_points).astype(float)
        names = [""] * len(goals)
    # The twin, with its payload.
    session = TRIAL_SESSION if task else EVALUATION_SESSION
    twin = stand_in(settings)(trial.twin, payload_kg=1e-3 * trial.load_g, session=session, **inside)
    return Scene(twin, controller, goals, names)


def controller_of(folder: Path, trial: Trial) -> Any:
    """Return the controller of a trial's kind; all kinds run in the same loop."""
    from benchmarks.paper.gradient_descent import gradient_descent
    from mjx_softarm.deploy.controller import Controller
    from mjx_softarm.policy.file import load_policy
    from mjx_softarm.policy.runtime import PolicyRunner

    policy = load_policy(folder / run_of(trial) / POLICY_FILE)
    if trial.kind == "gradient":
        return Controller.of(policy, gradient_descent(policy))
    if trial.kind != "without":
        return Controller.of(policy)
    # With calibrated springs alone, the nominal arm's policy plans lengths, and the loop reads its sensors
    # as calibrated.
    nominal = load_policy(folder / reach_run(None, trial.seed) / POLICY_FILE)
    runner = PolicyRunner(nominal)
    calibrated_springs = dataclasses.replace(nominal, actions=nominal.actions._replace(sensor=policy.sensor))
    return Controller.of(
        calibrated_springs, lambda pose, goal, _, sensed: runner.act(pose, goal, sensed).length_m
    )
