"""Hindsight relabelling: a pose that was reached becomes the goal, sensed lengths become the action.

Some transitions of a batch keep their goal. For some, the pose that they reached becomes the goal, with its
goal bonus (the paper's relabelling). Some get a goal near that pose, at a distance drawn log-uniformly, which
shows the critic how the reward falls off around a pose.

A relabelled transition whose chambers had saturated also gets another action (hindsight action transitions,
Levy et al., ICLR 2019). At rest it asks for the spring lengths that the arm ended at, which lead to the same
equilibrium without saturation. (With redundant chambers it is the same but for redundant pressures, which
hardly bend a section.) In motion only the references of the saturated chambers are exchanged: the law holds
such a chamber at its limit either way.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from mjx_softarm._support import draws
from mjx_softarm._support.errors import check_settings
from mjx_softarm._support.fields import Number, Share, check_ranges
from mjx_softarm.env import ReachEnv
from mjx_softarm.mdp import rewards
from train.agent.learner import Experience, Transition

NEAR_MM = (1.0, 100.0)  # distances of near goals; a millimetre goes with a turn of a degree


@dataclass(frozen=True)
class HindsightConfig:
    """Shares of a batch that get another goal; the rest keeps its own."""

    VARIABLE = ("reached_share", "near_share")

    reached_share: Share = 0.5  # share whose goal becomes the pose reached
    near_share: Share = 0.0  # share whose goal becomes a pose near the one reached
    n_later: Number = 0  # largest number of actions to a reached pose, and to half of the near ones
    exchange_actions: bool = True  # relabelled, a saturated action becomes the sensed one
    saturation_costs: bool = True  # also where the goal is the pose reached; in the paper that has its bonus

    def __post_init__(self) -> None:
        check_ranges("learner.hindsight.", self)
        fits = self.reached_share + self.near_share <= 1
        check_settings("learner.hindsight", self, {"reached_share": (fits, "at most 1 - near_share")})


def relabel(batch: Experience, key: Array, config: HindsightConfig, env: ReachEnv) -> Transition:
    """Return a batch to learn from; some of its B stored transitions have another goal.

    With both shares zero, the rewards are the environment's own.
    """
    # Goals: own, reached, or near the pose reached.
    n = batch.saturated.shape[0]
    (kind, distance), direction = draws.both(key, (2, n), (n, 6))
    reached = kind < config.reached_share
    near = ~reached & (kind < config.reached_share + config.near_share)
    pose = centre = batch.next_pose
    if batch.later_pose is not None:
        pose = batch.later_pose
        half = kind < config.reached_share + config.near_share / 2
        centre = jnp.where(half[:, None], pose, centre)
    near_pose = centre + near_offsets(distance, direction).astype(centre.dtype)
    goal = jnp.where(reached[:, None], pose, jnp.where(near[:, None], near_pose, batch.goal))

    # Actions: where a chamber saturated, the one that asks for the lengths it reached.
    sensed = (reached | near) & batch.saturated & config.exchange_actions
    action = jnp.where(sensed[:, None], batch.sensed_action, batch.action)
    saturated = batch.saturated & ~sensed & (config.saturation_costs | ~reached)

    # Error, reward and termination recomputed for the goals.
    reward, done, _ = rewards.reward(
        batch.next_pose, goal, batch.n_steps, saturated, env.config.reward, batch.clearance_cost
    )
    next_sensed = batch.next_sensed
    if env.config.observation == "motion" and next_sensed is not None:  # it ends with the last action
        next_sensed = next_sensed.at[:, -action.shape[1] :].set(action)
    return Transition(
        obs=env.observe(batch.pose, goal, batch.sensed),
        action=action,
        reward=reward,
        next_obs=env.observe(batch.next_pose, goal, next_sensed),
        terminated=(done & env.config.goal_ends).astype(reward.dtype),
        stored=batch,
        relabelled=reached | near,
    )


def later_pose(now: Experience, later: Experience, ahead: Array) -> Array:
    """Return the poses (B, 6) [mm, deg] that B transitions reached some actions later in the same episode.

    `ahead` (B,) counts additions to the replay between `now` and `later`, which is of the same episode if it
    has the same goal and `ahead` more actions. Else the pose is that of the transition itself.
    """
    same = (later.n_steps == now.n_steps + ahead) & jnp.all(later.goal == now.goal, axis=-1)
    return jnp.where(same[:, None], later.next_pose, now.next_pose)


def near_offsets(distance: Array, direction: Array) -> Array:
    """Return offsets (n, 6) [mm, deg]: random directions, log-uniform lengths, and turns.

    `distance` (n,) are uniform draws in [0, 1), `direction` (n, 6) normal draws.

    A turn is a normal draw in proportion to the translation's length over its own norm, so it has a heavy
    tail: some goals are turned further than the arm can turn, as a user's goals may be.
    """
    low, high = (jnp.log(limit_mm) for limit_mm in NEAR_MM)
    length = jnp.exp(low + (high - low) * distance)[:, None]  # (n, 1) [mm]
    return length * (direction / jnp.linalg.norm(direction[:, :3], axis=-1, keepdims=True))
