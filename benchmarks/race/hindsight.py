"""Hindsight for the peers: the arms in the form they need, and their own hindsight replay on it.

Beside the reward, the observed error and the termination are recomputed, and as many goals as in ours are
near the pose reached. Actions are not exchanged: a saturated transition costs as much with its new goal.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3 import HerReplayBuffer  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.buffers import (  # pyright: ignore[reportMissingImports]
    DictReplayBufferSamples,
)
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper  # pyright: ignore[reportMissingImports]

from mjx_softarm.env import ReachEnv
from mjx_softarm.mdp import observation as obs
from mjx_softarm.mdp import rewards
from train.agent.hindsight import HindsightConfig, near_offsets

SLICES = {"achieved_goal": slice(0, 6), "desired_goal": slice(6, 12), "observation": slice(12, 18)}


def with_goals(flat: np.ndarray) -> dict[str, np.ndarray]:
    """Return observations (..., 18) as a dictionary: scaled pose, goal and error, (..., 6) each."""
    return {name: flat[..., part] for name, part in SLICES.items()}


class GoalEnvs(VecEnvWrapper):
    """A vector environment of arms whose observations are dictionaries, with its rewards times a factor."""

    def __init__(self, venv: VecEnv, reward_scale: float):
        self._reward_scale, flat = reward_scale, venv.observation_space
        boxes = [
            (name, gymnasium.spaces.Box(flat.low[part], flat.high[part])) for name, part in SLICES.items()
        ]
        super().__init__(venv, gymnasium.spaces.Dict(boxes))

    def reset(self) -> dict[str, np.ndarray]:
        """Reset all arms; returns their observations."""
        return with_goals(self.venv.reset())

    def step_wait(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step the inner environment; terminal observations become dictionaries, too."""
        flat, reward, done, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = with_goals(info["terminal_observation"])
        return with_goals(flat), self._reward_scale * reward, done, infos


class HindsightBuffer(HerReplayBuffer):
    """`HerReplayBuffer` for arms at rest after each action, away from walls.

    `hindsight` has the shares of a batch that get another goal: reached later, or near the pose reached.
    """

    def __init__(
        self,
        *positional: Any,
        arm: ReachEnv,
        hindsight: HindsightConfig,
        reward_scale: float,
        seed: int,
        **settings: Any,
    ):
        super().__init__(*positional, **settings)
        self.her_ratio = hindsight.reached_share + hindsight.near_share
        self._hindsight, self._rng = hindsight, np.random.default_rng(seed)
        self._scale, self._config, self._reward_scale = arm.scale, arm.config.reward, reward_scale

    def sample(self, batch_size: int, env: Any = None) -> DictReplayBufferSamples:
        """Sample transitions in random order: SBX cuts one sample into several batches."""
        drawn, order = super().sample(batch_size, env), torch.randperm(batch_size)
        return jax.tree.map(lambda part: part[order], drawn)

    def _get_virtual_samples(
        self, batch_indices: np.ndarray, env_indices: np.ndarray, env: Any = None
    ) -> DictReplayBufferSamples:
        """Return transitions with goals that were reached later, or near the pose reached."""
        where = batch_indices, env_indices
        reached = (poses["achieved_goal"][where] for poses in (self.observations, self.next_observations))
        scaled = (*reached, self._sample_goals(*where))
        before, after, goals = (poses * self._scale.scale + self._scale.centre for poses in scaled)
        draws = self._rng.random((2, len(after)), np.float32)
        near = draws[0] < self._hindsight.near_share / self.her_ratio
        direction = self._rng.standard_normal((len(after), 6), np.float32)
        offsets = near_offsets(jnp.asarray(draws[1]), jnp.asarray(direction))
        goals = np.where(near[:, None], after + np.asarray(offsets), goals)
        n_steps = (batch_indices - self.ep_start[where]) % self.buffer_size + 1
        saturated = self._saturated(after, n_steps, where)
        reward, reached, _ = rewards.reward(after, goals, n_steps, saturated, self._config)
        return DictReplayBufferSamples(
            observations=self._observed(before, goals),
            actions=self.to_torch(self.actions[where]),
            next_observations=self._observed(after, goals),
            dones=self.to_torch(reached[:, None].astype(np.float32)),
            rewards=self.to_torch((self._reward_scale * reward[:, None]).astype(np.float32)),
        )

    def _saturated(self, after: np.ndarray, n_steps: np.ndarray, where: Any) -> np.ndarray:
        """Return whether transitions saturated (n,): which of two rewards for their own goals was stored."""
        own = self.observations["desired_goal"][where] * self._scale.scale + self._scale.centre
        either = (np.full(len(after), saturated) for saturated in (True, False))
        yes, no = (rewards.reward(after, own, n_steps, x, self._config)[0] for x in either)
        stored = self.rewards[where] / self._reward_scale
        return np.abs(stored - yes) < np.abs(stored - no)

    def _observed(self, poses: np.ndarray, goals: np.ndarray) -> dict[str, Any]:
        flat = obs.observe(poses, goals, self._scale, self._config)
        return {name: self.to_torch(part) for name, part in with_goals(flat).items()}
