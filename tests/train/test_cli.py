"""`python -m train` as a user runs it: killed, resumed, stopped, evaluated, exported, misused."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from calib.arm import CalibratedArm
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.training import Schedule
from mjx_softarm.env import ReachEnv
from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.mechanics import workspace
from mjx_softarm.mechanics.workspace import sample_workspace
from mjx_softarm.policy.file import load_policy
from mjx_softarm.sensing.pose import frame_from_pose, quaternion_from_pose
from tests.arms import SHORT
from tests.train.small import CONFIG, flags, new_job
from train.__main__ import main
from train.runs.folder import Run, sole_trainer

ROOT = Path(__file__).resolve().parents[2]


pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """File of the short arm."""
    path = tmp_path_factory.mktemp("arm") / "arm.toml"
    SHORT.to_toml(path)
    return str(path)


def final_state(out):
    run = Run.open(out)
    job = new_job(run.config, ReachEnv(run.spec, run.config.env))
    return run.checkpoints.restore(job.shapes())


def send_in_epoch_6(number):
    """Return `Run.log` that sends a signal to its own process after epoch 6; checkpoints are every fourth."""

    def log_and_send(run, row, log=Run.log):
        log(run, row)
        if row["epoch"] == 6:
            os.kill(os.getpid(), number)

    return log_and_send


NEW = ["reach", *flags(total_env_steps=128), "--evaluation-epochs=4", "--spec"]  # eight epochs
DIES = """
import signal, sys
from tests.train.test_cli import Run, main, send_in_epoch_6
Run.log = send_in_epoch_6(signal.SIGKILL)
main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def whole(arm, tmp_path_factory):
    """A run of eight epochs, trained without a stop."""
    workspace._solver.cache_clear()  # others may have compiled it with other options than the process below
    out = tmp_path_factory.mktemp("runs") / "whole"
    assert main([*NEW, arm, "--out", str(out)]) == 0
    return out


