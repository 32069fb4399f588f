"""A run on a later calibration of its arm."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm import ArmSpec
from mjx_softarm._support.errors import InputError
from mjx_softarm.mdp.actions import SHIFT_LIMIT
from tests.arms import SHORT
from tests.train.small import CONFIG
from train.runs.folder import Run
from train.runs.renew import policy_still_accurate, renewed


def test_another_arm_is_refused(tmp_path):
    run = Run.create(tmp_path / "run", CONFIG, CalibratedArm(SHORT))
    with pytest.raises(
        InputError, match="got an arm of 3 sections, 9 chambers and 9 springs, expected 1 sect"
    ):
        renewed(run, CalibratedArm(ArmSpec.default()))


@dataclasses.dataclass
class MadeUp:
    """An evaluation with figures made up, and with corrected goals alone."""

    figures: dict
    shift_limit: Any = None

    def __call__(self, policy):
        np.testing.assert_array_equal(self.shift_limit, SHIFT_LIMIT)
        return SimpleNamespace(to_dict=lambda: self.figures), None, None


THEN = {"median_mm": 0.3, "p95_mm": 0.8}


@pytest.mark.parametrize(
    ("median_mm", "p95_mm", "s2r_mm", "enough"),
    [
        (0.68, 0.8, None, True),  # 0.98 and 0.76 mm with the models' 0.7
        (0.72, 0.8, None, False),
        (0.30, 1.3, 0.1, False),
        (1.00, 0.8, 1.0, False),
    ],
)
def test_training_is_needed_where_errors_grow(
    median_mm, p95_mm, s2r_mm, enough, tmp_path, monkeypatch, capsys
):
    """Both evaluations are with goals that are corrected, as the loop corrects them at rest."""
    then = Run.create(tmp_path / "then", CONFIG, CalibratedArm(SHORT), preset="payload")
    later = None if s2r_mm is None else SimpleNamespace(error_mm=s2r_mm)
    now = renewed(then, then.arm._replace(s2r=later))

    def task_of(run):
        figures = THEN if run is then else {"median_mm": median_mm, "p95_mm": p95_mm}
        return SimpleNamespace(evaluate=MadeUp(figures))

    monkeypatch.setattr("train.runs.run.task_of_run", task_of)
    monkeypatch.setattr(Run, "policy", lambda run: None)
    assert policy_still_accurate(then, now, Path("new"), Console(width=400)) == enough
    said = " ".join(capsys.readouterr().out.split())
    assert f"95 %: 0.80 mm on the arm of the training, {p95_mm:.2f} mm on the later one" in said
    command = f"python -m train reach --agent {then.path} --calibration new --preset payload"
    assert (f"go on training: {command}" in said) != enough
