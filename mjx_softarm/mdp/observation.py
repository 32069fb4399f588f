"""Observation: pose, goal and scaled error; a policy may also observe the payload, or motion.

Source: the paper's state s = (P, g, e) in R^18. A fixed affine map brings pose and goal to the order of one,
the range that networks learn in.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.mdp.rewards import RewardConfig, scaled_error
from mjx_softarm.posture import straight_pose
from mjx_softarm.sensing.pose import pose_error
from mjx_softarm.spec import ArmSpec

Observation = Literal["pose", "payload", "motion"]

# Units before scaling; `ObsScale` scales pose and goal, the reward's weights scale the error.
_AXES = ("x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg")
OBS_LAYOUT = tuple(f"{part}_{axis}" for part in ("pose", "goal", "error") for axis in _AXES)
OBS_SIZE = len(OBS_LAYOUT)
POSE, GOAL, ERROR = slice(0, 6), slice(6, 12), slice(12, 18)  # entries of the observation
RATE_S = 0.1  # time between the two lengths or positions of a rate
SPRING_M_PER_S, TIP_MM_PER_S = 0.1, 300.0  # speeds that are observed as 1


class ObsScale(NamedTuple):
    """Affine map of poses and goals."""

    centre: Array  # (6,) [mm, deg] pose of the straight, unloaded arm
    scale: Array  # (6,) [mm, deg]

    @classmethod
    def from_spec(cls, spec: ArmSpec) -> ObsScale:
        """Return the map that centres on the unloaded tip and scales a third of the arm, or 90 deg, to 1."""
        scale = np.array([1e3 * spec.length_m / 3] * 3 + [90.0] * 3, np.float32)
        return cls(straight_pose(spec).astype(np.float32), scale)


def layouts(spec: ArmSpec) -> dict[Observation, tuple[str, ...]]:
    """Return the names of all entries of each kind of observation."""
    springs, rates, actions = (
        [f"{name}_{k}" for k in range(spec.n_springs)] for name in ("spring", "spring_rate", "action")
    )
    integrals = [f"integral_{k}" for k in range(spec.n_chambers)]
    motion = *springs, *rates, *(f"velocity_{axis}" for axis in "xyz"), *integrals, *actions
    return {"pose": OBS_LAYOUT, "payload": (*OBS_LAYOUT, "payload_kg"), "motion": (*OBS_LAYOUT, *motion)}


def rate_ticks(rate_hz: float) -> int:
    """Return the number of control periods over which rates are taken."""
    return max(1, round(RATE_S * rate_hz))


def observe_payload(payload_kg: Array, spec: ArmSpec) -> Array:
    """Return the observation (..., 1) of a payload (...) [kg]; the arm's largest payload is 1."""
    xp = array_namespace(payload_kg)
    return xp.asarray(payload_kg / spec.mass.largest_payload_kg, dtype=np.float32)[..., None]


def observe_motion(
    spring_m: Array,
    last_spring_m: Array,
    tip_mm: Array,
    last_tip_mm: Array,
    integral_kpa: Array,
    action: Array,
    spec: ArmSpec,
) -> Array:
    """Return observations (..., 3 n_springs + n_chambers + 3) of motion, scaled to the order of one.

    Args:
        spring_m (..., n_springs) [m]: lengths that are read.
        last_spring_m (..., n_springs) [m]: lengths `rate_ticks` before.
        tip_mm (..., 3) [mm]: position of the tip.
        last_tip_mm (..., 3) [mm]: position `rate_ticks` before.
        integral_kpa (..., n_chambers) [kPa]: integral of the sensor-space law.
        action (..., n_springs): the last action, in [-1, 1].
        spec: the arm.

    Returns:
        Lengths, from -1 at the shortest to 1 at the longest; their rates; the tip's velocity; the integral,
        from -1 at the least to 1 at the greatest pressure; the action.
    """
    xp = array_namespace(spring_m, tip_mm, action)
    shortest, longest = (spec.at_springs(x) for x in (spec.springs.length_min_m, spec.springs.length_max_m))
    low, high, span = (xp.asarray(x, dtype=spring_m.dtype) for x in (shortest, longest, longest - shortest))
    least, greatest = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    over_s = rate_ticks(spec.control.rate_hz) / spec.control.rate_hz

    lengths = (2.0 * spring_m - low - high) / span
    rates = (spring_m - last_spring_m) / (over_s * SPRING_M_PER_S)
    velocity = (tip_mm - last_tip_mm) / (over_s * TIP_MM_PER_S)
    integral = (2.0 * integral_kpa - least - greatest) / (greatest - least)
    return xp.concat([lengths, rates, velocity, integral, action], axis=-1)


def observe(pose: Array, goal: Array, scale: ObsScale, config: RewardConfig) -> Array:
    """Return the observation (..., 18) of pose and goal (..., 6) [mm, deg]: scaled pose, scaled goal, e.

    Angles are taken from the straight arm's: an upright arm moves about a roll of 180 degrees. An axis of the
    goal that is not asked for is not seen.
    """
    xp = array_namespace(pose)
    scaled_pose, scaled_goal = (pose_error(value, scale.centre) / scale.scale for value in (pose, goal))
    if not all(config.asked):
        scaled_goal = xp.where(np.array(config.asked), scaled_goal, 0.0)
    return xp.concat([scaled_pose, scaled_goal, scaled_error(pose, goal, config)], axis=-1)
