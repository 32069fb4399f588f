"""Demonstrated goals: episodes, stages, balance, and a run that continues bit for bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.agent.imitation import goal_weights
from train.epoch.job import Job

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def epoch(imitation_config, short_env, shown):
    return imitation_config.learner.make_epoch(short_env, shown)


@pytest.fixture(scope="module")
def job(epoch):
    return Job(epoch)


@pytest.fixture(scope="module")
def goals(epoch):
    return epoch.goals


@pytest.fixture(scope="module")
def run(job, goals):
    """State, first epoch, epoch after the last -> the state and the metrics after them."""

    def train(state, first, last):
        metrics = {}
        for k in range(first, last):
            state, metrics = job.epoch(goals.prepare(state, k, lambda: np.ones(6)))
        return state, metrics

    return train


def indices(goals, poses, off_mm=0.0):
    distance = np.linalg.norm(np.asarray(poses)[:, None] - np.asarray(goals.positions), axis=-1)
    assert np.all(distance.min(axis=1) <= off_mm)
    return distance.argmin(axis=1)


def test_an_episode_goes_from_one_demonstrated_position_to_another(job, goals):
    state = job.init(jax.random.PRNGKey(0))
    arm = state.arms.pipeline_state
    assert len(set(indices(goals, arm.pose))) > 1
    assert set(indices(goals, arm.goal)) <= {0, 2, 4}  # the first stage has every second position
    np.testing.assert_allclose(state.arms.obs, job.env.observe(arm.pose, arm.goal), atol=1e-6)


def test_stages_change_the_goals_and_thin_the_replay(job, goals, run):
    state, _ = run(job.init(jax.random.PRNGKey(0)), 0, 4)
    n = int(state.memory.size)
    assert n == 64 and set(indices(goals, state.memory.data.goal)) <= {0, 2, 4}
    later = goals.prepare(jax.tree.map(jnp.copy, state), 4, lambda: np.ones(6))
    assert int(later.memory.size) == n // 4 and np.all(later.goals == 1.0)
    state, _ = run(state, 4, 8)
    assert {1, 3, 5} & set(indices(goals, state.memory.data.goal))


def test_a_run_is_traced_once_and_continues_bit_for_bit_across_a_stage(job, run):
    whole, metrics = run(job.init(jax.random.PRNGKey(2)), 0, 6)
    part, _ = run(job.init(jax.random.PRNGKey(2)), 0, 4)
    part = jax.tree.map(jnp.asarray, jax.device_get(part))
    resumed, _ = run(part, 4, 6)
    assert job.n_traces == 1 and all(np.isfinite(value) for value in metrics.values())
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(whole), jax.device_get(resumed))


def test_goals_shift_to_the_positions_that_are_missed_by_most():
    weight = goal_weights(np.array([1.0, 9.0, 3.0, 0.0]), np.array([True, False, True, True]))
    np.testing.assert_allclose(weight, [1 / 6 + 1 / 8, 0.0, 1 / 6 + 3 / 8, 1 / 6])
    even = goal_weights(np.zeros(4), np.array([True, False, True, True]))
    np.testing.assert_allclose(even, [1 / 3, 0.0, 1 / 3, 1 / 3])


def test_rebalanced_goals_are_drawn_by_their_weights(job, goals):
    errors_mm = np.array([0.0, 0, 0, 0, 0, 10.0])
    state = goals.prepare(job.init(jax.random.PRNGKey(0)), 6, lambda: errors_mm)  # every third epoch
    arms = jax.jit(jax.vmap(lambda key: goals.begin(state.goals, state.arms, key)))
    drawn = arms(jax.random.split(jax.random.PRNGKey(5), 500)).pipeline_state.goal.reshape(-1, 6)
    share = np.mean(indices(goals, drawn) == 5)
    assert abs(share - (0.5 / 6 + 0.5)) < 4 * np.sqrt(0.25 / len(drawn))
