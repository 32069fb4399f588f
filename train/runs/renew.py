"""A run's policy on a later calibration of its arm, without training, and whether that is enough."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm.deploy.controller import LOOP
from train.agent.registry import LEARNERS, name_of
from train.runs import run as runs
from train.runs.checkpoint import RunError
from train.runs.evaluate import UNCORRECTED
from train.runs.folder import DEMONSTRATIONS_FILE, Run

# A policy needs no training while neither error that is expected on its arm grows by more than this; by hand.
ENOUGH = 1.3
# Errors in simulation; the second is that over the workspace, the third that at demonstrated poses.
ERRORS = {"median": "median_mm", "95 %": "p95_mm", "largest": "max_mm"}


def renewed(run: Run, arm: CalibratedArm) -> Run:
    """Return a run with another calibration of its arm.

    Its actions stay readings of the same spring lengths: the range of lengths remains that of the training.

    Raises:
        RunError: it is another arm.
    """
    counts = [(spec.structure.n_sections, spec.n_chambers, spec.n_springs) for spec in (run.spec, arm.spec)]
    if counts[0] != counts[1]:
        expected, got = (f"{s} sections, {c} chambers and {n} springs" for s, c, n in counts)
        raise RunError(f"--calibration: got an arm of {got}, expected {expected}, as in {run.path}")
    limits = {name: getattr(run.spec.springs, name) for name in ("length_min_m", "length_max_m")}
    return Run(run.path, run.config, arm._replace(spec=arm.spec.replace(springs=limits)))


def told_enough(before: Run, now: Run, calibration: Path, console: Console) -> bool:
    """Evaluate a policy in simulation on both calibrations; tell and return whether it needs no training.

    Goals are corrected as by the control loop: an error of the policy that the loop removes matters little.
    On the arm, the error of the sim-to-real network adds to that in simulation. Chambers at a limit count by
    the error that they make. Policies of twins 0 to 2, each with the calibration of another twin, are expected
    to be 0.6, 0.6, 3.7, 4.3, 9.2 and 13.2 mm off in the median. On the circle of that twin they are 0.7, 0.7,
    4.4, 5.7, 12.1 and 14.4 mm off. Without the correction, simulation says 17 to 42 mm.

    Args:
        before: the run.
        now: the run with the later calibration.
        calibration: folder of this calibration.
        console: console to print to.
    """
    old, new = (_expected(run) for run in (before, now))
    for name, old_mm in old.items():
        console.print(
            f"error of the tip that is expected, {name}: {old_mm:.2f} mm on the arm of the training, "
            f"{new[name]:.2f} mm on the later one",
            highlight=False,
        )
    if all(new[name] <= ENOUGH * old_mm for name, old_mm in old.items()):
        console.print("enough without training")
        return True
    # The command that goes on, with the settings that the run began with
    learns_from_poses = LEARNERS[name_of(before.config.learner)].from_demonstrations
    task = f"imitate {before.path / DEMONSTRATIONS_FILE}" if learns_from_poses else "reach"
    preset = before.origin()["preset"]
    options = f"--agent {before.path} --calibration {calibration}" + (f" --preset {preset}" if preset else "")
    console.print(
        f"NOT enough: go on training: python -m train {task} {options}", highlight=False, soft_wrap=True
    )
    return False


def _expected(run: Run) -> dict[str, float]:
    """Return errors [mm] that are expected of a policy on its arm, with corrected goals."""
    evaluate, moves = runs.task_of_run(run).evaluate, run.config.env.moves
    # The loop corrects the last references of policies of motion instead
    limit = UNCORRECTED if moves else LOOP.shift_limit
    figures = evaluate.on(evaluate.env, shift_limit=limit)(run.policy())[0].to_dict()
    s2r_mm = 0.0 if run.arm.s2r is None else float(run.arm.s2r.error_mm)
    return {name: float(np.hypot(figures[key], s2r_mm)) for name, key in ERRORS.items() if key in figures}
