"""Sweeps: a member is the ordinary run, all are traced once, and a killed sweep ends with the same bits."""

import dataclasses
import json
from functools import partial
from operator import attrgetter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calib.arm import CalibratedArm
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import write_json
from mjx_softarm.env import EnvConfig, ReachEnv
from tests.arms import SHORT
from tests.train import small
from tests.train.small import new_job
from train.__main__ import main
from train.config import override
from train.epoch.job import Job
from train.presets import PRESETS
from train.runs.evaluate import Evaluator, Summary
from train.runs.folder import Checkpoints, Run
from train.sweep import RESULTS_FILE, MembersEpoch, members_of, open_members, report, variable

CONFIG = dataclasses.replace(
    small.CONFIG,
    evaluation_epochs=2,
    env=EnvConfig(engine="chain", n_poses=64),
    learner=dataclasses.replace(small.LEARNER, target_entropy=-9.0),
)
VARIABLE = variable(CONFIG)
# Each setting that may be varied, at another value; 0.2 for zero.
OTHER = [f"{name}={0.5 * (attrgetter(name)(CONFIG) or 0.4)}" for name in VARIABLE]
N_EPOCHS = 5
AT_REST = [field.name for field in dataclasses.fields(Summary) if field.default is dataclasses.MISSING]
pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def env():
    return ReachEnv(SHORT, CONFIG.env)


@pytest.fixture(scope="module")
def members():
    return {"first": CONFIG, "other": override(CONFIG, [*OTHER, "seed=3"])}


@pytest.fixture(scope="module")
def job(env):
    return Job(MembersEpoch(CONFIG, env))


@pytest.fixture(scope="module")
def given(members):
    """Keys and numbers of the members."""
    numbers = {name: jnp.asarray([attrgetter(name)(c) for c in members.values()]) for name in VARIABLE}
    return jnp.stack([jax.random.PRNGKey(config.seed) for config in members.values()]), numbers


@pytest.fixture(scope="module")
def trained(job, given):
    """States after some epochs, and the metrics of all of them."""
    states, metrics = job.init(given), []
    for _ in range(N_EPOCHS):
        states, row = job.epoch(states)
        metrics.append(jax.device_get(row))
    return states, metrics


def test_a_member_is_the_ordinary_run(members, trained):
    states, metrics = trained
    config, other_env = members["other"], ReachEnv(SHORT, members["other"].env)
    alone = new_job(config, other_env)
    state = alone.init(jax.random.PRNGKey(config.seed))
    for row in metrics:
        state, expected = alone.epoch(state)
        for name, value in expected.items():
            np.testing.assert_allclose(row[name][1], value, rtol=2e-4, atol=2e-5, err_msg=name)
    first, member = states.member(0), states.member(1)
    assert int(member.n_epochs) == N_EPOCHS and config.learner.n_updates(N_EPOCHS) > 0
    shape_of = lambda x: (x.shape, x.dtype)  # noqa: E731
    assert jax.tree.map(shape_of, member) == jax.tree.map(shape_of, state)
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4)  # noqa: E731
    jax.tree.map(close, member, state)
    with pytest.raises(AssertionError):  # the comparison can tell members apart
        jax.tree.map(close, first.learner, state.learner)


def test_a_sweep_is_traced_once_and_warms_up_without_updates(job, trained):
    states, metrics = trained
    assert job.n_traces == 1
    assert (metrics[0]["tqc/critic_loss"] == 0).all() and (metrics[1]["tqc/critic_loss"] > 0).all()
    # A branch on a number of each member would have become a select, with both of its sides computed.
    program = job._epoch.lower(states, job.env.pool).as_text()
    assert program.count("stablehlo.case") == 1


def dying(checkpoints, epoch, *rest, save=Checkpoints.save):
    """Save until the first member of seed 5 is to be saved after the sixth epoch."""
    if epoch == 6 and Run.open(checkpoints.run).config.seed == 5:
        raise KeyboardInterrupt
    save(checkpoints, epoch, *rest)


