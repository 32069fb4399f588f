"""Demonstrated goals: episodes, stages, balance, and a run that continues bit for bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.agent.imitation import Imitation
from train.epoch.devices import mesh_of
from train.epoch.goals import DemonstratedGoals, goal_weights
from train.epoch.job import Job

pytestmark = pytest.mark.usefixtures("quick_compiler")


def new_job(config, env, shown, mesh=None):
    goals = DemonstratedGoals(config.learner, env, shown)
    return Job(config.learner, env, Imitation(config.learner, env, shown), goals, mesh)


@pytest.fixture(scope="module")
def job(imitation_config, short_env, shown):
    return new_job(imitation_config, short_env, shown)


def run(job, state, first, last):
    """State and metrics after the epochs from `first` to before `last`."""
    metrics = {}
    for epoch in range(first, last):
        state, metrics = job.epoch(job.goals.begin_stage(job, state, epoch))
    return state, metrics


def indices(job, poses, off_mm=0.0):
    distance = np.linalg.norm(np.asarray(poses)[:, None] - np.asarray(job.goals.positions), axis=-1)
    assert np.all(distance.min(axis=1) <= off_mm)
    return distance.argmin(axis=1)


def continued_bit_for_bit(job):
    """Compare a run of six epochs with one that goes on after four; returns its state."""
    whole, metrics = run(job, job.init(jax.random.PRNGKey(2)), 0, 6)
    part, _ = run(job, job.init(jax.random.PRNGKey(2)), 0, 4)
    part = jax.tree.map(jnp.asarray, jax.device_get(part))
    resumed, _ = run(job, part, 4, 6)
    assert job.n_traces == 1 and all(np.isfinite(value) for value in metrics.values())
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(whole), jax.device_get(resumed))
    return whole


def test_an_episode_goes_from_one_demonstrated_position_to_another(job):
    state = job.init(jax.random.PRNGKey(0))
    arm = state.arms.pipeline_state
    assert len(set(indices(job, arm.pose))) > 1
    assert set(indices(job, arm.goal)) <= {0, 2, 4}  # the first stage has every second position
    np.testing.assert_allclose(state.arms.obs, job.env.observe(arm.pose, arm.goal), atol=1e-6)


def test_stages_change_the_goals_and_thin_the_replay(job):
    state, _ = run(job, job.init(jax.random.PRNGKey(0)), 0, 4)
    n = int(state.memory.size)
    assert n == 64 and set(indices(job, state.memory.data.goal)) <= {0, 2, 4}
    later = job.goals.begin_stage(job, jax.tree.map(jnp.copy, state), 4)
    assert int(later.memory.size) == n // 4 and np.all(later.goals == 1.0)
    state, _ = run(job, state, 4, 8)
    assert {1, 3, 5} & set(indices(job, state.memory.data.goal))


def test_a_run_is_traced_once_and_continues_bit_for_bit_across_a_stage(job):
    continued_bit_for_bit(job)


@pytest.mark.slow  # test_devices.py asks it of `reach`
def test_many_devices_learn_as_one_does_across_a_stage_and_a_balance(imitation_config, short_env, shown, job):
    spread = new_job(imitation_config, short_env, shown, mesh_of("8"))
    figures = []
    for each in (job, spread):
        state = each.init(jax.random.PRNGKey(5))
        for epoch in range(6):
            state = each.goals.begin_stage(each, state, epoch)
            if epoch == 5:
                state = each.goals.rebalance(state, epoch, np.arange(6.0))
            state, metrics = each.epoch(each.place(state))
        figures.append((jax.device_get(metrics), jax.device_get(each.policy(state))))
    assert spread.n_traces == 1
    for one, many in zip(*map(jax.tree.leaves, figures), strict=True):
        np.testing.assert_allclose(many, one, rtol=1e-3, atol=1e-4)


def test_goals_shift_to_the_positions_that_are_missed_by_most():
    weight = goal_weights(np.array([1.0, 9.0, 3.0, 0.0]), np.array([True, False, True, True]))
    np.testing.assert_allclose(weight, [1 / 6 + 1 / 8, 0.0, 1 / 6 + 3 / 8, 1 / 6])
    even = goal_weights(np.zeros(4), np.array([True, False, True, True]))
    np.testing.assert_allclose(even, [1 / 3, 0.0, 1 / 3, 1 / 3])


def test_rebalanced_goals_are_drawn_by_their_weights(job):
    state = job.goals.rebalance(job.init(jax.random.PRNGKey(0)), 4, np.array([0.0, 0, 0, 0, 0, 10.0]))
    arms = jax.jit(jax.vmap(lambda key: job.goals.begin(state.goals, state.arms, key)))
    goals = arms(jax.random.split(jax.random.PRNGKey(5), 500)).pipeline_state.goal.reshape(-1, 6)
    share = np.mean(indices(job, goals) == 5)
    assert abs(share - (0.5 / 6 + 0.5)) < 4 * np.sqrt(0.25 / len(goals))
