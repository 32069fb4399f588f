"""Learner from demonstrations: a learned reward around TQC, and demonstrated positions as goals.

The arm is at rest: an action leads to the same pose from every start. So a demonstrated action is the answer
to its goal from any start, and expert actions are stored with the agent's state: the discriminator compares
two actions for one observation. The expert's answers also take a share of each batch of the critics.

The learned reward is for goals that were asked for; the discriminator does not know relabelled goals. The
reward is never positive, and an episode ends with the goal reached or by the clock, so delay earns nothing.

The paper's discriminator compares other pairs (`expert_start`): the expert's actions at the poses shown
before, and the agent's batch with its relabelled goals. There every row has the learned reward.

Shapes: B batch, O observation, A action, m demonstrated positions.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from tyro.conf import Suppress
from tyro.constructors import PrimitiveConstructorSpec

from mjx_softarm._support import xla
from mjx_softarm._support.errors import InputError, check_settings
from mjx_softarm._support.fields import (
    Amount,
    Count,
    Number,
    PartialShare,
    PositiveShare,
    Share,
    check_ranges,
)
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.state import State
from mjx_softarm.env.vector import choose_arms
from mjx_softarm.mdp import rewards
from train.agent.gail import DiscriminatorState, Gail, GailConfig
from train.agent.learner import Transition
from train.agent.networks import check_same_shapes
from train.agent.tqc import TQC, TQCConfig, TQCState
from train.demos.demonstrations import Demonstrations, shown_before
from train.epoch import replay
from train.epoch.replay_epoch import ReplayEpoch, ReplayState

ExpertStart = Literal["agent", "shown"]
EVEN_SHARE = 0.5  # share of the goals that is drawn evenly, however well they are reached


@dataclass(frozen=True)
class GoalStage:
    """A part of the schedule of demonstrated goals."""

    share: PositiveShare = 1.0  # share of the run's environment steps
    every: Count = 1  # every n-th demonstrated pose is a goal; 1 is all of them
    kept: Share = 1.0  # share of the replay's transitions that is kept as the stage begins

    def __post_init__(self) -> None:
        check_ranges("learner.stages.", self)


def _stages(words: list[str]) -> tuple[GoalStage, ...]:
    stages = []
    for word in words:
        numbers = word.split(",")
        if len(numbers) != 3:
            raise ValueError(f"got {word!r}, expected SHARE,EVERY,KEPT")
        stages.append(GoalStage(float(numbers[0]), int(numbers[1]), float(numbers[2])))
    return tuple(stages)


STAGES_OPTION = PrimitiveConstructorSpec(
    nargs="*",
    metavar="SHARE,EVERY,KEPT",
    instance_from_str=_stages,
    is_instance=lambda value: isinstance(value, tuple),
    str_from_instance=lambda stages: [f"{stage.share:.3g},{stage.every},{stage.kept:g}" for stage in stages],
)


@dataclass(frozen=True)
class ImitationConfig(TQCConfig):
    """Settings of learning from demonstrations, whose poses are the goals."""

    FROM_DEMONSTRATIONS: ClassVar[bool] = True

    gail: GailConfig = field(default_factory=GailConfig)
    """discriminator"""
    learned_weight: Amount = 1.0
    """weight of the learned reward; with 0, only the poses of the demonstrations are used"""
    hand_made_weight: Amount = 0.0
    """weight of the environment's reward"""
    frozen: Suppress[bool] = False  # whether the discriminator is that of `--reward`, and stays as it is
    expert_share: PartialShare = 0.25
    """share of the critics' batches that is the expert's"""
    expert_start: ExpertStart = "agent"
    """state at which the discriminator sees the expert's action: the agent's; or, as in the paper, the pose
    shown before"""
    stages: Annotated[tuple[GoalStage, ...], STAGES_OPTION] = (GoalStage(),)
    """stages in order: share of the env steps (all add up to 1), every n-th pose is a goal, share of the
    replay that is kept as the stage begins"""
    rebalance_env_steps: Number = 0
    """env steps between two shifts of the goals towards those missed by most; 0 is never"""

    def __post_init__(self) -> None:
        super().__post_init__()
        rewarded = self.hand_made_weight > 0 or self.learned_weight > 0
        total = sum(stage.share for stage in self.stages)
        apart = len(set(self.stage_epochs)) == len(self.stages)
        required = {
            "hand_made_weight": (rewarded, "a number > 0 where learned_weight is 0"),
            "stages": (math.isclose(total, 1.0, abs_tol=1e-6), f"shares that add up to 1, not {total:g}"),
            "stage_epochs": (apart, f"an epoch or more for each stage; there are {self.n_epochs}"),
        }
        check_settings("learner", self, required)

    def check(self, env: EnvConfig) -> None:
        """Raise InputError for an environment that does not suit demonstrations.

        A demonstrated action leads to one pose from every start, at rest and with one payload alone.
        """
        super().check(env)
        required = {
            "mode": (not env.in_motion, "'quasistatic' for demonstrations"),
            "observation": (env.observation == "pose", "'pose' for demonstrations"),
        }
        check_settings("env", env, required)

    def make_epoch(self, env: ReachEnv, shown: Demonstrations | None = None) -> ReplayEpoch:
        """Return the epoch of the learner, with demonstrated starts and goals."""
        if shown is None:
            raise InputError("learner: got 'imitation' without demonstrations, expected a file of them")
        return ReplayEpoch(self, env, Imitation(self, env, shown), DemonstratedGoals(self, env, shown))

    @property
    def stage_epochs(self) -> tuple[int, ...]:
        """Number of epochs before each stage."""
        shares = [0.0, *itertools.accumulate(stage.share for stage in self.stages[:-1])]
        return tuple(round(share * self.n_epochs) for share in shares)

    @property
    def rebalance_epochs(self) -> int:
        """Number of epochs between two shifts of the goals; 0 is never."""
        return -(-self.rebalance_env_steps // (self.n_arms * self.vector_steps_per_epoch))


class ImitationState(NamedTuple):
    """All that an update changes."""

    agent: TQCState
    discriminator: DiscriminatorState | None  # None where no reward is learned or taken


class Imitation:
    """TQC with a learned reward, and the expert's answers in some rows of its batches."""

    def __init__(self, config: ImitationConfig, env: ReachEnv, demonstrations: Demonstrations):
        self.config, self.env = config, env
        self.tqc = TQC(env.observation_size, env.action_size, config)
        self.gail = Gail(env.observation_size, env.action_size, config.gail)
        self.mode = self.tqc.mode
        self.positions = jnp.asarray(demonstrations.positions)  # (m, 6) [mm, deg]
        self.actions = jnp.asarray(demonstrations.actions)  # (m, A)
        self.before = jnp.asarray(shown_before(demonstrations.sequence))  # (m,)
        self.n_expert = round(config.expert_share * config.batch_size)  # rows of a batch

    def init(self, key: Array) -> ImitationState:
        """Return fresh networks."""
        key_agent, key_discriminator = jax.random.split(key)
        discriminator = self.gail.init(key_discriminator) if self.config.learned_weight else None
        return ImitationState(self.tqc.init(key_agent), discriminator)

    def act(self, state: ImitationState, obs: Array, key: Array) -> Array:
        """Return TQC's exploring actions."""
        return self.tqc.act(state.agent, obs, key)

    def update(
        self, state: ImitationState, batch: Transition, key: Array
    ) -> tuple[ImitationState, dict[str, Array]]:
        """Take one gradient step of the discriminator, and with its reward one of TQC."""
        key_between, key_update = jax.random.split(key)
        discriminator, metrics, stored = state.discriminator, {}, batch.stored
        assert stored is not None  # the epoch gives it
        away = jnp.sum((stored.goal[:, None] - self.positions) ** 2, axis=-1)  # (B, m)
        index = jnp.argmin(away, axis=-1)  # (B,) demonstrated positions that are the goals

        # Batch: the first rows are exchanged for the expert's.
        batch = self.with_expert(batch, index)
        relabelled = cast(Array, batch.relabelled)

        # Discriminator: the expert's actions against the agent's, at one observation or as in the paper.
        if self.config.expert_start == "shown":
            start = self.env.observe(self.positions[self.before[index]], self.positions[index])  # (B, O)
            pairs = (start, self.actions[index]), (batch.obs, batch.action)
            without_reward = jnp.zeros_like(relabelled)  # the discriminator knows relabelled goals
        else:
            start = self.env.observe(stored.pose, stored.goal)  # (B, O)
            pairs = (start, self.actions[index]), (start, stored.action)
            without_reward = relabelled
        if discriminator is not None and not self.config.frozen:
            discriminator, metrics = self.gail.update(discriminator, *pairs, key_between)

        # Agent: the batch with rewards of the updated discriminator.
        reward, learned = self.rewards(batch, without_reward, discriminator)
        agent, losses = self.tqc.update(state.agent, batch._replace(reward=reward), key_update)
        metrics = {f"gail/{name}": x for name, x in (metrics | learned).items()}
        return ImitationState(agent, discriminator), losses | metrics

    def policy(self, state: ImitationState) -> Any:
        """Return TQC's policy."""
        return self.tqc.policy(state.agent)

    def parts(self, state: ImitationState) -> dict[str, Any]:
        """Return the parts of TQC, and the discriminator's parameters as `reward`."""
        parts = self.tqc.parts(state.agent)
        return parts if state.discriminator is None else parts | {"reward": state.discriminator.params}

    def adopt(self, state: ImitationState, parts: Mapping[str, Any]) -> ImitationState:
        """Return the state with a learned reward, with networks of TQC, or with both."""
        networks = {name: part for name, part in parts.items() if name != "reward"}
        if networks:
            state = state._replace(agent=self.tqc.adopt(state.agent, networks))
        if "reward" in parts:
            assert state.discriminator is not None  # a learned reward without weight is refused before
            check_same_shapes("discriminator", parts["reward"], state.discriminator.params)
            state = state._replace(discriminator=state.discriminator._replace(params=parts["reward"]))
        return state

    def rewards(
        self, batch: Transition, without_reward: Array, discriminator: DiscriminatorState | None
    ) -> tuple[Array, dict[str, Array]]:
        """Return the rewards (B,) of a batch, and metrics.

        The cost of the body's clearance is charged whatever the weights; the expert, in the first rows, keeps
        clear. `without_reward` (B,) bool marks rows whose goal the discriminator does not know.
        """
        assert batch.stored is not None
        cost = batch.stored.clearance_cost.at[: self.n_expert].set(0.0)  # (B,)
        reward = self.config.hand_made_weight * (batch.reward + cost) - cost  # (B,)
        if discriminator is None:
            return reward, {}
        learned = self.gail.reward(discriminator.params, batch.obs, batch.action)  # (B,)
        learned = jnp.where(without_reward, 0.0, learned)
        mean = jnp.sum(learned) / jnp.maximum(jnp.sum(~without_reward), 1)
        return reward + self.config.learned_weight * learned, {"reward": mean}

    def with_expert(self, batch: Transition, index: Array) -> Transition:
        """Return a batch whose first rows are the expert's answers, from the same starts to the same goals.

        `index` (B,) gives the demonstrated positions that are the goals of the stored transitions.
        """
        n, stored = self.n_expert, batch.stored
        assert stored is not None
        goal = self.positions[index[:n]]  # (n, 6)
        reward, reached, _ = rewards.reward(
            goal, goal, stored.n_steps[:n], jnp.zeros(n, bool), self.env.config.reward
        )
        expert = {
            "obs": self.env.observe(stored.pose[:n], goal),
            "action": self.actions[index[:n]],
            "reward": reward,
            "next_obs": self.env.observe(goal, goal),
            "terminated": reached.astype(reward.dtype),
            "relabelled": jnp.zeros(n, bool),
        }
        return batch._replace(
            **{name: jnp.concatenate([rows, getattr(batch, name)[n:]]) for name, rows in expert.items()}
        )


class DemonstratedGoals:
    """Starts and goals among m demonstrated positions; the state is the goals' weights (m,).

    An episode goes from one position to another. Starts are all of them; goals of the first stage are some of
    them, those of later stages more. Between epochs, goals shift to the positions with the largest errors.
    """

    def __init__(self, config: ImitationConfig, env: ReachEnv, demonstrations: Demonstrations):
        self.config, self.env = config, env
        self.positions = jnp.asarray(demonstrations.positions)  # (m, 6) [mm, deg]
        self._thin = xla.jit(replay.thin, donate_argnums=0)

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

    def prepare(
        self, state: ReplayState, epoch: int, errors_mm: Callable[[], Sequence[float]]
    ) -> ReplayState:
        """Return the state before an epoch: a stage begins, or goals shift to the largest errors.

        As a stage begins, the state given is used up: its replay is thinned. `epoch` is the number of epochs
        done; `errors_mm` returns the tip errors (m,) at the positions.
        """
        every, stages = self.config.rebalance_epochs, self.config.stage_epochs
        if epoch in stages:
            kept = self.config.stages[stages.index(epoch)].kept
            if kept < 1.0 and epoch:
                key, key_thin = jax.random.split(state.key)
                memory = self._thin(state.memory, key_thin, jnp.asarray(kept, jnp.float32))
                state = state._replace(memory=memory, key=key)
            return state._replace(goals=jnp.asarray(self.of_stage(epoch), jnp.float32))
        if every and epoch % every == 0:
            return state._replace(goals=jnp.asarray(goal_weights(errors_mm(), self.of_stage(epoch))))
        return state


def goal_weights(error_mm: Sequence[float] | np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Return how often each position is the goal: a share evenly, the rest in proportion to its error (m,).

    `goals` (m,) bool marks the positions that are goals at all.
    """
    error = np.where(goals, error_mm, 0.0)
    by_error = error / error.sum() if error.sum() > 0 else goals / goals.sum()
    return (EVEN_SHARE * goals / goals.sum() + (1.0 - EVEN_SHARE) * by_error).astype(np.float32)
