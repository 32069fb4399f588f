"""A run's policy on a later calibration of its arm, without training, and whether that is enough."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from rich.console import Console

from calib.arm import CalibratedArm
from calib.changes import MIN_TIP_MM
from mjx_softarm._support.errors import InputError
from mjx_softarm.mdp.actions import SHIFT_LIMIT
from train.runs import run as runs
from train.runs.folder import DEMONSTRATIONS_FILE, Run

# A policy needs no training while no error grows by more than this factor; chosen by hand.
ENOUGH = 1.3
# Figures that count: over the workspace median and 95 %, at demonstrated poses median and largest.
ERRORS = {"median": "median_mm", "95 %": "p95_mm", "largest": "max_mm"}


def renewed(run: Run, arm: CalibratedArm) -> Run:
    """Return a run with another calibration of its arm.

    Its actions stay readings of the same spring lengths: the range of lengths remains that of the training.

    Raises:
        InputError: it is another arm.
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

    Args:
        before: the run.
        now: the run with the later calibration.
        calibration: folder of this calibration.
        console: console to print to.
    """
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
    console.print(f"NOT enough: go on training: python -m train {task} {options}", soft_wrap=True)
    return False


def _errors_mm(run: Run) -> dict[str, float]:
    """Return errors of a policy in simulation, with corrected goals at rest."""
    evaluate = runs.task_of_run(run).evaluate
    if not run.config.env.in_motion:  # the loop corrects the last references of policies of motion instead
        evaluate = dataclasses.replace(evaluate, shift_limit=SHIFT_LIMIT)
    figures = evaluate(run.policy())[0].to_dict()
    return {name: figures[key] for name, key in ERRORS.items() if key in figures}
