"""The loop's correction of the goal, alone: policies on the circle with it and without it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from benchmarks.accuracy.path import means_over
from benchmarks.harness.common import three_of
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.accuracy.measure import figures, read_goals
from mjx_softarm.deploy.accuracy.measure import measure as accuracy
from mjx_softarm.deploy.controller import LOOP, Controller, LoopConfig
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.deploy.session import follow
from mjx_softarm.policy.file import Policy, load_policy

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
