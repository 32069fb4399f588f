"""The training epoch: traced once, bad arms kept out, checkpoints of other runs refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.mdp.rewards import RewardConfig
from tests.arms import SHORT
from tests.train.small import CONFIG, new_job
from train.runs import run

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def job():
    return new_job(CONFIG, ReachEnv(SHORT, CONFIG.env))


def start(job):
    return job.init(jax.random.PRNGKey(0))


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


MOVING = {
    "engine": "mjx",
    "mode": "dynamic",
    "observation": "motion",
    "dynamic_step_s": 0.04,
    "goal_ends": False,
    "reward": RewardConfig(threshold=9.0),
}


@pytest.mark.parametrize("change", [{}, {"engine": "mjx"}, MOVING], ids=["chain", "mjx", "dynamic"])
def test_every_engine_traces_its_epoch_once_and_counts_what_it_did(job, change):
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, **change))
    if config.env.in_motion:
        # Goals that the episode reached later, and critics that observe a prediction.
        hindsight = dataclasses.replace(config.learner.hindsight, n_later=2)
        learner = dataclasses.replace(config.learner, hindsight=hindsight, n_ahead=2)
        config = dataclasses.replace(config, learner=learner)
    if change:
        job = new_job(config, ReachEnv(SHORT, config.env))
    state, ended = start(job), np.zeros((4, 2))
    for k in range(4):
        state, metrics = job.epoch(state)
        ended[k] = metrics["env/episodes"], metrics["env/successes"]
    assert job.n_traces == 1 and int(state.n_epochs) == 4
    # Episodes end at their goals, or after four actions. In motion these are near enough without saturation.
    if config.env.in_motion:
        assert metrics["tqc/prediction_loss"] > 0.0
        np.testing.assert_array_equal(ended[:, 0], [0, 8, 0, 8])
        last = np.asarray(state.memory.data.n_steps) == 4
        assert ended[:, 1].sum() == np.count_nonzero(last & ~np.asarray(state.memory.data.saturated))
    else:
        assert ended[:, 0].sum() >= 8 and np.all(ended[:, 1] <= ended[:, 0])
    assert 50 < int(state.memory.size) <= CONFIG.learner.n_env_steps(4) == 4 * 2 * 8
    # Warm-up lasts until 16 steps are stored: the update after the third vector step is the first.
    assert CONFIG.learner.n_updates(4) == 4 * (4 * 2 - 2)
    assert int(state.learner.actor_opt_state[0].count) == 4 * (4 * 2 - 2)
    assert all(np.isfinite(value) for value in metrics.values())


def test_a_start_compiles_the_epoch_once_beside_what_comes_first(job):
    other = new_job(CONFIG, job.env)
    state = other.start(lambda: start(other))
    assert other.n_traces == 1  # before it is called
    assert_equal(state, start(job))
    expected = start(job)
    for _ in range(2):
        (state, _), (expected, _) = other.epoch(state), job.epoch(expected)
    assert_equal(state, expected)
    assert other.n_traces == 1


def test_warm_up_explores_uniformly_and_does_not_learn(job):
    state, metrics = job.epoch(start(job))
    assert CONFIG.learner.n_updates(1) == 0 and metrics["tqc/critic_loss"] == 0.0
    action = np.asarray(state.memory.data.action)[:16]
    assert np.abs(action).max() > 0.9 and abs(action.mean()) < 0.15


@pytest.mark.parametrize("n_epochs", [1, 2**31 - 1])
def test_after_warm_up_it_learns_however_long_it_has_run(job, n_epochs):
    state, metrics = job.epoch(start(job)._replace(n_epochs=jnp.asarray(n_epochs, jnp.int32)))
    assert metrics["tqc/critic_loss"] > 0.0
    assert int(state.learner.actor_opt_state[0].count) == 2 * 4


def test_an_arm_that_does_not_settle_is_reset_counted_and_never_stored(job):
    state = start(job)
    arm = state.arms.pipeline_state
    poisoned = arm.chamber_stiffness.at[jnp.array([1, 5])].set(jnp.nan)
    arms = state.arms.replace(pipeline_state=arm._replace(chamber_stiffness=poisoned))
    state, metrics = job.epoch(state._replace(arms=arms))
    assert metrics["env/unsettled"] == 2
    assert int(state.memory.size) == 2 * 8 - 2
    jax.tree.map(
        lambda x: np.testing.assert_array_equal(np.isfinite(x), True), jax.device_get(state.memory.data)
    )
    assert np.isfinite(state.arms.pipeline_state.chamber_stiffness).all()


@pytest.fixture(scope="module")
def pools():
    """Settings -> pools of a run, each for two of its epochs by default."""
    env = ReachEnv(SHORT, EnvConfig(n_poses=32, even_share=0.5))
    config = lambda every, seed: dataclasses.replace(CONFIG, fresh_poses_epochs=every, seed=seed)  # noqa: E731
    return lambda every=2, seed=0: run.FreshPoses(env, config(every, seed))


def test_a_pool_serves_some_epochs_and_each_run_has_its_own(pools):
    pool_of = pools()
    poses = [np.asarray(pool_of(epoch).pose) for epoch in range(6)]
    for epoch, pose in enumerate(poses):
        assert np.array_equal(pose, poses[epoch // 2 * 2]) and pose.shape == (32, 6)
    every = np.concatenate([*poses[::2], pools(seed=1)(0).pose])
    assert len(np.unique(every[:, 0].round(3))) > 3 * 32  # a pool may have a pose twice
    np.testing.assert_array_equal(poses[4], pools()(4).pose)  # of a run that goes on
    lasting = pools(every=0)
    assert lasting(0) is lasting(5)


def test_success_is_of_episodes_or_of_single_actions():
    episodes = {"env/episodes": 8.0, "env/successes": 6.0}
    for row, text in ((episodes, "exploring: success 75 % of episodes"), ({}, "success 50 % of actions")):
        assert run._success([row | {"env/reached": 0.5}] * 2) == text


def test_an_epoch_in_which_most_arms_in_motion_diverge_ends_the_run_and_names_the_step():
    moving = dataclasses.replace(CONFIG, env=EnvConfig(mode="dynamic", simulation_step_s=0.02))
    run.refuse_divergence(moving, 8.0)
    run.refuse_divergence(CONFIG, 16.0)  # at rest
    message = rf"env\.simulation_step_s: got 0\.02, with which 9 of {moving.learner.n_env_steps(1)}"
    with pytest.raises(InputError, match=message):
        run.refuse_divergence(moving, 9.0)
