"""A run's policy on a later calibration of its arm, without training, and whether that is enough."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from rich.console import Console

from mjx_softarm.sensing.s2r import S2R
from mjx_softarm.spec import ArmSpec
from train.config import TrainConfig
from train.presets import PRESETS
from train.runs import run as runs
from train.runs.checkpoint import Run, RunError

# Up to this ratio of median tip errors, on the later arm and on that of the training, and up to this share of
# goals that saturate besides, no training is needed; by hand. The loop corrects the policy's error by itself.
ENOUGH, MORE_SATURATED = 1.5, 0.05


def renewed(run: Run, spec: ArmSpec, s2r: S2R | None) -> Run:
    """Return a run with another calibration of its arm.

    Its actions stay readings of the same spring lengths: the range of lengths remains that of the training.

    Raises:
        RunError: it is another arm.
    """
    counts = [(arm.structure.n_sections, arm.n_chambers, arm.n_springs) for arm in (run.spec, spec)]
    if counts[0] != counts[1]:
        expected, got = (f"{s} sections, {c} chambers and {n} springs" for s, c, n in counts)
        raise RunError(f"--calibration: got an arm of {got}, expected {expected}, as in {run.path}")
    limits = {name: getattr(run.spec.springs, name) for name in ("length_min_m", "length_max_m")}
    return Run(run.path, run.config, spec.replace(springs=limits), s2r)


def told_enough(before: Run, now: Run, calibration: Path, console: Console) -> bool:
    """Evaluate a policy in simulation on both calibrations; tell and return whether it needs no training.

    Args:
        before: the run.
        now: the run with the later calibration.
        calibration: folder of this calibration.
        console: console to print to.
    """
    old, new = (runs.task_of_run(run).evaluate(run.policy())[0] for run in (before, now))
    before_share, now_share = (getattr(summary, "saturated_share", 0.0) for summary in (old, new))
    more = now_share - before_share
    console.print(
        f"in simulation, median tip error {old.median_mm:.2f} mm on the arm of the training, "
        f"{new.median_mm:.2f} mm on the later one; {100 * more:+.1f} % of the goals saturated",
        highlight=False,
    )
    if new.median_mm <= ENOUGH * old.median_mm and more <= MORE_SATURATED:
        console.print("enough without training")
        return True
    options = f"--agent {before.path} --calibration {calibration} --preset {_preset_of(before.config)}"
    console.print(
        f"NOT enough: go on training: python -m train reach {options}", highlight=False, soft_wrap=True
    )
    return False


def _preset_of(config: TrainConfig) -> str:
    """Return the preset from which settings differ least."""

    def settings(tree: dict[str, Any], path: str = "") -> set[str]:
        found = set()
        for name, value in tree.items():
            at = f"{path}.{name}"
            found |= settings(value, at) if isinstance(value, dict) else {f"{at} {value!r}"}
        return found

    own = settings(dataclasses.asdict(config))
    return min(PRESETS, key=lambda name: len(own ^ settings(dataclasses.asdict(PRESETS[name]))))
