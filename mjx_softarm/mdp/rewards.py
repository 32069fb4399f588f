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

import math
from dataclasses import dataclass

import numpy as np

from mjx_softarm._support.fields import Amount
from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.sensing.pose import pose_error, pose_from_frame


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward; `threshold` is the paper's theta, about 5.4 mm without a rotation error."""

    goal_bonus: Amount = 100.0  # reward of a goal that is reached
    error_cost: Amount = 10.0  # cost of a weighted error of 1
    step_cost: Amount = 0.1  # cost of each action of the episode so far
    saturation_cost: Amount = 100.0  # cost of a saturated chamber
    threshold: Amount = 0.03  # weighted error below which a goal is reached
    weight_per_mm: Amount = 0.0056  # weight of the tip's position
    weight_per_deg: Amount = 0.001  # weight of the tip's angles
    distance_cost: Amount = 0.0  # cost of a weighted error of 1, in every case
    axes: tuple[float, ...] = (1.0,) * 6
    """factors of the weights of x, y, z, yaw, pitch and roll; 0 for an axis on which any value will do"""

    @property
    def weights(self) -> tuple[float, ...]:
        """Weights of x, y, z [1/mm], yaw, pitch, roll [1/deg]."""
        units = [self.weight_per_mm] * 3 + [self.weight_per_deg] * 3
        return tuple(unit * factor for unit, factor in zip(units, self.axes, strict=True))

    @property
    def asked(self) -> tuple[bool, ...]:
        """Which of x, y, z, yaw, pitch and roll a goal asks for."""
        return tuple(axis > 0.0 for axis in self.axes)

    @property
    def turn_weight_per_deg(self) -> float | None:
        """Weight of a turn about any axis; None where yaw, pitch and roll have different weights."""
        yaw, *others = self.weights[3:]
        return yaw if others == [yaw, yaw] else None


def scaled_error(pose: Array, goal: Array, config: RewardConfig) -> Array:
    """Return e = w (pose - goal), (..., 6) without unit, for poses (..., 6) [mm, deg]; angles wrap."""
    xp = array_namespace(pose)
    return xp.asarray(list(config.weights), dtype=pose.dtype) * pose_error(pose, goal)


def weighted_error(pose: Array, goal: Array, config: RewardConfig) -> Array:
    """Return the weighted error (...): the norm of `scaled_error`."""
    xp = array_namespace(pose)
    return xp.sqrt(xp.sum(scaled_error(pose, goal, config) ** 2, axis=-1))


def asked_error(pose: Array, goal: Array, config: RewardConfig) -> Array:
    """Return pose - goal (..., 6) [mm, deg], angles wrapped, zero on axes that goals do not ask for."""
    error = pose_error(pose, goal)
    xp = array_namespace(error)
    return error if all(config.asked) else xp.where(np.array(config.asked), error, 0.0)


def weighted_position(position_m: Array, config: RewardConfig) -> Array:
    """Return positions (..., 3) [m], weighted."""
    xp = array_namespace(position_m)
    return xp.asarray([1e3 * weight for weight in config.weights[:3]], dtype=position_m.dtype) * position_m


def weighted_angles(rotation: Array, config: RewardConfig) -> Array:
    """Return numbers (..., 6) of rotations (..., 3, 3), for different weights of yaw, pitch and roll.

    The norm of a difference is the weighted error of the angles, for small errors.
    """
    xp = array_namespace(rotation)
    angles = xp.deg2rad(pose_from_frame(rotation[..., 0], rotation)[..., 3:])  # at any position
    per_rad = xp.asarray([weight * math.degrees(1.0) for weight in config.weights[3:]], dtype=angles.dtype)
    return xp.concat([per_rad * xp.cos(angles), per_rad * xp.sin(angles)], axis=-1)


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
    norm = weighted_error(pose, goal, config)
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
