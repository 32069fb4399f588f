"""Sweeps: a member is the ordinary run, all are traced once, and a killed sweep ends with the same bits."""

import dataclasses
import io
import json

import jax
import numpy as np
import pytest
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from tests.train import small
from tests.train.small import SHORT, new_job
from tests.train.sweep.test_report import AT_REST
from train.__main__ import main
from train.config import ConfigError, override
from train.presets import PRESETS
from train.runs.checkpoint import Checkpoints, RunError
from train.runs.folder import Run
from train.runs.task import Task
from train.sweep import run as sweep_run
from train.sweep.command import members_of
from train.sweep.job import SweepJob, setting, variable, with_env_config
from train.sweep.report import CURVES_FILE, RESULTS_FILE, report
from train.sweep.run import create, open_sweep

CONFIG = dataclasses.replace(
    small.CONFIG,
    evaluation_epochs=2,
    env=EnvConfig(
        n_poses=64,
        randomisation=Randomisation(0.1, 0.1, 0.1),
        pipe_diameter_mm=250,
        clearance_cost_per_mm=0.1,
        clearance_margin_mm=60.0,
    ),
    learner=dataclasses.replace(small.LEARNER, target_entropy=-9.0),
)
# Each setting that may be varied, at another value.
OTHER_SETTINGS = """
    learner.learning_rate=1e-2 learner.learning_rate_alpha=3e-2 learner.gamma=0.7 learner.tau=0.1
    learner.initial_alpha=0.3 learner.target_entropy=-20.0 learner.reward_scale=0.1
    learner.hindsight.reached_share=0.2 learner.hindsight.near_share=0.6 learner.hindsight.near_min_mm=3.0
    learner.hindsight.near_max_mm=50.0 learner.hindsight.mm_per_deg=2.0
    env.reward.goal_bonus=30.0 env.reward.error_cost=4.0 env.reward.step_cost=0.7
    env.reward.saturation_cost=20.0 env.reward.threshold=0.2 env.reward.weight_per_mm=0.003
    env.reward.distance_cost=2.0
    env.reward.weight_per_deg=0.004 env.randomisation.payload_max_kg=0.3
    env.randomisation.stiffness_spread=0.2 env.randomisation.sensor_noise_mm=0.5
    env.randomisation.damping_spread=0.2 env.randomisation.delay_max_s=0.05
    env.randomisation.friction_max_n=2.0 env.randomisation.regulator_spread=0.1
    env.saturation_tolerance_mm=5.0 env.clearance_cost_per_mm=0.3 env.clearance_margin_mm=90.0
"""
OTHER = OTHER_SETTINGS.split()
VARIABLE = variable(CONFIG)
N_EPOCHS = 5
pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def env():
    return ReachEnv(SHORT, CONFIG.env)


@pytest.fixture(scope="module")
def members():
    return {"first": CONFIG, "other": override(CONFIG, [*OTHER, "seed=3"])}


@pytest.fixture(scope="module")
def job(members, env):
    return SweepJob(list(members.values()), VARIABLE, env)


@pytest.fixture(scope="module")
def trained(job):
    """States after some epochs, and the metrics of all of them."""
    states, metrics = job.init(), []
    for _ in range(N_EPOCHS):
        states, row = job.epoch(states)
        metrics.append(jax.device_get(row))
    return states, metrics


def test_each_setting_that_may_be_varied_is_looked_at(members):
    assert {assignment.partition("=")[0] for assignment in OTHER} == set(VARIABLE)
    assert all(setting(members["first"], path) != setting(members["other"], path) for path in VARIABLE)


def test_a_member_is_the_ordinary_run(members, job, trained):
    states, metrics = trained
    config, other_env = members["other"], ReachEnv(SHORT, members["other"].env)
    alone = new_job(config, other_env)
    state = alone.init(jax.random.PRNGKey(members["other"].seed))
    for row in metrics:
        state, expected = alone.epoch(state)
        for name, value in expected.items():
            np.testing.assert_allclose(row[name][1], value, rtol=2e-4, atol=2e-5, err_msg=name)
    first, own = job.member(states, 0), job.member(states, 1)
    assert int(own.n_epochs) == N_EPOCHS and config.learner.n_updates(N_EPOCHS) > 0
    assert jax.tree.map(shape_of, own) == jax.tree.map(shape_of, state)
    assert_close(own, state)
    with pytest.raises(AssertionError):  # the comparison can tell members apart
        assert_close(first.learner, state.learner)