def test_a_run_survives_kill_9_and_ctrl_c_and_ends_with_the_same_bits(
    whole, arm, tmp_path, monkeypatch, capsys
):
    killed = tmp_path / "killed"
    same_programs = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}  # from the cache
    process = subprocess.run(
        [sys.executable, "-c", DIES, *NEW, arm, "--out", str(killed)],
        env={**os.environ, **same_programs},
        cwd=ROOT,
    )
    assert process.returncode == -signal.SIGKILL and not (killed / "evaluation.json").exists()
    assert Run.open(killed).checkpoints.latest == 4 and len(Run.open(killed).metrics()) == 6
    with monkeypatch.context() as patch:
        patch.setattr(Run, "log", send_in_epoch_6(signal.SIGINT))
        assert main(["reach", "--resume", str(killed)]) == 130
    assert Run.open(killed).checkpoints.latest == len(Run.open(killed).metrics()) == 7
    assert main(["reach", "--resume", str(killed)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "continue with --resume" in printed and "begins anew" not in printed

    expected, resumed = final_state(whole), final_state(killed)
    assert expected.n_epochs == 8
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(expected), jax.device_get(resumed))
    assert [row["epoch"] for row in Run.open(killed).metrics()] == list(range(1, 9))
    figures = [json.loads((run / "evaluation.json").read_text()) for run in (whole, killed)]
    assert figures[0] == figures[1]


def test_an_evaluation_with_a_payload_is_of_an_arm_that_carries_it(whole, monkeypatch):
    figures = json.loads((whole / "evaluation.json").read_text())
    carried_kg = []
    carrying = lambda spec, *rest: carried_kg.append(spec.mass.payload_kg) or ReachEnv(spec, *rest)  # noqa: E731
    monkeypatch.setattr("train.runs.command.ReachEnv", carrying)
    assert main(["evaluate", str(whole), "--payload", "50"]) == 0 and carried_kg == [0.05]
    loaded = json.loads((whole / "evaluation-50g.json").read_text())
    assert loaded.keys() == figures.keys() and loaded["median_mm"] != figures["median_mm"]


@pytest.mark.slow
def test_an_exported_policy_asks_for_the_same_lengths_on_a_later_calibration(
    whole, tmp_path, monkeypatch, capsys
):
    few = {"N_TRAINING": 512, "N_JUDGING": 256, "N_HELD_OUT": 64, "N_WORKSPACE": 256, "PAYLOADS": (0.0,)}
    for name, value in {**few, "SCHEDULE": Schedule(10, 4e-3, 256)}.items():
        monkeypatch.setattr(f"train.runs.arm_model.{name}", value)
    assert main(["export", str(whole)]) == 0

    # Later, the springs' zeros have shifted, and the arm was seen at other lengths
    first, later = load_policy(whole / "policy.npz"), tmp_path / "later"
    later.mkdir()
    shifted = {"delta_m": first.spec.sensor.delta_m + 0.002}
    lengths = {"length_min_m": 0.1, "length_max_m": 0.25}
    first.spec.replace(sensor=shifted, springs=lengths).to_toml(later / "arm.toml")
    capsys.readouterr()
    assert main(["export", str(whole), "--calibration", str(later)]) == 0
    renewed = load_policy(whole / "policy-later.npz")
    for now, before in zip(renewed.actions[1:], first.actions[1:], strict=True):
        np.testing.assert_allclose(
            renewed.sensor.lengths(now).length_m, first.sensor.lengths(before).length_m, atol=1e-9
        )
        assert (now != before).all()
    jax.tree.map(np.testing.assert_array_equal, renewed.layers, first.layers)
    assert "enough without training" in capsys.readouterr().out and (later / "estimators.npz").exists()


def test_resume_says_that_a_run_without_a_checkpoint_begins_anew(tmp_path, monkeypatch, capsys):
    run = Run.create(tmp_path, CONFIG, CalibratedArm(SHORT))
    monkeypatch.setattr("train.runs.run.task_of_run", lambda *_: None)
    monkeypatch.setattr("train.runs.command._train", lambda *_: 0)
    assert main(["reach", "--resume", str(tmp_path)]) == 0
    assert f"{tmp_path}: no checkpoint yet, the run begins anew" in capsys.readouterr().out
    for epoch in range(1, CONFIG.learner.n_epochs + 1):
        run.log({"epoch": epoch})
    run.check_begins_anew()  # it may have died before the checkpoint of the last epoch
    run.log({"epoch": epoch + 1})
    assert main(["reach", "--resume", str(tmp_path)]) == 2
    assert "got no checkpoint of a run with 9 epochs" in capsys.readouterr().err


def test_export_reads_the_policy_before_it_distils(tmp_path, monkeypatch, capsys):
    Run.create(tmp_path, CONFIG, CalibratedArm(SHORT))
    monkeypatch.setattr("train.runs.arm_model.arm_model", lambda *_: pytest.fail("distilled"))
    assert main(["export", str(tmp_path)]) == 2
    assert f"{tmp_path}: got no checkpoint, expected one" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["reach", "imitate", "sweep"])
