"""A run on a later calibration of its arm."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm import ArmSpec
from mjx_softarm.deploy.controller import LOOP
from mjx_softarm.env import EnvConfig
from tests.train.small import CONFIG, SHORT
from train.runs.checkpoint import RunError
from train.runs.folder import Run
from train.runs.renew import renewed, told_enough


def test_another_arm_is_refused(tmp_path):
    run = Run.create(tmp_path / "run", CONFIG, CalibratedArm(SHORT))
    with pytest.raises(RunError, match="got an arm of 3 sections, 9 chambers and 9 springs, expected 1 sect"):
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
    ("median_mm", "p95_mm", "s2r_mm", "expected_mm", "enough"),
    [
        (0.38, 0.9, 0.0, (0.38, 0.9), True),
        (0.40, 0.8, 0.0, (0.40, 0.8), False),
        (0.40, 0.8, 0.4, (0.57, 0.89), True),  # 0.3 and 0.4 mm were 0.5
        (0.55, 0.8, 0.4, (0.68, 0.89), False),
        (0.30, 1.2, 0.4, (0.50, 1.26), False),
    ],
)
def test_training_is_needed_where_errors_grow(
    median_mm, p95_mm, s2r_mm, expected_mm, enough, run_of, monkeypatch, capsys
):
    then = run_of("tqc", "payload")
    then.arm = then.arm._replace(s2r=SimpleNamespace(error_mm=s2r_mm))
    said = told(then, THEN, {"median_mm": median_mm, "p95_mm": p95_mm}, monkeypatch, capsys)
    first_mm = [np.hypot(value, s2r_mm) for value in THEN.values()]
    for name, old_mm, new_mm in zip(("median", "95 %"), first_mm, expected_mm, strict=True):
        both = f"{old_mm:.2f} mm on the arm of the training, {new_mm:.2f} mm on the later one"
        assert f"expected, {name}: {both}" in said
    assert ("enough without training" in said and "NOT" not in said) == enough
    command = f"python -m train reach --agent {then.path} --calibration new --preset payload"
    assert (f"go on training: {command}" in said) != enough


def test_a_run_from_demonstrations_goes_on_with_them(run_of, monkeypatch, capsys):
    then, shown = run_of("imitation", "pipe"), {"median_mm": 1.0, "max_mm": 3.0}
    command = f"python -m train imitate {then.path}/demonstrations.npz --agent {then.path} --calibration new"
    assert f"{command} --preset pipe" in told(then, shown, shown | {"max_mm": 4.0}, monkeypatch, capsys)


@pytest.mark.parametrize("moves", [False, True])
def test_goals_are_corrected_as_by_the_loop_at_rest_alone(moves, run_of, monkeypatch, capsys):
    then = run_of("tqc", "payload")
    monkeypatch.setattr(EnvConfig, "moves", moves)
    limit = np.zeros(6) if moves else LOOP.shift_limit
    told(then, THEN, THEN, monkeypatch, capsys, limit)


def told(then, old, new, monkeypatch, capsys, limit=None):
    """Advice by the figures of the run and of the later arm."""
    now = renewed(then, then.arm)

    def task_of(run):
        def on(env, shift_limit):
            assert env == "own" and (limit is None or np.array_equal(shift_limit, limit))
            summary = SimpleNamespace(to_dict=lambda: old if run is then else new)
            return lambda policy: (summary, None, None)

        return SimpleNamespace(evaluate=SimpleNamespace(env="own", on=on))

    monkeypatch.setattr("train.runs.run.task_of_run", task_of)
    monkeypatch.setattr(Run, "policy", lambda run: None)
    enough = told_enough(then, now, Path("new"), Console(width=400))
    said = " ".join(capsys.readouterr().out.split())
    assert enough == ("enough without training" in said and "NOT" not in said)
    return said
