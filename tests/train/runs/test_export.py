"""The actor alone in a file, whose scales are those of training; a run on a later calibration of its arm."""

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm import ArmSpec
from mjx_softarm._support.errors import InputError
from mjx_softarm.mdp.actions import SHIFT_LIMIT, ActionMap
from mjx_softarm.mdp.observation import (
    ObsScale,
    layouts,
    observe,
    observe_motion,
    observe_payload,
    rate_ticks,
)
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy.file import SHIPPED, load_policy
from tests.train.small import CONFIG, SHORT
from train.__main__ import main
from train.agent.networks import Actor, mode
from train.runs.export import contents, observation_scaling, policy_still_accurate, renewed
from train.runs.folder import Run

ROOT = Path(__file__).resolve().parents[3]
BLOCK = re.search(r"```python\n(.+?)```", (ROOT / "docs/export.md").read_text("utf-8"), re.S)[1]
SPEC, RNG = SHORT, np.random.default_rng(0)


@pytest.fixture
def run(tmp_path):
    """A run whose actor has random weights."""
    run = Run.create(tmp_path / "run", CONFIG, CalibratedArm(SPEC))
    params = Actor(SPEC.n_springs, CONFIG.learner.hidden).init(jax.random.key(3), jnp.zeros(18))
    run.checkpoints.save(1, {"any": np.zeros(1)}, {"policy": params})
    return run


def test_the_page_s_numpy_gives_the_actions_of_training(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(run.path), "--weights", "actor.npz"]) == 0
    assert len(BLOCK.splitlines()) == 12
    values = {}
    exec(BLOCK, values)
    obs = observe(
        *(jnp.float32(values[name]) for name in ("pose", "goal")), ObsScale.from_spec(SPEC), RewardConfig()
    )
    action = mode(*Actor(SPEC.n_springs, CONFIG.learner.hidden).apply(run.policy(), obs)[:1])
    assert np.abs(action).max() > 0.05
    expected = ActionMap.from_spec(SPEC).readings(np.asarray(action, np.float64))
    np.testing.assert_allclose(values["readings"], expected, rtol=1e-6)


def random_entries(kind):
    """Return entries of an observation as `layouts` names them, and the observation of training."""
    pose, goal = (RNG.uniform(-170.0, 170.0, 6) for _ in range(2))
    reward = RewardConfig(axes=(1.0, 1.0, 1.0, 0.0, 1.0, 1.0))
    raw, obs = [pose, goal, pose - goal], [observe(pose, goal, ObsScale.from_spec(SPEC), reward)]
    if kind == "payload":
        raw.append(np.array([0.3]))
        obs.append(observe_payload(0.3, SPEC))
    if kind == "motion":
        n, c, rate_hz = SPEC.n_springs, SPEC.n_chambers, SPEC.control.rate_hz
        over_s = rate_ticks(rate_hz) / rate_hz
        spring, rate, tip, velocity, integral, action = map(RNG.standard_normal, (n, n, 3, 3, c, n))
        raw += [spring, rate, velocity, integral, action]
        moves = spring, spring - over_s * rate, tip, tip - over_s * velocity
        obs.append(observe_motion(*moves, integral, action, SPEC))
    return reward, np.concatenate(raw), np.concatenate(obs)


@pytest.mark.parametrize("kind", ["pose", "payload", "motion"])
def test_scales_are_those_of_training(kind):
    reward, raw, expected = random_entries(kind)
    centre, scale = observation_scaling(SPEC, reward, kind)
    away = raw - centre
    away[[3, 4, 5, 9, 10, 11, 15, 16, 17]] = (away[[3, 4, 5, 9, 10, 11, 15, 16, 17]] + 180) % 360 - 180
    assert len(centre) == len(layouts(SPEC)[kind])
    np.testing.assert_allclose(away / scale, expected, rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize(
    ("policy", "options", "message"),
    [
        ({"params": {"other": {}}}, [], "actor parameters: got ['other'], expected hidden_0"),
        (None, ["--onnx"], "--weights: got --onnx too, expected it alone"),
        (None, ["absent"], "RUN: got 2, expected one folder of a run"),
    ],
)
def test_what_the_file_cannot_hold_is_refused(policy, options, message, run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Run, "policy", lambda run, own=Run.policy: policy or own(run))
    assert main(["export", str(run.path), *options, "--weights", str(tmp_path / "actor.npz")]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "actor.npz").exists()


def test_an_estimator_that_is_not_exact_enough_is_said_to_be():
    policy = load_policy(SHIPPED)
    errors = {"tip_mm": {"0 kg": {"median": 0.02, "p95": 0.09}, "1 kg": {"median": 0.02, "p95": 0.26}}}
    inexact = dataclasses.replace(policy, provenance={**policy.provenance, "estimator_errors": errors})
    assert any("within 0.26 mm of the simulation, expected 0.1 mm" in line for line in contents(inexact))
    assert not any("warning" in line for line in contents(policy))


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
