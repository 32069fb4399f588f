"""Hindsight for Stable-Baselines3: what follows from an exchanged goal is what the environment would say."""

import numpy as np
import pytest

from mjx_softarm.env import EnvConfig
from mjx_softarm.env.gym import SoftArmVectorEnv, as_sb3
from train.agent.hindsight import HindsightConfig

pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
N_ARMS, LIMIT, N_STEPS, N_ROWS = 6, 3, 20, 8  # the ring is written over, and episodes cross its end
SHARE, REWARD_SCALE = 0.75, 0.1


class Played:
    """Arms, a buffer of what they did, and of each row of it whether it saturated.

    Half of the arms saturate most of the time; the first one goes to its goal at each step.
    """

    def __init__(self):
        from benchmarks.race.hindsight import GoalEnvs, HindsightBuffer

        arms = SoftArmVectorEnv(N_ARMS, max_episode_steps=LIMIT, config=EnvConfig(n_poses=64))
        self.arm = arms.env
        envs = GoalEnvs(as_sb3(arms), REWARD_SCALE)
        self.buffer = HindsightBuffer(
            N_ROWS * N_ARMS,
            envs.observation_space,
            envs.action_space,
            env=envs,
            n_envs=N_ARMS,
            arm=arms.env,
            hindsight=HindsightConfig(reached_share=SHARE),
            reward_scale=REWARD_SCALE,
            seed=0,
        )
        self.saturated = np.zeros((N_ROWS, N_ARMS), bool)
        envs.seed(0)
        seen, rng = envs.reset(), np.random.default_rng(0)
        still = np.asarray(self.arm.action_of(np.full(9, 0.17, np.float32)))
        spread = np.where(np.arange(N_ARMS) % 2, 0.5, 0.02)[:, None]
        for step in range(N_STEPS):
            for name, parts in seen.items():
                assert all(part in envs.observation_space[name] for part in parts)
            actions = np.clip(still + spread * rng.uniform(-1, 1, (N_ARMS, 9)), -1, 1).astype(np.float32)
            actions[0] = self.to_goal(seen["desired_goal"][0])
            following, reward, done, infos = envs.step(actions)
            self.saturated[step % N_ROWS] = arms._state.metrics["saturated_chambers"] > 0
            after = {name: values.copy() for name, values in following.items()}
            for arm in np.flatnonzero(done):
                for name, last in infos[arm]["terminal_observation"].items():
                    after[name][arm] = last
            self.buffer.add(seen, after, actions, reward, done, infos)
            seen = following

    def to_goal(self, scaled):
        """The action that leads to a goal, which is a pose of the pool."""
        goal = scaled * self.arm.scale.scale + self.arm.scale.centre
        row = np.argmin(np.linalg.norm(np.asarray(self.arm.pool.pose) - goal, axis=1))
        return np.asarray(self.arm.action_of(self.arm.pool.spring_m[row]))

    @property
    def where(self):
        """Indices of the transitions whose episodes are over."""
        return np.nonzero(self.buffer.ep_length > 0)


@pytest.fixture(scope="module")
def played():
    return Played()


def test_goals_of_their_own_would_have_given_what_the_environment_gave(played, monkeypatch):
    buffer, where = played.buffer, played.where
    monkeypatch.setattr(buffer, "_sample_goals", lambda *where: buffer.observations["desired_goal"][where])
    exchanged, stored = buffer._get_virtual_samples(*where), buffer._get_real_samples(*where)
    for name in exchanged.observations:
        np.testing.assert_allclose(exchanged.observations[name], stored.observations[name], atol=1e-5)
        np.testing.assert_allclose(
            exchanged.next_observations[name], stored.next_observations[name], atol=1e-5
        )
    np.testing.assert_allclose(exchanged.rewards, stored.rewards, atol=1e-4)
    np.testing.assert_array_equal(exchanged.dones, stored.dones)
    np.testing.assert_array_equal(exchanged.actions, stored.actions)
    np.testing.assert_array_equal(np.isclose(stored.rewards[:, 0], -10.0), played.saturated[where])
    assert 0.1 < played.saturated[where].mean() < 0.9
    assert 0.1 < stored.dones.numpy().mean() < 0.9
