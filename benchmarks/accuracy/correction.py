"""The loop's correction of the goal, alone: policies on the circle with it and without it."""

from __future__ import annotations

import dataclasses
from typing import Any

from benchmarks.accuracy.path import means_over
from benchmarks.harness.common import three_of
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.accuracy.measure import figures, read_goals
from mjx_softarm.deploy.accuracy.measure import measure as accuracy
from mjx_softarm.deploy.controller import LOOP, Controller
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.deploy.session import follow
from mjx_softarm.policy.file import load_policy

CASES = {"with [mm]": LOOP, "without [mm]": dataclasses.replace(LOOP, max_shift=(0.0, 0.0))}


def measure(policies: tuple[str, ...], points: int = 16) -> dict[str, Any]:
    """Which part of the accuracy is the policy's, and which is that of the loop's correction?

    Args:
        policies: NAME=ARM=FILE of each, such as analytic=twin:0=runs/mine/policy.npz; means are over a name
        points: of the circle

    Raises:
        InputError: there are no policies, one has another form, or a goal was not measured.
    """
    if not policies:
        raise InputError("--policies: got none, expected NAME=ARM=FILE of each")
    rows = []
    for text in policies:
        name, arm, file = three_of(text, "--policies", "NAME=ARM=FILE")
        policy = load_policy(file)
        goals, row = read_goals("circle", policy, points), {"policy": name, "arm": arm}
        for case, config in CASES.items():
            controller = Controller.of(policy, config=config)
            run = follow(open_arm(arm), controller, goals)
            found = figures(accuracy(run, controller, goals), run.counts(), policy.reward.asked)
            if found["measured"] < points:
                raise InputError(f"{text}: got {found['measured']} goals, expected {points}")
            row[case] = found["translation_mm"]
        print(row, flush=True)
        rows.append(row)
    return {"means": means_over(rows, ("policy",), CASES), "policies": rows}
