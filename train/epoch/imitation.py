"""Learning from demonstrations: goals are demonstrated positions, the reward is learned from the expert.

An action of an arm at rest leads to the same pose from wherever it begins. So each demonstrated action is the
expert's answer to its goal from any start, and the expert is put where the agent stood: the discriminator
compares two actions for one observation, and nothing but the action can tell them apart. The expert's answers
also take a share of each batch of the critics, with the learned reward like all others.

Goals of the first stage are some of the positions; starts are all of them. The learned reward is for goals
that were asked for, not for those of hindsight, which the discriminator does not know.

Episodes end with the goal reached or by the clock, so a reward that is never positive rewards no delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from mjx_softarm._support import xla
from mjx_softarm._support.mjx import State
from mjx_softarm.env import ReachEnv
from mjx_softarm.mdp import rewards
from train.agent.gail import DiscriminatorState, Gail
from train.agent.tqc import TQCState, Transition
from train.config import ImitationConfig
from train.demos.demonstrations import Demonstrations
from train.epoch import replay
from train.epoch.hindsight import Experience
from train.epoch.job import Job, TrainState

# Difference of observations that is rounding; hindsight moves a goal by a millimetre or more.
SAME_GOAL = 1e-5
EVEN_SHARE = 0.5  # of the goals that are drawn evenly, however well they are reached


class Imitation(NamedTuple):
    """What a run has besides a reach run's state, for m demonstrated positions."""

    discriminator: DiscriminatorState
    goal_weight: Array  # (m,) how often a position is the goal, relative to the others


