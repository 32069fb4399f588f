"""Many arms at once, with a time limit and automatic resets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from mjx_softarm._support import draws
from mjx_softarm.env import ReachEnv
from mjx_softarm.env.state import State


def over_arms(function: Callable, mesh: Mesh | None = None, n_shared: int = 0) -> Callable:
    """Return a function of one arm as a function of many arms, which have the first axis.

    All arms share the last `n_shared` arguments. With a mesh, each device takes an equal share of the arms,
    and does not wait for the slowest arm of another device.
    """

    def of_all(*arguments: Any) -> Any:
        n_own = len(arguments) - n_shared
        all_arms = jax.vmap(function, in_axes=(0,) * n_own + (None,) * n_shared)
        if mesh is None:
            return all_arms(*arguments)
        per_arm, shared = PartitionSpec(mesh.axis_names), PartitionSpec()
        specs = (per_arm,) * n_own + (shared,) * n_shared
        return jax.shard_map(all_arms, mesh=mesh, in_specs=specs, out_specs=per_arm, check_vma=False)(
            *arguments
        )

    return of_all


def choose_arms(chosen: Array, yes: Any, no: Any) -> Any:
    """Return a tree of arrays (n, ...): rows of one tree where arms are chosen (n,), else of another."""
    return jax.tree.map(lambda x, y: jnp.where(chosen.reshape((-1,) + (1,) * (x.ndim - 1)), x, y), yes, no)


class Outcome(NamedTuple):
    """Outcome of one action of each arm, before any reset."""

    final_obs: Array  # (n, obs_size) the successor's observation, also where the episode ended
    reward: Array  # (n,)
    terminated: Array  # (n,) bool: goal reached; the value after it is zero
    truncated: Array  # (n,) bool: time limit reached; the value after it is that of `final_obs`
    valid: Array  # (n,) bool: the simulation succeeded; else the step must not be learned from


class VectorEnv:
    """Independent arms; an arm whose episode ended starts a new one, with a new goal.

    With a mesh of devices, each steps its share of the arms; see `over_arms`.
    """

    def __init__(self, env: ReachEnv, n: int, episode_length: int, mesh: Mesh | None = None):
        self.env, self.n, self.episode_length, self.mesh = env, n, episode_length, mesh

    def reset(self, key: Array) -> State:
        """Start an episode with each of the n arms."""
        with draws.on(self.mesh):
            noise = self.env.sample_noise(key, self.n)
        return over_arms(self.env.reset_from, self.mesh)(noise)

    def step(self, state: State, action: Array, key: Array) -> tuple[State, State, Outcome]:
        """Act once.

        Args:
            state: of n arms.
            action (n, action_size): in [-1, 1].
            key: for the new episodes.

        Returns:
            The state to act on next (reset where an episode ended), the state that the action led to,
            and the outcome.
        """
        # Act, and see whose episode is over
        after = over_arms(self.env.step, self.mesh)(state, action)
        valid = after.info["valid"]
        terminated = (after.done > 0) & valid
        truncated = (after.pipeline_state.n_steps >= self.episode_length) & ~terminated
        over = terminated | truncated | ~valid

        # New episodes where the last one is over; metrics are always those of the action
        following = choose_arms(over, self.reset(key), after).replace(metrics=after.metrics)
        return following, after, Outcome(after.obs, after.reward, terminated, truncated, valid)