def test_a_stopped_sweep_ends_with_the_same_bits(tmp_path, monkeypatch, capsys):
    SHORT.to_toml(arm := tmp_path / "arm.toml")
    command = ["sweep", *small.flags(total_env_steps=128), "--evaluation-epochs=2", "--spec", str(arm)]
    command += ["--seeds=4,5", "--vary=learner.gamma=0.5"]
    paths = [tmp_path / name for name in ("whole", "stopped")]
    monkeypatch.setattr("train.runs.run.Evaluator", partial(Evaluator, n_goals=64))
    assert main([*command, "--out", str(paths[0])]) == 0
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", dying)
        assert main([*command, "--out", str(paths[1])]) == 130
    assert [run.checkpoints.epochs for run in open_members(paths[1])] == [[4, 6], [2, 4]]
    assert main(["sweep", "--resume", str(paths[1])]) == 0
    assert "continuing after epoch 4 of 8" in capsys.readouterr().out

    for one, other in zip(*map(open_members, paths), strict=True):
        assert one.config == other.config and one.evaluation() == other.evaluation()
        jax.tree.map(np.testing.assert_array_equal, one.checkpoints.parts(), other.checkpoints.parts())
        rows = [
            [{k: x for k, x in row.items() if "speed" not in k} for row in run.metrics()]
            for run in (one, other)
        ]
        assert rows[0] == rows[1] and [row["epoch"] for row in rows[0]] == list(range(1, 9))
        assert ["evaluation/median_mm" in row for row in rows[0]] == [False, True] * 4
    results = [json.loads((path / RESULTS_FILE).read_text())["groups"] for path in paths]
    assert results[0] == results[1] and [len(rows) for rows in results[0].values()] == [2]
    assert main([*command, "--out", str(paths[0])]) == 2
    assert "which exists, expected a new folder, or --resume" in capsys.readouterr().err


def test_members_are_the_product_of_seeds_and_values():
    """Values may have signs and exponents."""
    members = members_of(CONFIG, (0, 7), ["learner.target-entropy=-30, -2e1", "env.reward.goal-bonus=50"])
    found = {name: (c.seed, c.learner.target_entropy, c.env.reward.goal_bonus) for name, c in members.items()}
    assert found == {
        f"seed{seed}-learner.target_entropy={text}-env.reward.goal_bonus=50": (seed, float(text), 50.0)
        for seed in (0, 7)
        for text in ("-30", "-2e1")
    }


def test_the_table_has_mean_least_and_greatest_over_the_seeds(tmp_path):
    """Two seeds and two settings with figures made up; a member without figures is named."""
    for name, config in members_of(CONFIG, (0, 1), ["learner.gamma=0.5,0.9"]).items():
        Run.create(tmp_path / name, config, CalibratedArm(SHORT))
    runs = open_members(tmp_path)
    with pytest.raises(InputError, match="got no evaluation.json, expected a finished run"):
        report(tmp_path, runs)
    medians = {(0, 0.5): 2.0, (1, 0.5): 5.0, (0, 0.9): 6.0, (1, 0.9): 8.0}
    for run in runs:
        median_mm = medians[run.config.seed, run.config.learner.gamma]
        figures = dict.fromkeys(AT_REST, 0.0) | {"median_mm": median_mm, "reached_share": 0.25}
        write_json(run.path / "evaluation.json", figures)
    labels, *columns = report(tmp_path, runs).columns
    assert [each.header for each in columns] == ["learner.gamma=0.5", "learner.gamma=0.9"]
    shown = dict(zip(labels.cells, zip(*(column.cells for column in columns), strict=True), strict=True))
    assert shown["tip error, median mm"] == ("3.50 (2.00 to 5.00)", "7.00 (6.00 to 8.00)")
    assert shown["goals reached %"] == ("25.0 (25.0 to 25.0)",) * 2 and len(shown) == len(AT_REST)
    groups = json.loads((tmp_path / RESULTS_FILE).read_text())["groups"]
    assert [row["median_mm"] for row in groups["learner.gamma=0.9"]] == [6.0, 8.0]


@pytest.mark.parametrize(
    "vary, message",
    [
        (["learner.n_arms=64,128"], "--vary: got 'learner.n_arms=64,128', expected .* each of learner.learn"),
        (["learner.target_entropy=null"], "--vary learner.target_entropy: got None, expected numbers"),
        (["learner.gamma=0.5", "learner.gamma=0.6"], "got 'learner.gamma=0.6', expected .* once"),
    ],
)
def test_what_cannot_be_varied_is_refused_by_name(vary, message):
    with pytest.raises(InputError, match=message):
        members_of(PRESETS["quick"], (0,), vary)


def test_a_folder_that_is_no_sweep_is_named_and_resume_goes_alone(tmp_path, capsys):
    with pytest.raises(InputError, match="got no folder of a run in it, expected the folder of a sweep"):
        open_members(tmp_path)
    assert main(["sweep", "--resume", "x", "--seeds", "1"]) == 2
    assert "--resume x: got --seeds too, expected none" in capsys.readouterr().err
