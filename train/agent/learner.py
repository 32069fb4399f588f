"""The interface of a learner: what the epoch, evaluation, sweeps, checkpoints and export need of it.

An epoch steps the arms, stores their transitions and calls `update` some times after each action; the learner
samples the replay as it is stored, or relabels it. A learner with `own_arms` steps these itself as it learns:
an epoch of it is nothing but updates, without replay.

Any object with the methods of `Learner` can be handed to `train.epoch.job.Job`; a class that inherits from
`Learner` has `parts` and `adopt` already. On several devices, batches are spread over them, and the learner's
state is on all of them.

Shapes: O observation, A action.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import jax
from jax import Array


class Experience(NamedTuple):
    """A transition as stored: poses rather than observations, so that the goal can be exchanged."""

    pose: Array  # (..., 6) [mm, deg]
    goal: Array  # (..., 6) [mm, deg]
    action: Array  # (..., n_chambers) in [-1, 1]
    next_pose: Array  # (..., 6) [mm, deg]
    sensed_action: Array  # (..., n_chambers) action for the spring lengths reached; see `hindsight`
    saturated: Array  # (...,) bool
    clearance_cost: Array  # (...,) for a body close to a wall
    n_steps: Array  # (...,) actions taken in the episode, this one included
    sensed: Array | None = None  # (..., k) what the observation has besides pose and goal; None is nothing
    next_sensed: Array | None = None  # (..., k) after the action


Sample = Callable[[Array], Experience]  # key -> a batch of the replay, drawn uniformly with replacement


class Learner(Protocol):
    """Pure functions of a state, which is any pytree of arrays and all that an update changes."""

    own_arms: int  # arms that an update steps, each once; 0 for a learner from the replay

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

    def mode(self, policy: Any, obs: Array) -> Array:
        """Return the policy's deterministic actions (..., A) in [-1, 1] at observations (..., O)."""
        ...

    def update(self, state: Any, sample: Sample, key: Array) -> tuple[Any, dict[str, Array]]:
        """Take one gradient step; return the next state and scalar metrics by name, such as "tqc/entropy".

        With arms of its own it must not call `sample`, and returns the means of the environment's metrics
        too, by names such as "env/tip_error_mm".
        """
        ...


def check_same_shapes(name: str, given: Any, own: Any) -> None:
    """Raise ValueError where a donor's tree of arrays has other shapes than a run's own."""
    got, expected = ([leaf.shape for leaf in jax.tree.leaves(tree)] for tree in (given, own))
    if got != expected:
        raise ValueError(f"{name}: got layers of {got}, expected {expected} as in the new run")
