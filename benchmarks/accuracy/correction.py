"""The loop's correction of the goal, alone: policies on the circle with it and without it.

Policies learn at exact poses, and an arm gives estimated ones. So a second benchmark tells how much an error
of the observed pose changes the tip that a policy asks for.
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
N_ERRORS = 10  # at each goal
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
        rows.append({"policy": name, "arm": arm, **errors})
        print(rows[-1], flush=True)
    return {"means": means_over(rows, ("policy",), CASES), "policies": rows}


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


def pose_error(policies: tuple[str, ...], points: int = 40) -> dict[str, Any]:
    """How far off is the tip that a policy asks for because of an estimated pose, in place of the exact one?

    The arm is at its goal, without a payload; its pose is as the policy's models have it.

    Args:
        policies: NAME=ARM=FILE of each; arms are names alone
        points: of the circle

    Raises:
        InputError: there are no policies, or one has another form.
    """
    rows = []
    for name, arm, policy in chosen(policies):
        changes_mm = _changes_mm(policy, read_goals("circle", policy, points))
        mean_mm, most_mm = float(changes_mm.mean()), float(np.quantile(changes_mm, 0.95))
        rows.append({"policy": name, "arm": arm, "mean [mm]": mean_mm, "95 % [mm]": most_mm})
    return {"errors of the pose": f"{POSE_ERROR.tolist()} mm and deg, standard deviations", "policies": rows}


def _changes_mm(policy: Policy, goals: np.ndarray) -> np.ndarray:
    """Return changes (p, N_ERRORS) of the tip that a policy asks for, by errors at goals (p, 6) [mm, deg]."""
    runner, rng, none_kg = PolicyRunner(policy), np.random.default_rng(0), policy.spec.mass.payload_kg
    sensed = np.zeros(1, np.float32) if policy.observation == "payload" else None

    def asked_mm(pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
        return tip_pose(policy, runner.act(pose, goal, sensed).length_m, none_kg)[0][:3]

    errors = POSE_ERROR * rng.standard_normal((len(goals), N_ERRORS, 6))
    changes = [
        [np.linalg.norm(asked_mm(goal + error, goal) - asked_mm(goal, goal)) for error in own]
        for goal, own in zip(goals, errors, strict=True)
    ]
    return np.array(changes)
