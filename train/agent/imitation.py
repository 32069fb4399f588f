"""Learner from demonstrations: a learned reward around TQC.

At rest an action leads to the same pose from every start. So a demonstrated action is the expert's answer to
its goal from any start, and expert actions are stored with the agent's state: the discriminator compares two
actions for one observation. The expert's answers also take a share of each batch of the critics.

The learned reward is for goals that were asked for; the discriminator does not know relabelled goals. The
reward is never positive, and an episode ends with the goal reached or by the clock, so delay earns nothing.

The paper's discriminator compares other pairs (`expert_start`): the expert's actions at the poses shown
before, and the agent's batch with its relabelled goals. There every row has the learned reward.

Shapes: B batch, O observation, A action, m demonstrated positions.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.mdp import rewards
from train.agent.gail import DiscriminatorState, Gail, GailConfig
from train.agent.learner import Experience, Learner, Sample, Transition, check_settings
from train.agent.networks import check_same_shapes
from train.agent.stages import STAGES_OPTION, GoalStage
from train.agent.tqc import HindsightTQC, TQCConfig
from train.demos.demonstrations import Demonstrations, shown_before

ExpertStart = Literal["agent", "shown"]


@dataclass(frozen=True)
class ImitationConfig(TQCConfig):
    """Settings of learning from demonstrations, whose poses are the goals. Raises ValueError."""

    gail: GailConfig = field(default_factory=GailConfig)
    """discriminator"""
    learned_weight: float = 1.0
    """weight of the learned reward; with 0, only the poses of the demonstrations are used"""
    hand_made_weight: float = 0.0
    """weight of the environment's reward"""
    frozen: bool = False
    """keep the discriminator of another run as it is; only the poses of the demonstrations are used"""
    expert_share: float = 0.25
    """share of the critics' batches that is the expert's"""
    expert_start: ExpertStart = "agent"
    """state at which the discriminator sees the expert's action: the agent's; or, as in the paper, the pose
    shown before"""
    stages: Annotated[tuple[GoalStage, ...], STAGES_OPTION] = (GoalStage(),)
    """stages in order: share of the env steps (all add up to 1), every n-th pose is a goal, share of the
    replay that is kept as the stage begins"""
    rebalance_env_steps: int = 0
    """env steps between two shifts of the goals towards those missed by most; 0 is never"""

    def __post_init__(self) -> None:
        super().__post_init__()
        hand_made = self.hand_made_weight > 0 or self.hand_made_weight == 0 < self.learned_weight
        total = sum(stage.share for stage in self.stages)
        apart = len(set(self.stage_epochs)) == len(self.stages)
        required = {
            "expert_share": (0.0 <= self.expert_share < 1.0, "0 or more and less than 1"),
            "expert_start": (self.expert_start in get_args(ExpertStart), f"one of {get_args(ExpertStart)}"),
            "learned_weight": (self.learned_weight >= 0, "a number >= 0"),
            "hand_made_weight": (
                hand_made,
                "a number >= 0, and more where learned_weight is 0",
            ),
            "rebalance_env_steps": (self.rebalance_env_steps >= 0, "at least 0"),
            "stages": (math.isclose(total, 1.0, abs_tol=1e-6), f"shares that add up to 1, not {total:g}"),
            "stage_epochs": (apart, f"an epoch or more for each stage; there are {self.n_epochs}"),
        }
        check_settings("learner", self, required)

    def check(self, env: EnvConfig) -> None:
        """Raise ValueError for an environment that does not suit demonstrations.

        A demonstrated action leads to one pose from every start, at rest and with one payload alone.
        """
        super().check(env)
        required = {
            "mode": (not env.moves, "'quasistatic' for demonstrations"),
            "observation": (env.observation == "pose", "'pose' for demonstrations"),
        }
        check_settings("env", env, required)

    @property
    def stage_epochs(self) -> tuple[int, ...]:
        """Number of epochs before each stage."""
        shares = [0.0, *itertools.accumulate(stage.share for stage in self.stages[:-1])]
        return tuple(round(share * self.n_epochs) for share in shares)

    @property
    def milestones(self) -> tuple[int, ...]:
        """Numbers of epochs at the ends of the stages."""
        return self.stage_epochs

    @property
    def rebalance_epochs(self) -> int:
        """Number of epochs between two shifts of the goals; 0 is never."""
        return -(-self.rebalance_env_steps // (self.n_arms * self.vector_steps_per_epoch))


class ImitationState(NamedTuple):
    """All that an update changes."""

    agent: Any  # state of the wrapped learner
    discriminator: DiscriminatorState | None  # None where no reward is learned or taken


class Imitation(Learner):
    """`Learner` that wraps TQC and replaces its rewards and some rows of its batches."""

    def __init__(self, config: ImitationConfig, env: ReachEnv, demonstrations: Demonstrations):
        self.learner, self.config, self.env = HindsightTQC(config, env), config, env
        self.positions = jnp.asarray(demonstrations.positions)  # (m, 6) [mm, deg]
        self.actions = jnp.asarray(demonstrations.actions)  # (m, A)
        self.before = jnp.asarray(shown_before(demonstrations.sequence))  # (m,)
        self.gail = Gail(env.observation_size, env.action_size, config.gail)
        self.n_expert = round(config.expert_share * config.batch_size)  # rows of a batch
        self.mode = self.learner.mode

    def init(self, key: Array) -> ImitationState:
        """Return fresh networks."""
        key_agent, key_discriminator = jax.random.split(key)
        discriminator = self.gail.init(key_discriminator) if self.config.learned_weight else None
        return ImitationState(self.learner.init(key_agent), discriminator)

    def act(self, state: ImitationState, obs: Array, key: Array) -> Array:
        """Return the wrapped learner's exploring actions."""
        return self.learner.act(state.agent, obs, key)

    def policy(self, state: ImitationState) -> Any:
        """Return the wrapped learner's policy."""
        return self.learner.policy(state.agent)

    def update(
        self, state: ImitationState, sample: Sample, key: Array
    ) -> tuple[ImitationState, dict[str, Array]]:
        """Take one gradient step of the discriminator, and with its reward one of the wrapped learner."""
        key_sample, key_between, key_relabel, key_update = jax.random.split(key, 4)
        discriminator, metrics = state.discriminator, {}

        # Batch: stored transitions, relabelled; the first rows are exchanged for the expert's.
        stored = sample(key_sample, self.config.hindsight.n_later)
        index = self._index_of(stored.goal)  # (B,)
        batch, relabelled = self.learner.transitions(stored, key_relabel)
        batch = self.with_expert(batch, stored, index)
        relabelled = relabelled.at[: self.n_expert].set(False)

        # Discriminator: the expert's actions against the agent's, at one observation or as in the paper.
        if self.config.expert_start == "shown":
            start = self.env.observe(self.positions[self.before[index]], self.positions[index])  # (B, O)
            pairs = (start, self.actions[index]), (batch.obs, batch.action)
            relabelled = jnp.zeros_like(relabelled)  # their goals are known to the discriminator
        else:
            start = self.env.observe(stored.pose, stored.goal)  # (B, O)
            pairs = (start, self.actions[index]), (start, stored.action)
        if discriminator is not None and not self.config.frozen:
            discriminator, metrics = self.gail.update(discriminator, *pairs, key_between)

        # Agent: the batch with rewards of the updated discriminator.
        reward, of_reward = self.rewards(batch, stored, relabelled, discriminator)
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
        self,
        batch: Transition,
        stored: Experience,
        relabelled: Array,
        discriminator: DiscriminatorState | None,
    ) -> tuple[Array, dict[str, Array]]:
        """Return the rewards (B,) of a batch, and metrics.

        The cost of the body's clearance is charged whatever the weights; the expert keeps clear.

        Args:
            batch: made of `stored`, the expert's rows first.
            stored: B transitions.
            relabelled (B,) bool: rows of the batch with a goal that was not asked for.
            discriminator: discriminator that gives the learned reward, if there is one.
        """
        cost = stored.clearance_cost.at[: self.n_expert].set(0.0)  # (B,)
        reward = self.config.hand_made_weight * (batch.reward + cost) - cost  # (B,)
        if discriminator is None:
            return reward, {}
        learned = self.gail.reward(discriminator.params, batch.obs, batch.action)  # (B,)
        learned = jnp.where(relabelled, 0.0, learned)
        mean = jnp.sum(learned) / jnp.maximum(jnp.sum(~relabelled), 1)
        return reward + self.config.learned_weight * learned, {"reward": mean}

    def with_expert(self, batch: Transition, stored: Experience, index: Array) -> Transition:
        """Return a batch whose first rows are the expert's answers, from the same starts to the same goals.

        `index` (B,) gives the demonstrated positions that are the goals of the B transitions `stored`.
        """
        n = self.n_expert
        goal = self.positions[index[:n]]  # (n, 6)
        reward, reached, _ = rewards.reward(
            goal, goal, stored.n_steps[:n], jnp.zeros(n, bool), self.env.config.reward
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