def assert_close(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=2e-3, atol=2e-4), a, b)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


def shape_of(x):
    return (x.shape, x.dtype)


def test_a_sweep_is_traced_once_and_warms_up_without_updates(job, trained):
    states, metrics = trained
    assert job.n_traces == 1
    assert (metrics[0]["tqc/critic_loss"] == 0).all() and (metrics[1]["tqc/critic_loss"] > 0).all()
    # A branch on a number of each member would have become a select, with both of its sides computed.
    program = job._epoch_all.lower(states, job.numbers, job.env.pool).as_text()
    assert program.count("stablehlo.case") == 1


class MadeUp:
    """Figures that depend on every parameter of an actor."""

    def __init__(self, actor_params):
        self.size = float(sum(np.abs(leaf).sum() for leaf in jax.tree.leaves(actor_params)))

    def to_dict(self):
        return dict.fromkeys(AT_REST, self.size)


@pytest.fixture
def ready(job, monkeypatch):
    """Sweeps of the members train with the compiled job, and are evaluated by made-up figures."""
    task = Task(
        job=None,
        title="",
        evaluate=lambda actor_params: (MadeUp(actor_params),),
        pictures=lambda rows: {},
        headline=None,
        prepare=lambda state, epoch: state,
    )
    monkeypatch.setattr(sweep_run, "ReachEnv", lambda spec, config, s2r: job.env)
    monkeypatch.setattr(sweep_run, "SweepJob", lambda configs, varied, env: job)
    monkeypatch.setattr(sweep_run, "task_of", lambda config, env: task)


def dying(checkpoints, epoch, *rest, save=Checkpoints.save):
    """Saves until the second member is to be saved after the sixth epoch."""
    if epoch == 6 and Run.open(checkpoints.run).config.seed == 3:
        raise KeyboardInterrupt
    save(checkpoints, epoch, *rest)


def test_a_stopped_sweep_ends_with_the_same_bits(ready, job, members, tmp_path, monkeypatch):
    console = Console(file=io.StringIO())
    arm = CalibratedArm(SHORT)
    whole, stopped = (create(tmp_path / name, members, VARIABLE, arm) for name in ("whole", "stopped"))
    sweep_run.train(whole, console)
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", dying)
        with pytest.raises(KeyboardInterrupt):
            sweep_run.train(stopped, console)
    resumed = open_sweep(stopped.path)
    assert resumed.varied == VARIABLE and [run.config for run in resumed.runs] == list(members.values())
    assert [run.checkpoints.epochs for run in resumed.runs] == [[4, 6], [2, 4]] and resumed.epoch == 4
    sweep_run.train(resumed, console)
    assert "continuing after epoch 4 of 8" in console.file.getvalue()

    for one, other in zip(whole.runs, resumed.runs, strict=True):
        saved = (run.checkpoints.restore(job.member_shapes()) for run in (one, other))
        (epoch, expected), (resumed_epoch, got) = saved
        assert epoch == resumed_epoch == 8
        assert_equal(expected, got)
        rows = [[without_speed(row) for row in run.metrics()] for run in (one, other)]
        assert rows[0] == rows[1] and [row["epoch"] for row in rows[0]] == list(range(1, 9))
        assert ["evaluation/median_mm" in row for row in rows[0]] == [False, True] * 4
    for sweep in (whole, resumed):
        report(dataclasses.replace(sweep, varied=("learner.gamma",)))  # all settings would fill the plot
    results = [json.loads((sweep.path / RESULTS_FILE).read_text())["groups"] for sweep in (whole, resumed)]
    assert results[0] == results[1] and len(results[0]) == 2


def without_speed(row):
    return {name: value for name, value in row.items() if not name.startswith("speed/")}


