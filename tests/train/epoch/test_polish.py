"""TQC, then polishing, as one run: handed over, resumed within either stage, evaluated apart, exported."""

import dataclasses
import io

import jax
import numpy as np
import pytest
from rich.console import Console

from mjx_softarm.env import EnvConfig, ReachEnv
from tests.train.small import CONFIG, SHORT
from train.config import ConfigError, TrainConfig
from train.runs.checkpoint import Run
from train.runs.evaluate import Evaluator
from train.runs.run import evaluation_after, restore_policy, train
from train.runs.task import task_of
from train.sweep.report import by_settings

POLISHED = dataclasses.replace(CONFIG, polish_updates=512)
N_TQC, N = POLISHED.n_own_epochs, POLISHED.n_epochs  # epochs

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def task():
    env = ReachEnv(SHORT, CONFIG.env)
    task = task_of(POLISHED, env)
    return task._replace(evaluate=Evaluator(env, task.job.learner, n_goals=32))


@pytest.fixture(scope="module")
def run(task, tmp_path_factory):
    run = Run.create(tmp_path_factory.mktemp("polished") / "run", POLISHED, SHORT)
    train(run, task, Console(file=io.StringIO()))
    return run


@pytest.fixture(scope="module")
def states(task):
    """State after each epoch, the first one included, as NumPy arrays."""
    state = task.job.init(jax.random.PRNGKey(POLISHED.seed))
    states = [jax.device_get(state)]
    for _ in range(N):
        state, _ = task.job.epoch(state)
        states.append(jax.device_get(state))
    return states


def same(one, other):
    return all(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(other)))


def test_polishing_begins_with_tqc_s_policy_and_keeps_its_critics(task, states):
    before, after, end = states[N_TQC - 1], states[N_TQC], states[N]
    assert N == N_TQC + 2
    assert same(task.job.policy(after), after.learner.tqc.mean_actor_params)
    assert not same(task.job.policy(after), task.job.policy(before))
    assert same(end.learner.tqc, after.learner.tqc) and not same(task.job.policy(end), task.job.policy(after))
    n_tqc_steps = N_TQC * CONFIG.n_arms * CONFIG.vector_steps_per_epoch
    assert int(after.n_env_steps) == n_tqc_steps
    assert int(end.n_env_steps) == n_tqc_steps + POLISHED.polish.total_env_steps
    assert int(end.n_updates) == int(after.n_updates) + POLISHED.polish_updates


@pytest.mark.parametrize("epoch", [N_TQC - 1, N_TQC, N_TQC + 1])
def test_a_run_goes_on_bit_for_bit_from_either_stage(task, states, tmp_path, epoch):
    run = Run.create(tmp_path / "run", POLISHED, SHORT)
    run.save(epoch, states[epoch])
    done, state = run.restore(task.job.like(epoch))
    for _ in range(done, N):
        state, _ = task.job.epoch(state)
    assert same(state, states[N])


def test_both_parts_are_told_apart_and_the_polished_policy_is_exported(task, run, states):
    rows = run.metrics()
    assert ["tqc/entropy" in row for row in rows] == [True] * N_TQC + [False] * 2
    assert rows[-1]["analytic/loss"] < rows[N_TQC]["analytic/loss"]
    assert rows[-1]["evaluation/median_mm"] < evaluation_after(run, N_TQC)["median_mm"]
    assert same(restore_policy(run, task)[1], task.job.policy(states[N]))
    [group] = by_settings([run], lambda run: {})
    for part, epoch in (("tqc_alone_over_seeds", N_TQC), ("over_seeds", N)):
        assert group[part]["median_mm"]["mean"] == evaluation_after(run, epoch)["median_mm"]


def test_another_run_may_begin_with_its_policy_and_critics(task, states):
    learner = task.job.learner
    begun = learner.adopt(learner.init(jax.random.PRNGKey(1)), states[N].learner.agent)
    assert same(learner.policy(begun), task.job.policy(states[N]))
    assert same(begun.critic_params, states[N].learner.tqc.critic_params)
    with pytest.raises(ValueError, match="got a policy without critics"):
        learner.adopt(begun, states[N].learner.analytic)


@pytest.mark.parametrize(
    "changes", [{"learner": "analytic"}, {"env": EnvConfig(mode="dynamic")}, {"polish_updates": -1}]
)
def test_polishing_is_refused_where_it_cannot_be(changes):
    with pytest.raises(ConfigError, match="polish_updates: got"):
        TrainConfig(**{"polish_updates": 512} | changes)
