"""A run's policy on a later calibration of its arm, without training, and whether that is enough."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console

from calib.arm import CalibratedArm
from train.agent.registry import LEARNERS, name_of
from train.runs import run as runs
from train.runs.checkpoint import RunError
from train.runs.folder import DEMONSTRATIONS_FILE, Run

# Up to this ratio of median tip errors, on the later arm and on that of the training, and up to this share of
# goals that saturate besides, no training is needed; by hand. The loop corrects the policy's error by itself.
ENOUGH, MORE_SATURATED = 1.5, 0.05


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

    Args:
        before: the run.
        now: the run with the later calibration.
        calibration: folder of this calibration.
        console: console to print to.
    """
    # Figures of a finished run are known; those of another are not
    new = _evaluated(now)
    old = before.evaluation() or _evaluated(before)
    more = new.get("saturated_share", 0.0) - old.get("saturated_share", 0.0)
    console.print(
        f"in simulation, median tip error {old['median_mm']:.2f} mm on the arm of the training, "
        f"{new['median_mm']:.2f} mm on the later one; {100 * more:+.1f} % of the goals saturated",
        highlight=False,
    )
    if new["median_mm"] <= ENOUGH * old["median_mm"] and more <= MORE_SATURATED:
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


def _evaluated(run: Run) -> dict[str, Any]:
    return runs.task_of_run(run).evaluate(run.policy())[0].to_dict()
