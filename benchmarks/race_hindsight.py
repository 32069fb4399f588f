"""Hindsight for the peers: the arms as they want them, and their own replay of hindsight on it.

Stable-Baselines3's `HerReplayBuffer` wants observations as a dictionary, and chooses which transitions get
a goal that was reached later in their episode. What such a goal means it leaves to its user, or leaves as it
was; here all that follows from a goal is told anew: the error in the observation, the reward, and whether the
episode ended there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import HerReplayBuffer  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.buffers import (  # pyright: ignore[reportMissingImports]
    DictReplayBufferSamples,
)
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper  # pyright: ignore[reportMissingImports]

from mjx_softarm import rewards
from mjx_softarm.env import ReachEnv
from mjx_softarm.obs import ObsScale
from train.config import TrainConfig

PARTS = {"achieved_goal": slice(0, 6), "desired_goal": slice(6, 12), "observation": slice(12, 18)}


def with_goals(obs: np.ndarray) -> dict[str, np.ndarray]:
    """Observations (..., 18) as a dictionary: scaled pose, scaled goal, and scaled error, (..., 6) each."""
    return {name: obs[..., part] for name, part in PARTS.items()}


def hindsight_settings(env: ReachEnv, config: TrainConfig) -> dict[str, Any]:
    """Of a peer's algorithm, so that as large a share of a batch gets other goals as with this config."""
    share = config.hindsight.reached_share + config.hindsight.near_share
    buffer_settings = {
        "n_sampled_goal": share / (1 - share),
        "scale": env.scale,
        "config": env.config.reward,
        "reward_scale": config.tqc.reward_scale,
    }
    return {"replay_buffer_class": HindsightBuffer, "replay_buffer_kwargs": buffer_settings}


class GoalEnvs(VecEnvWrapper):
    """A vector environment of arms whose observations are dictionaries."""

    def __init__(self, venv: VecEnv):
        flat = venv.observation_space
        boxes = {name: gymnasium.spaces.Box(flat.low[part], flat.high[part]) for name, part in PARTS.items()}
        super().__init__(venv, gymnasium.spaces.Dict(boxes))

    def reset(self) -> dict[str, np.ndarray]:
        """Observations of all arms."""
        return with_goals(self.venv.reset())

    def step_wait(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """As that of the environment within, the last observation of an episode a dictionary, too."""
        obs, reward, done, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = with_goals(info["terminal_observation"])
        return with_goals(obs), reward, done, infos


class HindsightBuffer(HerReplayBuffer):
    """`HerReplayBuffer` for arms.

    Args:
        scale: of poses in observations.
        config: of the reward.
        reward_scale: on every reward that is stored.
        settings: those of `HerReplayBuffer`.
    """

    def __init__(
        self,
        *positional: Any,
        scale: ObsScale,
        config: rewards.RewardConfig,
        reward_scale: float,
        **settings: Any,
    ):
        super().__init__(*positional, **settings)
        self._scale, self._config, self._reward_scale = scale, config, reward_scale

    def _get_virtual_samples(
        self, batch_indices: np.ndarray, env_indices: np.ndarray, env: Any = None
    ) -> DictReplayBufferSamples:
        """Transitions whose goals were reached later."""
        where = batch_indices, env_indices
        goals = self._sample_goals(*where)
        before, after = (
            self._seen(poses["achieved_goal"][where], goals)
            for poses in (self.observations, self.next_observations)
        )
        cost = self._reward_scale * self._config.saturation_cost
        reward, reached, _ = rewards.reward(
            self._pose(self.next_observations["achieved_goal"][where]),
            self._pose(goals),
            n_steps=(batch_indices - self.ep_start[where]) % self.buffer_size + 1,
            saturated=np.isclose(self.rewards[where], -cost),
            config=self._config,
        )
        return DictReplayBufferSamples(
            observations=self._tensors(before),
            actions=self.to_torch(self.actions[where]),
            next_observations=self._tensors(after),
            dones=self.to_torch(reached[:, None].astype(np.float32)),
            rewards=self.to_torch((self._reward_scale * reward[:, None]).astype(np.float32)),
        )

    def _seen(self, poses: np.ndarray, goals: np.ndarray) -> dict[str, np.ndarray]:
        """Observation of scaled poses and goals (n, 6)."""
        error = rewards.scaled_error(self._pose(poses), self._pose(goals), self._config)
        return {"achieved_goal": poses, "desired_goal": goals, "observation": error.astype(np.float32)}

    def _pose(self, scaled: np.ndarray) -> np.ndarray:
        return scaled * self._scale.scale + self._scale.centre

    def _tensors(self, observations: Mapping[str, np.ndarray]) -> dict[str, Any]:
        return {name: self.to_torch(value) for name, value in observations.items()}
