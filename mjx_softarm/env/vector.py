"""Many arms at once, with a time limit and automatic resets."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm.env import ReachEnv
from mjx_softarm.env.state import State


def choose_arms(chosen: Array, yes: Any, no: Any) -> Any:
    """Return a tree of arrays (n, ...): rows of one tree where arms are chosen (n,), else of another."""
    return jax.tree.map(lambda x, y: jnp.where(chosen.reshape((-1,) + (1,) * (x.ndim - 1)), x, y), yes, no)


class VectorEnv:
    """Independent arms; an arm whose episode ended starts a new one, with a new goal."""

    def __init__(self, env: ReachEnv, n: int, episode_length: int):
        self.env, self.n, self.episode_length = env, n, episode_length

    def reset(self, key: Array) -> State:
        """Start an episode with each of the n arms."""
        return jax.vmap(self.env.reset_from)(self.env.sample_noise(key, self.n))

    def step(self, state: State, action: Array, key: Array) -> tuple[State, State, Array, Array]:
        """Act once.

        Args:
            state: of n arms.
            action (n, action_size): in [-1, 1].
            key: for the new episodes.

        Returns:
            The state to act on next, reset where an episode ended; the state that the action led to;
            terminated (n,): goal reached, so that the value after it is zero; truncated (n,): time limit
            reached, so that the value after it is that of the state that the action led to.
        """
        # Act, and see whose episode is over
        after = jax.vmap(self.env.step)(state, action)
        valid = after.info["valid"]
        terminated = (after.done > 0) & valid
        truncated = (after.pipeline_state.n_steps >= self.episode_length) & ~terminated
        over = terminated | truncated | ~valid

        # New episodes where the last one is over; metrics are always those of the action
        following = choose_arms(over, self.reset(key), after).replace(metrics=after.metrics)
        return following, after, terminated, truncated
