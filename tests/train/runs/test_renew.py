"""A run on a later calibration of its arm."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from mjx_softarm import ArmSpec
from tests.train.small import CONFIG, SHORT
from train.presets import PRESETS
from train.runs.checkpoint import Run, RunError
from train.runs.renew import renewed, told_enough


def test_another_arm_is_refused(tmp_path):
    run = Run.create(tmp_path / "run", CONFIG, SHORT)
    with pytest.raises(RunError, match="got an arm of 3 sections, 9 chambers and 9 springs, expected 1 sect"):
        renewed(run, ArmSpec.default(), None)


@pytest.mark.parametrize(
    ("median_mm", "saturated_share", "enough"), [(1.4, 0.12, True), (1.6, 0.1, False), (1.0, 0.16, False)]
)
def test_training_is_needed_where_simulated_errors_grow(
    median_mm, saturated_share, enough, monkeypatch, capsys
):
    figures = {"then": (1.0, 0.1), "now": (median_mm, saturated_share)}

    def task_of(run):
        summary = SimpleNamespace(
            **dict(zip(("median_mm", "saturated_share"), figures[run.path], strict=True))
        )
        return SimpleNamespace(evaluate=lambda policy: (summary, None, None))

    monkeypatch.setattr("train.runs.run.task_of_run", task_of)
    config = dataclasses.replace(PRESETS["payload"], seed=3)
    then, now = (SimpleNamespace(path=path, config=config, policy=lambda: None) for path in figures)
    assert told_enough(then, now, Path("new"), Console()) == enough
    said = " ".join(capsys.readouterr().out.split())
    assert f"median tip error 1.00 mm on the arm of the training, {median_mm:.2f} mm on the later one" in said
    command = "python -m train reach --agent then --calibration new --preset payload"
    assert (f"go on training: {command}" in said) != enough
