"""Weights alone: the page's lines of NumPy ask for the readings that the actor asks for in training."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

from calib.arm import CalibratedArm
from mjx_softarm.env import ReachEnv
from tests.train.small import CONFIG, SHORT, new_job
from train.__main__ import main
from train.runs.folder import Run

PAGE = Path(__file__).parents[3] / "docs/export.md"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run without training; its environment, its job and its state."""
    env = ReachEnv(SHORT, CONFIG.env)
    job = new_job(CONFIG, env)
    state = job.init(jax.random.PRNGKey(0))
    run = Run.create(tmp_path_factory.mktemp("runs") / "run", CONFIG, CalibratedArm(SHORT))
    run.checkpoints.save(0, state, job.parts(state))
    return run, env, job, state


def test_the_page_s_lines_of_numpy_are_the_actor(trained, tmp_path, monkeypatch, capsys):
    run, env, job, state = trained
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(run.path), "--weights", "actor.npz"]) == 0
    assert "weights: actor.npz, " in capsys.readouterr().out
    assert not (run.path / "policy.npz").exists() and not (run.path / "estimators.npz").exists()
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    page: dict = {}
    exec(code, page)
    pose, goal = np.float32([[5, -9, -180, 170, 20, -3], [-30, 8, -170, -175, -15, 12]])
    action = job.learner.mode(job.policy(state), env.observe(pose, goal))
    expected = env.action_map.readings(action)
    np.testing.assert_allclose(page["act"](pose, goal), expected, rtol=1e-5)


def test_weights_go_alone_and_into_a_folder_that_exists(trained, capsys):
    run = str(trained[0].path)
    assert main(["export", run, "--weights", "actor.npz", "--onnx"]) == 2
    assert "--weights: got it with --out, --onnx" in capsys.readouterr().err
    assert main(["export", run, run, "--weights", "actor.npz"]) == 2
    assert "RUN: got 2, expected one folder of a run" in capsys.readouterr().err
    assert main(["export", run, "--weights", "absent/actor.npz"]) == 2
    assert "absent" in capsys.readouterr().err
