"""Runs that lose a chamber: does the loop tell which, and how much of the workspace is left without it?"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np

from benchmarks.accuracy.path import means_over
from benchmarks.harness.common import arms_and_files, target
from mjx_softarm._support import cli
from mjx_softarm.deploy.accuracy.measure import measure as accuracy
from mjx_softarm.deploy.accuracy.measure import read_goals
from mjx_softarm.deploy.controller import LOOP, Controller
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.deploy.session import follow
from mjx_softarm.mdp.rewards import weighted_error
from mjx_softarm.policy.file import Policy, load_policy

REACHED = 0.6  # target: least share of the grid's goals that are reached without a chamber
_TOLD = re.compile(r"go on without (.+)$")
_SHARES = ("told rightly", "refused", "reached")


def measure(
    policies: tuple[str, ...], chambers: cli.Integers | None = None, points: int = 40
) -> dict[str, Any]:
    """How many goals does an arm reach that goes on without a burst chamber?

    Args:
        policies: ARM=FILE of each, such as twin:0=runs/mine/policy.npz
        chambers: chambers that have burst, one in each run; None: all, in turn
        points: of the grid at most

    Raises:
        InputError: there are no policies, or one cannot be measured.
    """
    rows = []
    for arm, file in arms_and_files(policies):
        policy = load_policy(file)
        for chamber in range(policy.spec.n_chambers) if chambers is None else chambers:
            rows.append({"arm": arm, "chamber": chamber, **_without(policy, arm, chamber, points)})
            print(rows[-1], flush=True)
    least = min(row["reached"] for row in rows)
    mean = float(np.mean([row["reached"] for row in rows]))
    told = sum(row["told rightly"] for row in rows)
    return {
        "targets": [
            target(f"goals reached without a chamber: {REACHED:.0%}, mean", f"{mean:.0%}", mean >= REACHED),
            target(f"the same, least of all runs: {REACHED:.0%}", f"{least:.0%}", least >= REACHED),
            target("lost chambers told rightly: all", f"{told} of {len(rows)}", told == len(rows)),
        ],
        "means": means_over(rows, ("arm",), _SHARES),
        "runs": rows,
    }


def _without(policy: Policy, arm: str, chamber: int, points: int) -> dict[str, Any]:
    """Return the figures of a run to the goals of the grid, on an arm whose chamber has burst."""
    controller = Controller.of(policy, config=dataclasses.replace(LOOP, go_on=True))
    goals, lines = read_goals("grid", policy, points), list[str]()
    run = follow(open_arm(f"{arm}:lost{chamber}"), controller, goals, tell=lines.append)
    told = [match[1] for line in lines if (match := _TOLD.search(line))]
    # Errors (p, 6) [mm, deg] by motion capture, NaN at goals that were refused, or left when the run ended
    error = accuracy(run, controller, goals).error
    arrived = np.isfinite(error[:, 0])
    reached = weighted_error(goals + error, goals, policy.reward) < policy.reward.threshold
    return {
        "told": ", ".join(told) or "none",
        "told rightly": told == [f"chamber{chamber}"],
        "goals": len(goals),
        "refused": run.counts().get(Fault.GOAL_OUTSIDE, 0) / len(goals),
        "reached": float(reached.mean()),
        "mean [mm]": float(np.linalg.norm(error[arrived, :3], axis=1).mean()) if arrived.any() else None,
        "ended by": run.ending.cause or "the last goal",
    }
