"""Episodes of learning from demonstrations: starts and goals are demonstrated positions.

An episode goes from one position to another. Starts are all of them; goals of the first stage are some of
them, those of later stages more. Between epochs, goals shift to the positions with the largest errors.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm.env import ReachEnv
from mjx_softarm.env.state import State
from mjx_softarm.env.vector import choose_arms
from train.agent.imitation import ImitationConfig
from train.demos.demonstrations import Demonstrations
from train.epoch.job import Job
from train.epoch.state import TrainState

EVEN_SHARE = 0.5  # share of the goals that is drawn evenly, however well they are reached


class DemonstratedGoals:
    """`Goals` among m demonstrated positions; the state is their weights (m,), relative to each other."""

    def __init__(self, config: ImitationConfig, env: ReachEnv, demonstrations: Demonstrations):
        self.config, self.env = config, env
        self.positions = jnp.asarray(demonstrations.positions)  # (m, 6) [mm, deg]

    def init(self) -> Array:
        """Return the weights of the first stage."""
        return jnp.asarray(self.of_stage(0), jnp.float32)

    def begin(self, state: Array, arms: State, key: Array) -> State:
        """Return n arms; a new episode begins at one demonstrated position, with another for its goal."""
        key_start, key_goal = jax.random.split(key)
        arm, n = arms.pipeline_state, len(arms.obs)
        start = jax.random.randint(key_start, (n,), 0, len(self.positions))
        goal = jax.random.categorical(key_goal, jnp.log(state), shape=(n,))
        fresh = arm._replace(pose=self.positions[start], goal=self.positions[goal])
        arm = choose_arms(arm.n_steps == 0, fresh, arm)
        return arms.replace(pipeline_state=arm, obs=self.env.observe(arm.pose, arm.goal))

    def of_stage(self, epoch: int) -> np.ndarray:
        """Return which positions (m,) are goals in an epoch: bool."""
        stage = int(np.searchsorted(self.config.stage_epochs, epoch, side="right")) - 1
        return np.arange(len(self.positions)) % self.config.stages[stage].every == 0

    def begin_stage(self, job: Job, state: TrainState, epoch: int) -> TrainState:
        """Return the state with the goals of the stage that begins before an epoch, and a thinner replay.

        It is the state as given where no stage begins.
        """
        if epoch not in self.config.stage_epochs:
            return state
        kept = self.config.stages[self.config.stage_epochs.index(epoch)].kept
        if kept < 1.0 and epoch:
            state = job.thin(state, kept)
        return state._replace(goals=jnp.asarray(self.of_stage(epoch), jnp.float32))

    def rebalance(self, state: TrainState, epoch: int, error_mm: Sequence[float] | np.ndarray) -> TrainState:
        """Return the state with goals shifted to the positions (m,) with the largest errors [mm]."""
        return state._replace(goals=jnp.asarray(goal_weights(error_mm, self.of_stage(epoch))))


def goal_weights(error_mm: Sequence[float] | np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Return how often each position is the goal: a share evenly, the rest in proportion to its error.

    Args:
        error_mm (m,): tip errors at the positions now.
        goals (m,) bool: positions that are goals at all.
    """
    error = np.where(goals, error_mm, 0.0)
    by_error = error / error.sum() if error.sum() > 0 else goals / goals.sum()
    return (EVEN_SHARE * goals / goals.sum() + (1.0 - EVEN_SHARE) * by_error).astype(np.float32)