@pytest.mark.slow
def test_a_sweep_as_a_user_runs_it(tmp_path, capsys):
    SHORT.to_toml(arm := tmp_path / "arm.toml")
    path = tmp_path / "whole"
    names = [f"seed{seed}-env.reward.goal_bonus={bonus}" for seed in (4, 5) for bonus in (50, 90)]
    options = ["--spec", str(arm), "--seeds", "4,5", "--vary", "env.reward.goal_bonus=50,90"]
    command = [
        "sweep",
        *small.flags(),
        "--env.n-poses=64",
        "--evaluation-epochs=4",
        *options,
        "--out",
        str(path),
    ]
    assert main(command) == 0
    results = json.loads((path / RESULTS_FILE).read_text())["groups"]
    assert [len(group["runs"]) for group in results] == [2, 2]
    assert (path / CURVES_FILE).stat().st_size > 10_000

    figures = (path / names[1] / "evaluation.json").read_text()
    assert main(["evaluate", str(path / names[1])]) == 0
    assert (path / names[1] / "evaluation.json").read_text() == figures
    capsys.readouterr()
    assert main(command) == 2
    assert "which is there already, expected a new folder; --resume" in capsys.readouterr().err


def test_members_are_the_product_of_seeds_and_values():
    members, varied = members_of(
        override(PRESETS["quick"], ["learner.n_arms=64"]),
        (0, 7),
        ["learner.gamma=0.5, 0.9", "env.reward.goal_bonus=50"],
    )
    assert varied == ("learner.gamma", "env.reward.goal_bonus")
    got = {
        name: (c.seed, c.learner.gamma, c.env.reward.goal_bonus, c.learner.n_arms)
        for name, c in members.items()
    }
    assert got == {
        "seed0-learner.gamma=0.5-env.reward.goal_bonus=50": (0, 0.5, 50.0, 64),
        "seed0-learner.gamma=0.9-env.reward.goal_bonus=50": (0, 0.9, 50.0, 64),
        "seed7-learner.gamma=0.5-env.reward.goal_bonus=50": (7, 0.5, 50.0, 64),
        "seed7-learner.gamma=0.9-env.reward.goal_bonus=50": (7, 0.9, 50.0, 64),
    }


MOVING = dataclasses.replace(CONFIG, env=EnvConfig(mode="dynamic", n_poses=8))


def test_a_member_in_motion_has_its_own_randomisation():
    spreads = ["env.randomisation.damping_spread=0.2", "env.randomisation.friction_max_n=2.0"]
    other = override(MOVING, [*spreads, "env.randomisation.delay_max_s=0.005"]).env
    share = np.ones(3)
    own, expected = (
        env.episode_motion.params(share)
        for env in (with_env_config(ReachEnv(SHORT, MOVING.env), other), ReachEnv(SHORT, other))
    )
    assert (own.damping, own.friction_n) == (1.2, 2.0) and own == expected


def test_members_whose_commands_wait_for_other_times_are_refused(tmp_path):
    members, varied = members_of(MOVING, (0,), ["env.randomisation.delay_max_s=0.0,0.05"])
    with pytest.raises(
        ConfigError, match="got delay_max_s 0, .* and delay_max_s 0.05, .* same control period"
    ):
        create(tmp_path / "sweep", members, varied, CalibratedArm(SHORT))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    "vary, message",
    [
        (
            ["learner.n_arms=64,128"],
            "--vary learner.n_arms=64,128: .*decides what is computed.*one of learner.learn",
        ),
        (["learner.gamma=0.5,1.5"], "learner.gamma: got 1.5"),
        (["learner.target_entropy=null"], "--vary learner.target_entropy: got None, expected numbers"),
        (["learner.gamma=0.5", "learner.gamma=0.6"], "got learner.gamma again"),
        (["learner.tau=0.1,0.10"], "--vary: got a value twice"),
    ],
)
def test_what_cannot_be_varied_is_refused_by_name(vary, message):
    with pytest.raises(ConfigError, match=message):
        members_of(PRESETS["quick"], (0,), vary)


def test_resume_goes_alone(capsys):
    assert main(["sweep", "--resume", "x", "--seeds", "1"]) == 2
    assert "--resume x: got --seeds too, expected none" in capsys.readouterr().err


def test_a_folder_that_is_no_sweep_is_named(tmp_path):
    with pytest.raises(RunError, match="sweep.json: got 'No such file.*expected the folder of a sweep"):
        open_sweep(tmp_path)
    (tmp_path / "sweep.json").write_text('{"members": 3}')
    with pytest.raises(RunError, match="sweep.json: got .*, expected the fields"):
        open_sweep(tmp_path)