def test_help_explains_every_setting(command, capsys):
    assert main([command, "--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.count("\n  --") > 45
    without_text = re.findall(r"\n  (--[a-z]\S+)(?: [A-Z\[{.]\S*)*\s+\(default", shown)
    assert without_text == []


def test_a_folder_has_one_trainer_at_a_time(tmp_path):
    """One that was killed holds it no longer: such a run is resumed above."""
    with sole_trainer(tmp_path), pytest.raises(InputError, match=f"{tmp_path}: got another process"):
        sole_trainer(tmp_path).__enter__()
    with sole_trainer(tmp_path):
        pass


@pytest.mark.parametrize(
    "arguments, message",
    [
        ("reach --learner.gama 1", "Unrecognized options: --learner.gama, 1"),
        ("imitate", "FILE: got nothing, expected the demonstrations"),
        ("imitate absent.npz --learner.stages 0.5,1", "expected SHARE,EVERY,KEPT"),
        ("sweep --vary learner.gamma", "--vary: got 'learner.gamma', expected NAME=VALUE,..."),
        ("reach --seed -1", "seed: got -1, expected a whole number >= 0"),
        ("export", "RUN: got 0, expected one folder of a run or more"),
        ("reach --spec absent.toml", "absent.toml: got 'No such file"),
        ("reach --resume absent", "absent/config.json: got 'No such file"),
        ("reach --resume absent --seed 1 --learner.gamma 0.4 --out run", "got --out, --learner, --seed too"),
        ("evaluate absent --payload -1", "--payload: got -1, expected a finite number >= 0"),
        ("evaluate absent --actions 3", "--actions: got 3 without --in-motion"),
    ],
)
def test_misuse_is_told_and_leaves_nothing_behind(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "1000")  # no message is broken into lines
    assert main(arguments.split()) == 2
    assert message in capsys.readouterr().err and list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    """File of poses that the short arm was shown."""
    path = tmp_path_factory.mktemp("demonstrations") / "demos.npz"
    pool = sample_workspace(SHORT, 6, seed=1)
    log = Log(
        source="demos",
        row=np.arange(6) + 2,
        time_s=np.arange(6.0),
        readings=SHORT.spring_sensor.readings(np.asarray(pool.spring_m, float)),
        tip_m=frame_from_pose(np.asarray(pool.pose, float))[0],
        tip_quaternion=quaternion_from_pose(np.asarray(pool.pose, float)),
        sequence=np.zeros(6),
    )
    write_log(path, log)
    return str(path)


def test_imitation_hands_its_reward_and_its_layers_on(arm, demonstrations, tmp_path, monkeypatch, capsys):
    # 8 epochs, the second stage from the fourth
    changes = {"total_env_steps": 128, "rebalance_env_steps": 48, "gail.hidden": 16}
    settings = ["--evaluation-epochs=4", "--learner.stages", "0.5,2,1", "0.5,1,0.5", "--spec", arm]
    imitate = ["imitate", demonstrations, *flags(**changes), *settings, "--out"]
    donor, heir = tmp_path / "donor", tmp_path / "heir"
    assert main([*imitate, str(donor)]) == 0
    assert all((donor / name).exists() for name in ("learning_curve.png", "positions.png"))
    assert len(json.loads((donor / "evaluation.json").read_text())["error_mm"]) == 6

    capsys.readouterr()
    weights = ["--learner.learned-weight=0", "--learner.hand-made-weight=1"]
    assert main([*imitate, str(heir), *weights, "--reward", str(donor)]) == 2
    assert "learner.learned_weight: got 0 with --reward" in capsys.readouterr().err
    assert main(["evaluate", str(donor), "--in-motion", "0.5"]) == 2
    assert "--in-motion: got a run of `imitate`" in capsys.readouterr().err
    assert not heir.exists()

    narrow = flags(**changes, hidden=8)  # the agent's layers are taken all the same
    donors = ["--agent", str(donor), "--reward", str(donor)]
    monkeypatch.setattr("train.runs.command._train", lambda *_: 0)  # what it begins with is stored before
    assert main(["imitate", demonstrations, *narrow, *settings, *donors, "--out", str(heir)]) == 0
    rewards = [Run.open(run).checkpoints.parts()["reward"] for run in (donor, heir)]
    jax.tree.map(np.testing.assert_array_equal, *rewards)
    begun = json.loads((heir / "config.json").read_text())["begins_with"]
    assert begun == {"agent": str(donor), "reward": str(donor)}
    learners = [Run.open(run).config.learner for run in (donor, heir)]
    assert [(each.hidden, each.frozen) for each in learners] == [((16,), False), ((16,), True)]
