"""A run on a later calibration of its arm."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm import ArmSpec
from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig
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


@pytest.fixture
def run_of(tmp_path, imitation_config):
    """Learner and preset -> a run."""

    def make(learner, preset):
        config = imitation_config if learner == "imitation" else CONFIG
        return Run.create(tmp_path / "then", config, CalibratedArm(SHORT), preset=preset)

    return make


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
def test_training_is_needed_where_errors_grow(median_mm, p95_mm, s2r_mm, enough, run_of, monkeypatch, capsys):
    then = run_of("tqc", "payload")
    later = None if s2r_mm is None else SimpleNamespace(error_mm=s2r_mm)
    figures = {"median_mm": median_mm, "p95_mm": p95_mm}
    said = advice(then, THEN, figures, monkeypatch, capsys, later=later)
    assert f"95 %: 0.80 mm on the arm of the training, {p95_mm:.2f} mm on the later one" in said
    assert ("enough without training" in said and "NOT" not in said) == enough
    command = f"python -m train reach --agent {then.path} --calibration new --preset payload"
    assert (f"go on training: {command}" in said) != enough


@pytest.mark.parametrize("moves", [False, True])
def test_goals_are_corrected_at_rest_alone_and_demonstrations_are_used_again(
    moves, run_of, monkeypatch, capsys
):
    then, limits = run_of("imitation", "pipe"), []
    monkeypatch.setattr(EnvConfig, "moves", moves)
    shown = {"median_mm": 1.0, "max_mm": 3.0}
    said = advice(then, shown, shown | {"max_mm": 4.0}, monkeypatch, capsys, limits=limits)
    command = f"python -m train imitate {then.path}/demonstrations.npz --agent {then.path} --calibration new"
    assert f"{command} --preset pipe" in said
    assert len(limits) == (0 if moves else 2) and all(np.array_equal(x, SHIFT_LIMIT) for x in limits)


def advice(then, old, new, monkeypatch, capsys, limits=None, later=None):
    """Advice by the figures of the run and of the later arm; collect the limits of shifts."""
    now, limits = renewed(then, then.arm._replace(s2r=later)), [] if limits is None else limits

    class Known:
        env = "own"

        def __init__(self, figures):
            self.figures = figures

        def on(self, env, shift_limit):
            assert env == self.env
            limits.append(shift_limit)
            return self

        def __call__(self, policy):
            return SimpleNamespace(to_dict=lambda: self.figures), None, None

    def task_of(run):
        return SimpleNamespace(evaluate=Known(old if run is then else new))

    monkeypatch.setattr("train.runs.run.task_of_run", task_of)
    monkeypatch.setattr(Run, "policy", lambda run: None)
    enough = policy_still_accurate(then, now, Path("new"), Console(width=400))
    said = " ".join(capsys.readouterr().out.split())
    assert enough == ("enough without training" in said and "NOT" not in said)
    return said