class ImitationJob(Job):
    """A run's fixed parts, and the functions that change its state; see `Job`."""

    config: ImitationConfig

    def __init__(
        self,
        config: ImitationConfig,
        env: ReachEnv,
        demonstrations: Demonstrations,
        mesh: Mesh | None = None,
    ):
        super().__init__(config, env, mesh)
        self.positions = jnp.asarray(demonstrations.positions)  # (m, 6) [mm, deg]
        self.actions = jnp.asarray(demonstrations.actions)  # (m, n_chambers)
        self.gail = Gail(env.observation_size, env.action_size, config.gail)
        self.learns = config.learned_weight > 0 and not config.frozen
        self.n_expert = round(config.expert_share * config.batch_size) if self.learns else 0
        self._thin = xla.jit(replay.thin, env.uses_mjx, donate_argnums=0)

    def goals_of(self, epoch: int) -> np.ndarray:
        """Which positions (m,) are goals in an epoch: bool."""
        stage = int(np.searchsorted(self.config.stage_epochs, epoch, side="right")) - 1
        return np.arange(len(self.positions)) % self.config.stages[stage].every == 0

    def begin_stage(self, state: TrainState, epoch: int) -> TrainState:
        """The state as a stage begins before an epoch, if one does: its goals, and a thinner replay."""
        if epoch not in self.config.stage_epochs:
            return state
        stage = self.config.stages[self.config.stage_epochs.index(epoch)]
        memory = state.memory
        if stage.kept < 1.0 and epoch:
            key = jax.random.fold_in(state.key, 6)
            memory = self._thin(memory, key, jnp.asarray(stage.kept, jnp.float32))
        weight = jnp.asarray(self.goals_of(epoch), jnp.float32)
        return state._replace(memory=memory, imitation=state.imitation._replace(goal_weight=weight))

    def rebalance(self, state: TrainState, epoch: int, error_mm: Sequence[float] | np.ndarray) -> TrainState:
        """The state with goals shifted towards those that are missed by most; errors (m,) [mm]."""
        weight = jnp.asarray(goal_weights(error_mm, self.goals_of(epoch)))
        return state._replace(imitation=state.imitation._replace(goal_weight=weight))

    def _init(self, key: Array) -> TrainState:
        state = super()._init(key)
        weight = jnp.asarray(self.goals_of(0), jnp.float32)
        key_discriminator, key_first = (jax.random.fold_in(key, k) for k in (3, 4))  # `Job` splits off 0 to 2
        discriminator = self.gail.init(key_discriminator)
        imitation = Imitation(discriminator, weight)
        return state._replace(
            arms=self._between_positions(state.arms, weight, key_first), imitation=imitation
        )

    def _vector_step(self, state: TrainState, _) -> tuple[TrainState, dict[str, Array]]:
        key = jax.random.fold_in(state.key, 5)  # `Job` splits off 0 to 4
        state, metrics = super()._vector_step(state, None)
        arms = self._between_positions(state.arms, state.imitation.goal_weight, key)
        return state._replace(arms=arms), metrics

    def _between_positions(self, arms: State, goal_weight: Array, key: Array) -> State:
        """Arms whose episode is new begin at one demonstrated position, with another for their goal."""
        key_start, key_goal = jax.random.split(key)
        arm, n = arms.pipeline_state, self.arms.n
        start = self.positions[jax.random.randint(key_start, (n,), 0, len(self.positions))]
        goal = self.positions[jax.random.categorical(key_goal, jnp.log(goal_weight), shape=(n,))]
        new = (arm.n_steps == 0)[:, None]
        arm = arm._replace(pose=jnp.where(new, start, arm.pose), goal=jnp.where(new, goal, arm.goal))
        return arms.replace(pipeline_state=arm, obs=self.env.observe(arm.pose, arm.goal))

    def _update(
        self, agent: TQCState, imitation: Imitation, memory: replay.Replay, key: Array
    ) -> tuple[tuple[TQCState, Any], dict[str, Array]]:
        key_sample, key_between, key_relabel, key_update = jax.random.split(key, 4)
        stored = self._sample(memory, key_sample)
        index = self._index_of(stored.goal)
        batch = self._with_expert(self._relabel(stored, key_relabel), stored, index)
        start, discriminator, told = self.env.observe(stored.pose, stored.goal), imitation.discriminator, {}
        if self.learns:
            expert, own = (start, self.actions[index]), (start, stored.action)
            discriminator, told = self.gail.update(discriminator, expert, own, key_between)
        reward, learned = self._rewards(batch, stored, start, discriminator.params)
        agent, losses = self.agent.update(agent, batch._replace(reward=reward), key_update)
        metrics = {f"tqc/{name}": x for name, x in losses.items()}
        metrics |= {f"gail/{name}": x for name, x in (told | learned).items()}
        return (agent, imitation._replace(discriminator=discriminator)), metrics

    def _rewards(
        self, batch: Transition, stored: Experience, start: Array, params: Any
    ) -> tuple[Array, dict[str, Array]]:
        """Rewards (B,) of a batch made of `stored`, whose own observations are `start` (B, O); metrics.

        What the body's clearance costs is charged whatever the weights; the expert keeps clear.
        """
        cost = stored.clearance_cost.at[: self.n_expert].set(0.0)
        reward = self.config.hand_made_weight * (batch.reward + cost) - cost
        if self.config.learned_weight == 0:
            return reward, {}
        asked = jnp.max(jnp.abs(batch.obs - start), axis=-1) < SAME_GOAL  # not a goal of hindsight
        learned = jnp.where(asked, self.gail.reward(params, batch.obs, batch.action), 0.0)
        mean = jnp.sum(learned) / jnp.maximum(jnp.sum(asked), 1)
        return reward + self.config.learned_weight * learned, {"reward": mean}

    def _index_of(self, goal: Array) -> Array:
        """Index (B,) of the demonstrated position that is the goal (B, 6)."""
        return jnp.argmin(jnp.sum((goal[:, None] - self.positions) ** 2, axis=-1), axis=-1)

    def _with_expert(self, batch: Transition, stored: Experience, index: Array) -> Transition:
        """The batch with its first rows in the expert's hands: from the same starts to the same goals."""
        n = self.n_expert
        goal = self.positions[index[:n]]
        reward, reached, _ = rewards.reward(
            goal, goal, stored.n_steps[:n], jnp.zeros(n, bool), self.config.env.reward
        )
        expert = Transition(
            obs=self.env.observe(stored.pose[:n], goal),
            action=self.actions[index[:n]],
            reward=reward,
            next_obs=self.env.observe(goal, goal),
            terminated=reached.astype(reward.dtype),
        )
        return jax.tree.map(lambda e, b: jnp.concatenate([e, b[n:]]), expert, batch)


def goal_weights(error_mm: Sequence[float] | np.ndarray, goals: np.ndarray) -> np.ndarray:
    """How often each position is the goal: a share evenly, the rest in proportion to its error.

    Args:
        error_mm (m,): by which a position is missed now.
        goals (m,) bool: positions that are goals at all.
    """
    error = np.where(goals, error_mm, 0.0)
    by_error = error / error.sum() if error.sum() > 0 else goals / goals.sum()
    return (EVEN_SHARE * goals / goals.sum() + (1.0 - EVEN_SHARE) * by_error).astype(np.float32)
