"""Learner from demonstrations: a learned reward around TQC.

An action of an arm at rest leads to the same pose from wherever it begins. So each demonstrated action is the
expert's answer to its goal from any start, and the expert is put where the agent stood: the discriminator
compares two actions for one observation, and nothing but the action can tell them apart. The expert's answers
also take a share of each batch of the critics, with the same reward as all others.

An arm in motion is still on its way when the next action comes. There the expert acts itself: a share of the
arms' actions are the expert's answers to their goals, and the critics see what these led to. Where the expert
acted, the discriminator compares it with what the agent would do there now.

The learned reward is for goals that were asked for, not for those of hindsight, which the discriminator does
not know. Episodes end with the goal reached or by the clock, so a reward that is never positive rewards no
delay.

Shapes: B batch, O observation, A action, m demonstrated positions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support import draws
from mjx_softarm.env import ReachEnv
from mjx_softarm.mdp import observation, rewards
from train.agent.gail import DiscriminatorState, Gail
from train.agent.hindsight_tqc import HindsightTQC
from train.agent.learner import Experience, Sample, check_same_shapes
from train.agent.tqc import Transition
from train.config import ImitationConfig
from train.demos.demonstrations import Demonstrations

# Difference of observations that is rounding; hindsight moves a goal by a millimetre or more.
SAME_GOAL = 1e-5


class ImitationState(NamedTuple):
    """All that an update changes."""

    agent: Any  # state of the wrapped learner
    discriminator: DiscriminatorState | None  # None where no reward is learned or taken


class Imitation:
    """`Learner` that wraps another and replaces its rewards and some rows of its batches."""

    own_arms = 0

    def __init__(
        self, learner: HindsightTQC, config: ImitationConfig, env: ReachEnv, demonstrations: Demonstrations
    ):
        self.learner, self.config, self.env = learner, config, env
        self.positions = jnp.asarray(demonstrations.positions)  # (m, 6) [mm, deg]
        self.actions = jnp.asarray(demonstrations.actions)  # (m, A)
        self.gail = Gail(env.observation_size, env.action_size, config.gail)
        at_rest = not env.config.moves
        self.n_expert = round(at_rest * config.expert_share * config.batch_size)  # rows of a batch

    def init(self, key: Array) -> ImitationState:
        """Return fresh networks."""
        key_agent, key_discriminator = jax.random.split(key)
        discriminator = self.gail.init(key_discriminator) if self.config.learned_weight else None
        return ImitationState(self.learner.init(key_agent), discriminator)

    def act(self, state: ImitationState, obs: Array, key: Array) -> Array:
        """Return the wrapped learner's exploring actions; in motion, some are the expert's."""
        action = self.learner.act(state.agent, obs, key)
        if not self.env.config.moves:
            return action
        scale = self.env.scale
        goal = obs[..., observation.GOAL] * scale.scale + scale.centre
        by_expert = draws.uniform(jax.random.fold_in(key, 1), obs.shape[:-1]) < self.config.expert_share
        return jnp.where(by_expert[..., None], self.actions[self._index_of(goal)], action)

    def policy(self, state: ImitationState) -> Any:
        """Return the wrapped learner's policy."""
        return self.learner.policy(state.agent)

    def mode(self, policy: Any, obs: Array) -> Array:
        """Return the wrapped learner's deterministic actions."""
        return self.learner.mode(policy, obs)

    def update(
        self, state: ImitationState, sample: Sample, key: Array
    ) -> tuple[ImitationState, dict[str, Array]]:
        """Take one gradient step of the discriminator, and with its reward one of the wrapped learner."""
        key_sample, key_between, key_relabel, key_update = jax.random.split(key, 4)
        discriminator, metrics = state.discriminator, {}

        # Batch: stored transitions, relabelled, at rest the first rows exchanged for the expert's.
        stored = sample(key_sample)
        index = self._index_of(stored.goal)  # (B,)
        batch = self.learner.transitions(stored, key_relabel)
        if not self.env.config.moves:
            batch = self.with_expert(batch, stored, index)

        # Discriminator: the expert's actions against the agent's, at the same observations.
        start = self.env.observe(stored.pose, stored.goal, stored.sensed)  # (B, O)
        if discriminator is not None and not self.config.frozen:
            expert = self.actions[index]  # (B, A)
            agent = self.of_agent(state, stored, start, expert, key_between)
            pairs = (start, expert), (start, agent)
            discriminator, metrics = self.gail.update(discriminator, *pairs, key_between)

        # Agent: the batch with rewards of the updated discriminator.
        reward, of_reward = self.rewards(batch, stored, start, discriminator)
        agent, losses = self.learner.learn(state.agent, batch._replace(reward=reward), key_update)
        metrics = {f"gail/{name}": x for name, x in (metrics | of_reward).items()}
        return ImitationState(agent, discriminator), losses | metrics

    def parts(self, state: ImitationState) -> dict[str, Any]:
        """Return the parts of the wrapped learner, and the discriminator's parameters as `reward`."""
        parts = self.learner.parts(state.agent)
        return parts if state.discriminator is None else parts | {"reward": state.discriminator.params}

    def adopt(self, state: ImitationState, parts: Mapping[str, Any]) -> ImitationState:
        """Return the state with a learned reward, with networks of the wrapped learner, or with both.

        Raises:
            ValueError: a part has another size, or the networks are not those of TQC.
        """
        networks = {name: part for name, part in parts.items() if name != "reward"}
        if networks:
            state = state._replace(agent=self.learner.adopt(state.agent, networks))
        if "reward" in parts:
            assert state.discriminator is not None  # a learned reward without weight is refused before
            check_same_shapes("discriminator", parts["reward"], state.discriminator.params)
            state = state._replace(discriminator=state.discriminator._replace(params=parts["reward"]))
        return state

    def rewards(
        self, batch: Transition, stored: Experience, start: Array, discriminator: DiscriminatorState | None
    ) -> tuple[Array, dict[str, Array]]:
        """Return the rewards (B,) of a batch, and metrics.

        The cost of the body's clearance is charged whatever the weights; the expert keeps clear.

        Args:
            batch: made of `stored`, the expert's rows first.
            stored: B transitions.
            start (B, O): their own observations.
            discriminator: that gives the learned reward, if there is one.
        """
        cost = stored.clearance_cost.at[: self.n_expert].set(0.0)  # (B,)
        reward = self.config.hand_made_weight * (batch.reward + cost) - cost  # (B,)
        if discriminator is None:
            return reward, {}
        asked = jnp.max(jnp.abs(batch.obs - start), axis=-1) < SAME_GOAL  # (B,) not a goal of hindsight
        learned = self.gail.reward(discriminator.params, batch.obs, batch.action)  # (B,)
        learned = jnp.where(asked, learned, 0.0)
        mean = jnp.sum(learned) / jnp.maximum(jnp.sum(asked), 1)
        return reward + self.config.learned_weight * learned, {"reward": mean}

    def of_agent(
        self, state: ImitationState, stored: Experience, start: Array, expert: Array, key: Array
    ) -> Array:
        """Return the actions (B, A) of B transitions, the agent's present ones where the expert acted.

        Args:
            state: of this learner.
            stored: B transitions.
            start (B, O): their observations.
            expert (B, A): the expert's answers to their goals.
            key: draws the agent's present actions.
        """
        if not self.env.config.moves:
            return stored.action
        of_expert = jnp.all(stored.action == expert, axis=-1)  # (B,)
        own = self.learner.act(state.agent, start, jax.random.fold_in(key, 1))  # (B, A)
        return jnp.where(of_expert[:, None], own, stored.action)

    def with_expert(self, batch: Transition, stored: Experience, index: Array) -> Transition:
        """Return a batch whose first rows are the expert's answers, from the same starts to the same goals.

        `index` (B,) tells which demonstrated positions are the goals of the B transitions `stored`.
        """
        n = self.n_expert
        goal = self.positions[index[:n]]  # (n, 6)
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

    def _index_of(self, goal: Array) -> Array:
        """Return the indices (...) of the demonstrated positions that are the goals (..., 6)."""
        return jnp.argmin(jnp.sum((goal[..., None, :] - self.positions) ** 2, axis=-1), axis=-1)
