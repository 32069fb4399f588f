"""Reward of reaching a goal: one function for simulation, relabelling, twin and deployed arm.

Source: the paper's reward equation. Its three cases become terms that add up:

    saturated:  -saturation_cost
    reached:     goal_bonus
    otherwise:  -error_cost ||e|| - step_cost N,    e = w (pose - goal).

Two terms are added that the paper does not have: `distance_cost` for the error in all three cases, and an
environment's cost of a body close to a wall. The three cases hide the error of a saturated arm, and of an arm
near its goal. With `distance_cost` and `saturation_cost` alone, the error always counts.
"""

from __future__ import annotations

from dataclasses import dataclass

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.sensing.pose import pose_error


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward; `threshold` is the paper's theta, about 5.4 mm without a rotation error."""

    goal_bonus: float = 100.0  # reward of a goal that is reached
    error_cost: float = 10.0  # cost of a weighted error of 1
    step_cost: float = 0.1  # cost of each action of the episode so far
    saturation_cost: float = 100.0  # cost of a saturated chamber
    threshold: float = 0.03  # weighted error below which a goal is reached
    weight_per_mm: float = 0.0056  # weight of the tip's position
    weight_per_deg: float = 0.001  # weight of the tip's angles
    distance_cost: float = 0.0  # cost of a weighted error of 1, in every case


def scaled_error(pose: Array, goal: Array, config: RewardConfig) -> Array:
    """Return e = w (pose - goal), (..., 6) without unit, angles wrapped.

    Args:
        pose (..., 6) [mm, deg]: pose of the tip.
        goal (..., 6) [mm, deg]: target of the tip.
        config: the weights.
    """
    xp = array_namespace(pose)
    weight = xp.asarray([config.weight_per_mm] * 3 + [config.weight_per_deg] * 3, dtype=pose.dtype)
    return weight * pose_error(pose, goal)


def reward(
    pose: Array,
    goal: Array,
    n_steps: Array,
    saturated: Array,
    config: RewardConfig,
    clearance_cost: Array = 0.0,
) -> tuple[Array, Array, dict[str, Array]]:
    """Compute the reward of a pose after an action.

    Args:
        pose (..., 6) [mm, deg]: pose of the tip after the action.
        goal (..., 6) [mm, deg]: target of the tip.
        n_steps (...,): environment steps of the episode, this one included.
        saturated (...,) bool: any chamber at its pressure limit with its spring off its reference.
        config: the weights.
        clearance_cost (...,): cost of a body close to a wall.

    Returns:
        Reward (...,); whether the goal is reached (...,) bool, which ends an episode; the terms by name.
    """
    # The paper's three cases exclude each other
    xp = array_namespace(pose)
    norm = xp.sqrt(xp.sum(scaled_error(pose, goal, config) ** 2, axis=-1))
    close = norm < config.threshold
    reached = close & ~saturated
    on_the_way = ~close & ~saturated
    terms = {
        "goal": xp.where(reached, config.goal_bonus, 0.0),
        "error": xp.where(on_the_way, -config.error_cost * norm, 0.0),
        "steps": xp.where(on_the_way, -config.step_cost * n_steps, 0.0),
        "saturation": xp.where(saturated, -config.saturation_cost, 0.0),
        "distance": -config.distance_cost * norm,
        "clearance": xp.zeros_like(norm) - clearance_cost,
    }
    return sum(terms.values()), reached, terms
