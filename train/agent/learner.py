"""Settings that every learner has, and transitions as they are stored and learned from.

Shapes: B batch, O observation, A action.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from jax import Array

from mjx_softarm._support.fields import Count, check_ranges
from mjx_softarm._support.mlp import Activation
from mjx_softarm.env import EnvConfig, ReachEnv
from train.demos.demonstrations import Demonstrations
from train.epoch.job import Epoch


@dataclass(frozen=True)
class LearnerConfig:
    """Settings of every learner; the config of a learner inherits from it. Raises InputError."""

    VARIABLE: ClassVar[tuple[str, ...]] = ()  # names of plain numbers that members of a sweep may differ in
    FROM_DEMONSTRATIONS: ClassVar[bool] = False  # whether goals are demonstrated poses, as `imitate` has them

    hidden: tuple[int, ...] = (256, 256)  # widths of the policy's hidden layers
    activation: Activation = "relu"  # function after each of them
    n_arms: Count = 128  # arms simulated side by side
    total_env_steps: Count = 300_000  # actions of all arms together
    vector_steps_per_epoch: Count = 16  # actions of each arm between two reports

    def __post_init__(self) -> None:
        check_ranges("learner.", self)

    def check(self, env: EnvConfig) -> None:
        """Raise InputError where the learner cannot learn in an environment."""

    def make_epoch(self, env: ReachEnv, shown: Demonstrations | None = None) -> Epoch:
        """Return the epoch of the learner; `shown` is for a learner from demonstrations."""
        raise NotImplementedError

    @property
    def n_epochs(self) -> int:
        """Number of epochs of the run."""
        return -(-self.total_env_steps // (self.n_arms * self.vector_steps_per_epoch))

    @property
    def stage_epochs(self) -> tuple[int, ...]:
        """Number of epochs before each stage of the run; an evaluation follows them in any case."""
        return ()

    def n_env_steps(self, epoch: int) -> int:
        """Return the number of actions of all arms by the end of an epoch."""
        return epoch * self.vector_steps_per_epoch * self.n_arms

    def n_updates(self, epoch: int) -> int:
        """Return the number of gradient steps by the end of an epoch: one after each action of all arms."""
        return epoch * self.vector_steps_per_epoch


class Experience(NamedTuple):
    """A transition as stored: poses rather than observations, so that the goal can be exchanged."""

    pose: Array  # (..., 6) [mm, deg]
    goal: Array  # (..., 6) [mm, deg]
    action: Array  # (..., n_springs) in [-1, 1]
    next_pose: Array  # (..., 6) [mm, deg]
    sensed_action: Array  # (..., n_springs) action for the spring lengths reached; see `hindsight`
    saturated: Array  # (...,) bool
    clearance_cost: Array  # (...,) cost of a body close to a wall
    n_steps: Array  # (...,) actions taken in the episode, this one included
    sensed: Array | None = None  # (..., k) observation without pose and goal; None where it has nothing else
    next_sensed: Array | None = None  # (..., k) the same after the action
    later_pose: Array | None = None  # (..., 6) [mm, deg] after a later action of the episode; never stored


class Transition(NamedTuple):
    """A batch of steps to learn from.

    Truncation is absent by design: time-limited steps bootstrap like any other. The last two fields are for
    learners that compare the batch with what was stored; TQC alone does not read them.
    """

    obs: Array  # (B, O)
    action: Array  # (B, A) in [-1, 1]
    reward: Array  # (B,)
    next_obs: Array  # (B, O) reached by the action, before any reset
    terminated: Array  # (B,) float: 1 where the next value is zero, else 0
    stored: Experience | None = None  # (B, ...) transitions before their goals were exchanged
    relabelled: Array | None = None  # (B,) bool: the goal is another than the stored one

    def check(self, obs_size: int, action_size: int) -> None:
        """Raise ValueError naming a field of the wrong shape."""
        n = self.obs.shape[0]
        sizes = {"obs": (obs_size,), "action": (action_size,), "next_obs": (obs_size,)}
        for name in ("obs", "action", "reward", "next_obs", "terminated"):
            shape, expected = getattr(self, name).shape, (n, *sizes.get(name, ()))
            if shape != expected:
                raise ValueError(f"Transition.{name}: got shape {shape}, expected {expected}")
