"""The loop's correction of the goal, alone: policies on the circle with it and without it.

Policies learn at exact poses, and an arm gives estimated ones. A third figure is what such an error of the
pose changes of the tip that a policy asks for.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.accuracy.path import means_over
from benchmarks.harness.common import three_of
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.accuracy.measure import figures, read_goals
from mjx_softarm.deploy.accuracy.measure import measure as accuracy
from mjx_softarm.deploy.controller import LOOP, Controller, LoopConfig
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.deploy.session import follow
from mjx_softarm.policy.file import Policy, load_policy
from mjx_softarm.policy.runtime import PolicyRunner, tip_pose

POSE_ERROR = np.array([0.25, 0.25, 0.25, 0.2, 0.2, 0.2])  # [mm, deg] of an estimated pose, with S2R
N_ERRORS, BY_POSE = 10, "by an error of the pose [mm]"
CASES = {"with [mm]": LOOP, "without [mm]": dataclasses.replace(LOOP, max_shift=(0.0, 0.0))}


def measure(policies: tuple[str, ...], points: int = 16) -> dict[str, Any]:
    """Which part of the accuracy is the policy's, and which is that of the loop's correction?

    Args:
        policies: NAME=ARM=FILE of each, such as analytic=twin:0=runs/mine/policy.npz; means are over a name
        points: of the circle

    Raises:
        InputError: there are no policies, one has another form, or a goal was not measured.
    """
    rows = []
    for name, arm, policy in chosen(policies):
        errors = {
            case: on_circle(policy, arm, points, loop)["translation_mm"] for case, loop in CASES.items()
        }
        by_pose = {BY_POSE: by_pose_error(policy, read_goals("circle", policy, points))}
        rows.append({"policy": name, "arm": arm, **errors, **by_pose})
        print(rows[-1], flush=True)
    return {"means": means_over(rows, ("policy",), (*CASES, BY_POSE)), "policies": rows}


def chosen(policies: Sequence[str]) -> list[tuple[str, str, Policy]]:
    """Return name, arm and policy of each text NAME=ARM=FILE.

    Raises:
        InputError: there are none, or one has another form.
    """
    if not policies:
        raise InputError("--policies: got none, expected NAME=ARM=FILE of each")
    told = (three_of(text, "--policies", "NAME=ARM=FILE") for text in policies)
    return [(name, arm, load_policy(file)) for name, arm, file in told]


def on_circle(policy: Policy, arm: str, points: int, loop: LoopConfig = LOOP) -> dict[str, Any]:
    """Return the figures of a policy on the circle, on an arm by its name.

    Raises:
        InputError: a goal was not measured.
    """
    goals, controller = read_goals("circle", policy, points), Controller.of(policy, config=loop)
    run = follow(open_arm(arm), controller, goals)
    found = figures(accuracy(run, controller, goals), run.counts(), policy.reward.asked)
    if found["measured"] < points:
        raise InputError(f"{arm}: got {found['measured']} goals, expected {points}")
    return found


def by_pose_error(policy: Policy, goals: np.ndarray) -> float:
    """Return the mean change [mm] of the tip that a policy asks for, by random errors of the observed pose.

    The arm is at its goal, one of goals (p, 6) [mm, deg], without a payload.
    """
    runner, rng, none_kg = PolicyRunner(policy), np.random.default_rng(0), policy.spec.mass.payload_kg
    sensed = np.zeros(1, np.float32) if policy.observation == "payload" else None

    def asked_mm(pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
        return tip_pose(policy, runner.act(pose, goal, sensed).length_m, none_kg)[0][:3]

    errors = POSE_ERROR * rng.standard_normal((len(goals), N_ERRORS, 6))
    changes = [
        np.linalg.norm(asked_mm(goal + error, goal) - asked_mm(goal, goal))
        for goal, own in zip(goals, errors, strict=True)
        for error in own
    ]
    return float(np.mean(changes))
