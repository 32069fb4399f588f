"""The interface of a learner, and the settings that the epoch reads of every learner.

An epoch steps the arms, stores their transitions and calls `update` some times after each action. A learner
with `own_arms` steps these itself as it learns: its epoch consists of updates alone, without replay. On
several devices, batches are spread over them, and the learner's state is on all of them.

Shapes: O observation, A action.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

from jax import Array

from mjx_softarm._support.mlp import Activation
from mjx_softarm.env import EnvConfig
from mjx_softarm.mdp.actions import N_ACTIONS


def check_settings(where: str, settings: Any, required: Mapping[str, tuple[bool, str]]) -> None:
    """Raise ValueError where a setting does not hold.

    Args:
        where: path of the settings in a run's config.
        settings: an object with the settings.
        required: name -> whether the setting can be used, and what is expected of it.
    """
    for name, (holds, expected) in required.items():
        if not holds:
            raise ValueError(f"{where}.{name}: got {getattr(settings, name)}, expected {expected}")


@dataclass(frozen=True)
class LearnerConfig:
    """Settings of every learner; the config of a learner inherits from it. Raises ValueError."""

    VARIABLE: ClassVar[tuple[str, ...]] = ()  # names of plain numbers that members of a sweep may differ in

    hidden: tuple[int, ...] = (256, 256)  # widths of the policy's hidden layers
    activation: Activation = "relu"  # function after each of them
    n_arms: int = 128  # arms simulated side by side
    total_env_steps: int = 300_000  # actions of all arms together
    vector_steps_per_epoch: int = 16  # actions of each arm between two reports

    def __post_init__(self) -> None:
        counts = ("n_arms", "total_env_steps", "vector_steps_per_epoch")
        check_settings("learner", self, {name: (getattr(self, name) >= 1, "at least 1") for name in counts})

    def check(self, env: EnvConfig) -> None:
        """Raise ValueError where the learner cannot learn in an environment."""

    @property
    def n_epochs(self) -> int:
        """Number of epochs of the run."""
        return -(-self.total_env_steps // (self.n_arms * self.vector_steps_per_epoch))

    @property
    def milestones(self) -> tuple[int, ...]:
        """Numbers of epochs after which an evaluation follows in any case."""
        return ()

    def n_env_steps(self, epoch: int) -> int:
        """Return the number of actions of all arms by the end of an epoch."""
        return epoch * self.vector_steps_per_epoch * self.n_arms

    def n_updates(self, epoch: int) -> int:
        """Return the number of gradient steps by the end of an epoch: one after each action of all arms."""
        return epoch * self.vector_steps_per_epoch


@dataclass(frozen=True)
class ReplayConfig(LearnerConfig):
    """Settings of a learner from the replay. Raises ValueError."""

    episode_length: int = N_ACTIONS  # actions per episode at most
    updates_per_env_step: float = 1.0  # gradient steps per action of one arm
    warmup_env_steps: int = 2_048  # actions drawn uniformly before the first gradient step
    batch_size: int = 256  # transitions per gradient step
    replay_capacity: int = 400_000  # transitions kept

    def __post_init__(self) -> None:
        super().__post_init__()
        of_arms = f"a finite number of at least one update per step of all {self.n_arms} arms"
        updates = math.isfinite(self.updates_per_env_step) and self.n_updates_per_vector_step >= 1
        required = {
            "episode_length": (self.episode_length >= 1, "at least 1"),
            "updates_per_env_step": (updates, f"{of_arms}, {1 / self.n_arms:.4g}"),
            "warmup_env_steps": (self.warmup_env_steps >= 0, "at least 0"),
            "batch_size": (self.batch_size >= 1, "at least 1"),
            "replay_capacity": (self.replay_capacity >= self.n_arms, f"at least n_arms = {self.n_arms}"),
        }
        check_settings("learner", self, required)

    @property
    def n_updates_per_vector_step(self) -> int:
        """Number of gradient steps after each action of all arms."""
        return round(self.updates_per_env_step * self.n_arms)

    @property
    def n_warmup_vector_steps(self) -> int:
        """Number of actions of each arm before the first gradient step."""
        return -(-self.warmup_env_steps // self.n_arms)

    @property
    def n_decay_updates(self) -> int:
        """Length of a learning rate's decay: gradient steps of a run without warm-up."""
        return self.n_epochs * self.vector_steps_per_epoch * self.n_updates_per_vector_step

    def n_updates(self, epoch: int) -> int:
        """Return the number of gradient steps by the end of an epoch."""
        n_vector_steps = epoch * self.vector_steps_per_epoch - self.n_warmup_vector_steps
        return max(0, n_vector_steps) * self.n_updates_per_vector_step


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
    """A batch of steps. Truncation is absent by design: a step cut by the clock bootstraps like any other."""

    obs: Array  # (B, O)
    action: Array  # (B, A) in [-1, 1]
    reward: Array  # (B,)
    next_obs: Array  # (B, O) reached by the action, before any reset
    terminated: Array  # (B,) float: 1 where the next value is zero, else 0

    def check(self, obs_size: int, action_size: int) -> None:
        """Raise ValueError naming a field of the wrong shape."""
        n = self.obs.shape[0]
        sizes = {"obs": (obs_size,), "action": (action_size,), "next_obs": (obs_size,)}
        for name, value in self._asdict().items():
            expected = (n, *sizes.get(name, ()))
            if value.shape != expected:
                raise ValueError(f"Transition.{name}: got shape {value.shape}, expected {expected}")


class Sample(Protocol):
    """Batches of the replay, drawn uniformly with replacement."""

    def __call__(self, key: Array, n_later: int = 0) -> Experience:
        """Return a batch; with the pose up to `n_later` actions later in the same episode, if not 0."""
        ...


class Learner(Protocol):
    """Pure functions of a state, which is any pytree of arrays and all that an update changes."""

    own_arms: bool = False  # whether an update steps the arms, each once; else the learner samples the replay

    def init(self, key: Array) -> Any:
        """Return the first state; no two of its leaves share a buffer, since the state is donated."""
        ...

    def act(self, state: Any, obs: Array, key: Array) -> Array:
        """Return exploring actions (..., A) in [-1, 1] at observations (..., O)."""
        ...

    def policy(self, state: Any) -> Any:
        """Return the parameters of the policy that is evaluated and exported.

        Export needs them named and shaped as those of `train.agent.networks.Actor`.
        """
        ...

    def mode(self, policy: Any, obs: Array) -> Array:
        """Return the policy's deterministic actions (..., A) in [-1, 1] at observations (..., O)."""
        ...

    def update(self, state: Any, sample: Sample, key: Array) -> tuple[Any, dict[str, Array]]:
        """Take one gradient step; return the next state and scalar metrics by name, such as "tqc/entropy".

        With arms of its own it must not call `sample`, and returns the means of the environment's metrics
        too, by names such as "env/tip_error_mm".
        """
        ...

    def parts(self, state: Any) -> dict[str, Any]:
        """Return trees of arrays by name that each checkpoint keeps for export and for other runs.

        `policy` is the policy. A learned reward is called `reward`.
        """
        return {"policy": self.policy(state)}

    def adopt(self, state: Any, parts: Mapping[str, Any]) -> Any:
        """Return the state with parts of another run's learner in the place of its own.

        Raises:
            ValueError: a part is missing, has another size, or cannot be taken.
        """
        raise ValueError(f"got a donor of {', '.join(parts)}, expected none for this learner")
