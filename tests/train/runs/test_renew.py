"""A run on a later calibration of its arm."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm import ArmSpec
from mjx_softarm._support.provenance import write_json
from tests.train.small import CONFIG, SHORT
from train.runs.checkpoint import RunError
from train.runs.folder import EVALUATION_FILE, Run
from train.runs.renew import renewed, told_enough


def test_another_arm_is_refused(tmp_path):
    run = Run.create(tmp_path / "run", CONFIG, CalibratedArm(SHORT))
    with pytest.raises(RunError, match="got an arm of 3 sections, 9 chambers and 9 springs, expected 1 sect"):
        renewed(run, CalibratedArm(ArmSpec.default()))


@pytest.fixture
def run_of(tmp_path, imitation_config):
    """Learner, preset and figures -> a finished run."""

    def make(learner, preset, figures):
        config = imitation_config if learner == "imitation" else CONFIG
        run = Run.create(tmp_path / "then", config, CalibratedArm(SHORT), preset=preset)
        write_json(run.path / EVALUATION_FILE, figures)
        return Run.open(run.path)

    return make


@pytest.mark.parametrize(
    ("median_mm", "saturated_share", "enough"), [(1.4, 0.12, True), (1.6, 0.1, False), (1.0, 0.16, False)]
)
def test_training_is_needed_where_simulated_errors_grow(
    median_mm, saturated_share, enough, run_of, monkeypatch, capsys
):
    then = run_of("tqc", "payload", {"median_mm": 1.0, "saturated_share": 0.1})
    said = told(then, {"median_mm": median_mm, "saturated_share": saturated_share}, monkeypatch, capsys)
    assert f"median tip error 1.00 mm on the arm of the training, {median_mm:.2f} mm on the later one" in said
    assert ("enough without training" in said and "NOT" not in said) == enough
    command = f"python -m train reach --agent {then.path} --calibration new --preset payload"
    assert (f"go on training: {command}" in said) != enough


def test_a_run_from_demonstrations_goes_on_with_them(run_of, monkeypatch, capsys):
    then = run_of("imitation", "pipe", {"median_mm": 1.0})
    command = f"python -m train imitate {then.path}/demonstrations.npz --agent {then.path} --calibration new"
    assert f"{command} --preset pipe" in told(then, {"median_mm": 2.0}, monkeypatch, capsys)


def told(then, figures, monkeypatch, capsys):
    """Advice by the later arm's figures; those of the run itself are not found anew."""
    now = renewed(then, then.arm)

    def task_of(run):
        assert run is now
        summary = SimpleNamespace(to_dict=lambda: figures)
        return SimpleNamespace(evaluate=lambda policy: (summary, None, None))

    monkeypatch.setattr("train.runs.run.task_of_run", task_of)
    monkeypatch.setattr(Run, "policy", lambda run: None)
    enough = told_enough(then, now, Path("new"), Console(width=400))
    said = " ".join(capsys.readouterr().out.split())
    assert enough == ("enough without training" in said and "NOT" not in said)
    return said
