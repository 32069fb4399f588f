"""The policy in NumPy: spring lengths, payload -> pose of the tip; pose, goal -> references of the springs.

Observation, sensors and networks are the functions that training uses. The functions here take JAX arrays
and the symbols of `mjx_softarm.export` as well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mjx_softarm._support.mlp import mlp
from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.mdp.observation import OBS_SIZE, ObsScale, observe, observe_motion, observe_payload
from mjx_softarm.policy.file import Policy
from mjx_softarm.sensing.estimator import estimate_frame
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.sensing.s2r import apply_correction, correction, distance, inputs


class Reference(NamedTuple):
    """Spring references of the policy."""

    readings: np.ndarray  # (..., n) of the sensors
    length_m: np.ndarray  # (..., n) the same, as calibrated lengths: the reference of `control.pressures`


class InMotion(NamedTuple):
    """Earlier lengths, references and integral of an arm in motion."""

    before_m: Array  # (n,) lengths `rate_ticks` before; NaN if not known, as of an arm at rest
    last_reference_m: Array  # (n,) references of the last action; NaN before the first
    integral_kpa: Array  # (n,) of the sensor-space law


def tip_pose(policy: Policy, spring_m: Array, load_kg: Array | float) -> tuple[Array, Array]:
    """Return the tip pose of springs and a payload.

    Args:
        policy: with the networks.
        spring_m (n,) [m]: lengths.
        load_kg () [kg]: payload.

    Returns:
        Pose (6,) [mm, deg], and `s2r.extrapolation` of it, or 0.
    """
    frame = estimate_frame(policy.estimator, spring_m, load_kg)
    if policy.s2r is None:
        return pose_from_frame(*frame), np.float32(0.0)
    x = inputs(frame, array_namespace(spring_m).asarray(spring_m, dtype=np.float32))
    pose = pose_from_frame(*apply_correction(frame, correction(policy.s2r, x)))
    return pose, distance(policy.s2r, x) / policy.s2r.limit


def sensed(
    policy: Policy, pose: Array, spring_m: Array, motion: InMotion, load_kg: Array | float
) -> Array | None:
    """Return what a policy observes besides pose and goal: (k,) float32, or nothing.

    Args:
        policy: one of any kind of observation.
        pose (6,) [mm, deg]: of the tip, as `tip_pose` of the springs.
        spring_m (n,) [m]: lengths.
        motion: of the arm; a policy that does not observe it ignores it.
        load_kg () [kg]: estimated payload, brought to those that the policy knows if it observes it.
    """
    xp = array_namespace(spring_m)
    if policy.observation == "pose":
        return None
    if policy.observation == "payload":
        least, most = policy.spec.mass.payload_kg, float(policy.load_estimator.load_scale_kg)
        return observe_payload(xp.clip(load_kg, least, most), policy.spec)
    known = motion.before_m, motion.last_reference_m
    before_m, last_m = (xp.where(xp.isfinite(x), x, spring_m) for x in known)
    before_mm = tip_pose(policy, before_m, load_kg)[0][:3]
    action = policy.actions.from_lengths(last_m)
    observed = spring_m, before_m, pose[:3], before_mm, motion.integral_kpa, action
    return xp.asarray(observe_motion(*observed, policy.spec), dtype=np.float32)


def actor_output(policy: Policy, observation: Array) -> Array:
    """Return the action (..., n) in [-1, 1] of observations (..., O)."""
    return array_namespace(observation).tanh(mlp(policy.layers, observation))


def action_towards(policy: Policy, pose: Array, goal: Array, sensed: Array | None = None) -> Array:
    """Return the action (..., n) in [-1, 1] from a pose towards a goal (..., 6) [mm, deg], all float32.

    `sensed` (..., k) is what the policy observes besides pose and goal, if it does.
    """
    scale = ObsScale(*(np.asarray(value, np.float32) for value in policy.obs_scale))
    observation = observe(pose, goal, scale, policy.reward)
    if sensed is not None:
        observation = array_namespace(pose).concat([observation, sensed], axis=-1)
    return actor_output(policy, observation)


class PolicyRunner:
    """The deterministic policy, as evaluated in training. It has no state.

    Example: `PolicyRunner(load_policy("policy.npz")).act(pose, goal).length_m`.
    """

    def __init__(self, policy: Policy):
        self.policy = policy

    def act(self, pose: ArrayLike, goal: ArrayLike, sensed: ArrayLike | None = None) -> Reference:
        """Return the spring references that bring the tip from a pose towards a goal.

        Args:
            pose (..., 6) [mm, deg]: of the tip; see `mjx_softarm.sensing.pose`.
            goal (..., 6) [mm, deg]: target of the tip; the leading axes broadcast against the pose's.
            sensed (..., k): of the function `sensed`, for a policy that observes more; its leading
                axes are broadcast to those of the poses.

        Returns:
            Readings (..., n) and lengths (..., n) [m], both within the policy's limits.

        Raises:
            ValueError: as `action` does.
        """
        actions = self.policy.actions
        readings = actions.readings(self.action(pose, goal, sensed))  # (..., n)
        return Reference(readings, actions.sensor.lengths(readings).length_m)

    def action(self, pose: ArrayLike, goal: ArrayLike, sensed: ArrayLike | None = None) -> np.ndarray:
        """Return the action (..., n) in [-1, 1], float32, that `act` maps to readings; arguments as there.

        Raises:
            ValueError: pose or goal has the wrong shape or is not finite, or the actor overflows; what it
                asks for would be springs without a length. `sensed` is missing, or is not observed, or has
                the wrong shape.
        """
        pose, goal = np.broadcast_arrays(_six("pose", pose), _six("goal", goal))
        n_more = len(self.policy.obs_layout) - OBS_SIZE
        if (None if sensed is None else np.shape(sensed)[-1:]) != ((n_more,) if n_more else None):
            came = "None" if sensed is None else f"shape {np.shape(sensed)}"
            expected = f"(..., {n_more})" if n_more else "None"
            what = self.policy.observation
            raise ValueError(f"sensed: got {came}, expected {expected}: the policy observes the {what}")
        if sensed is not None:
            sensed = np.broadcast_to(np.asarray(sensed, np.float32), (*pose.shape[:-1], n_more))
        action = action_towards(self.policy, pose, goal, sensed)
        if not np.isfinite(action).all():
            raise ValueError("action: got nan, expected finite numbers; the actor overflows")
        return action


def _six(name: str, value: ArrayLike) -> np.ndarray:
    with np.errstate(over="ignore"):  # refused below
        array = np.asarray(value, np.float32)
    if array.shape[-1:] != (6,):
        raise ValueError(
            f"{name}: got shape {array.shape}, expected (..., 6): x, y, z [mm], yaw, pitch, roll [deg]"
        )
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: got {array[~np.isfinite(array)][0]}, expected finite numbers")
    return array
