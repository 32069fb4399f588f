"""`python -m train` as a user runs it: killed, resumed, stopped, evaluated, exported, misused."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from mjx_softarm.env import ReachEnv
from train.__main__ import main
from train.checkpoint import Run
from train.job import Job
from train.plots import REACH_PICTURES

SMALL = {
    "n_arms": 8,
    "total_env_steps": 256,
    "warmup_env_steps": 16,
    "batch_size": 16,
    "replay_capacity": 128,
    "vector_steps_per_epoch": 2,
    "evaluation_epochs": 4,
    "env.n_poses": 256,
    "tqc.hidden_actor": [16, 16],
    "tqc.hidden_critic": [16, 16],
}


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """One compilation cache for every process of this file."""
    cache = tmp_path_factory.mktemp("cache")
    return {**os.environ, "XDG_CACHE_HOME": str(cache)}


def command(out, **changes):
    settings = {**SMALL, **{name.replace("__", "."): value for name, value in changes.items()}}
    flags = [part for name, value in settings.items() for part in ("--set", f"{name}={json.dumps(value)}")]
    return [sys.executable, "-m", "train", "reach", *flags, "--out", str(out)]


def resume(out):
    return [sys.executable, "-m", "train", "reach", "--resume", str(out)]


def final_state(out):
    run = Run.open(Path(out))
    job = Job(run.config, ReachEnv(run.spec, run.config.env))
    return run.restore(jax.eval_shape(job.init, jax.random.PRNGKey(0)))


def interrupt_after_a_checkpoint(out, number, environment):
    """Start a run, send a signal once a checkpoint stands; returns the process, which has ended."""
    process = subprocess.Popen(command(out), env=environment, stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 300
    while not any(path.name.isdigit() for path in Path(out).glob("checkpoints/*")):  # whole ones
        assert process.poll() is None and time.monotonic() < deadline, "no checkpoint before the run ended"
        time.sleep(0.01)
    process.send_signal(number)
    process.communicate(timeout=120)
    return process


def test_a_run_survives_kill_9_and_ends_with_the_same_bits(tmp_path, environment):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    process = interrupt_after_a_checkpoint(killed, signal.SIGKILL, environment)
    assert process.returncode == -signal.SIGKILL and not (killed / "evaluation.json").exists()
    subprocess.run(resume(killed), env=environment, check=True, capture_output=True)
    subprocess.run(command(whole), env=environment, check=True, capture_output=True)

    (epoch, expected), (resumed_epoch, resumed) = final_state(whole), final_state(killed)
    assert epoch == resumed_epoch == 16
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(expected), jax.device_get(resumed))
    rows = [json.loads(line) for line in (killed / "metrics.jsonl").read_text().splitlines()]
    assert [row["epoch"] for row in rows] == list(range(1, 17))

    assert main(["evaluate", str(whole)]) == 0
    figures = json.loads((whole / "evaluation.json").read_text())
    assert figures == json.loads((killed / "evaluation.json").read_text())
    assert all((whole / name).stat().st_size > 10_000 for name in REACH_PICTURES)
    assert list(whole.glob("events.out.tfevents.*"))
    config = json.loads((whole / "config.json").read_text())
    assert {"python", "packages", "commit"} <= config["provenance"].keys()

    assert main(["export", str(whole)]) == 0
    assert (whole / "policy.npz").exists()


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path, environment):
    out = tmp_path / "stopped"
    process = interrupt_after_a_checkpoint(out, signal.SIGINT, environment)
    assert process.returncode == 130
    rows = (out / "metrics.jsonl").read_text().splitlines()
    assert Run.open(out).latest_epoch == json.loads(rows[-1])["epoch"] < 16


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["reach", "--set", "tqc.gama=1"], "tqc.gama: unknown setting"),
        (["reach", "--spec", "absent.toml"], "absent.toml: cannot be read: No such file or directory"),
        (["reach", "--resume", "absent"], "absent: not the folder of a run"),
        (
            ["reach", "--resume", "absent", "--seed", "0", "--set", "tqc.gamma=0.5"],
            "--resume goes alone: the run's own settings hold, got --seed, --set too",
        ),
        (["reach", "--set", "env.workspace_seed=20000"], "20000 draws the goals of the evaluation"),
        (["reach", "--set", "hindsight.near_min_mm=0"], "near_min_mm must be > 0"),
        (["reach", "--set", "evaluation_epochs=0"], "evaluation_epochs: got 0, expected at least 1"),
        (["evaluate", "absent"], "absent: not the folder of a run"),
        (["export", "absent"], "absent: not the folder of a run"),
    ],
)
def test_misuse_is_one_line_and_leaves_nothing_behind(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
