"""Hindsight for Stable-Baselines3: what follows from an exchanged goal is what the environment would say."""

import numpy as np
import pytest

from mjx_softarm import rewards
from mjx_softarm.env import EnvConfig
from mjx_softarm.gym import SoftArmVectorEnv, as_sb3
from train.config import PRESETS

pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
N_ARMS, LIMIT, N_STEPS = 6, 3, 20


@pytest.fixture(scope="module")
def played():
    """Arms, and a buffer of what they did at random, where half of them saturate most of the time."""
    from benchmarks.race_contestants import scaled
    from benchmarks.race_hindsight import GoalEnvs, hindsight_settings

    config = PRESETS["quick"]
    arms = SoftArmVectorEnv(N_ARMS, max_episode_steps=LIMIT, config=EnvConfig(n_poses=64))
    envs = GoalEnvs(scaled(as_sb3(arms), config.tqc.reward_scale))
    settings = hindsight_settings(arms.env, config)
    buffer = settings["replay_buffer_class"](
        N_STEPS * N_ARMS,
        envs.observation_space,
        envs.action_space,
        env=envs,
        n_envs=N_ARMS,
        **settings["replay_buffer_kwargs"],
    )
    envs.seed(0)
    still = np.asarray(arms.env.action_of(np.full(9, 0.17, np.float32)))
    spread = np.where(np.arange(N_ARMS) % 2, 0.5, 0.02)[:, None]
    obs, rng = envs.reset(), np.random.default_rng(0)
    for _ in range(N_STEPS):
        assert all(part in envs.observation_space[name] for name, all_ in obs.items() for part in all_)
        actions = np.clip(still + spread * rng.uniform(-1, 1, (N_ARMS, 9)), -1, 1).astype(np.float32)
        following, reward, done, infos = envs.step(actions)
        after = {name: values.copy() for name, values in following.items()}
        for arm in np.flatnonzero(done):
            for name, last in infos[arm]["terminal_observation"].items():
                after[name][arm] = last
        buffer.add(obs, after, actions, reward, done, infos)
        obs = following
    return arms.env, buffer


def every_transition(buffer):
    """Indices of those whose episodes are over."""
    return np.nonzero(buffer.ep_length > 0)


def test_a_batch_has_as_large_a_share_of_other_goals_as_ours(played):
    _, buffer = played
    assert buffer.her_ratio == pytest.approx(0.75)
    batch = buffer.sample(64)
    assert {name: tuple(part.shape) for name, part in batch.observations.items()} == {
        "achieved_goal": (64, 6),
        "desired_goal": (64, 6),
        "observation": (64, 6),
    }


def test_goals_of_their_own_would_have_given_what_the_environment_gave(played, monkeypatch):
    _, buffer = played
    where = every_transition(buffer)
    monkeypatch.setattr(buffer, "_sample_goals", lambda *where: buffer.observations["desired_goal"][where])
    told, own = buffer._get_virtual_samples(*where), buffer._get_real_samples(*where)
    for name in told.observations:
        np.testing.assert_allclose(told.observations[name], own.observations[name], atol=1e-5)
        np.testing.assert_allclose(told.next_observations[name], own.next_observations[name], atol=1e-5)
    assert 0.1 < np.isclose(own.rewards.numpy(), -10.0).mean() < 0.9
    np.testing.assert_allclose(told.rewards, own.rewards, atol=1e-4)
    np.testing.assert_array_equal(told.dones, own.dones)
    np.testing.assert_array_equal(told.actions, own.actions)


def test_a_goal_that_was_reached_ends_the_episode_with_the_bonus_unless_it_saturated(played, monkeypatch):
    env, buffer = played
    where = every_transition(buffer)
    reached = buffer.next_observations["achieved_goal"]
    monkeypatch.setattr(buffer, "_sample_goals", lambda *where: reached[where])
    batch, own = buffer._get_virtual_samples(*where), buffer._get_real_samples(*where)
    saturated = np.isclose(own.rewards.numpy(), -10.0)
    np.testing.assert_allclose(batch.rewards, np.where(saturated, -10.0, 10.0), rtol=1e-6)
    np.testing.assert_array_equal(batch.dones, ~saturated)
    np.testing.assert_allclose(batch.next_observations["observation"], 0.0, atol=1e-6)
    pose, goal = (
        batch.observations[name].numpy() * env.scale.scale + env.scale.centre
        for name in ("achieved_goal", "desired_goal")
    )
    error = rewards.scaled_error(pose, goal, env.config.reward)
    np.testing.assert_allclose(batch.observations["observation"], error, atol=1e-5)
