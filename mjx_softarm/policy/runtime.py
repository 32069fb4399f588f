"""The policy in NumPy: spring lengths and payload give the tip's pose; pose and goal give references.

Observation, sensors and networks are the functions of training. All functions here also take JAX arrays and
the symbols of `mjx_softarm.export`.
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

    readings: np.ndarray  # (..., n) references as readings of the sensors
    length_m: np.ndarray  # (..., n) references as calibrated lengths, for `control.pressures`


class InMotion(NamedTuple):
    """Earlier lengths, references and integral of an arm in motion."""

    before_m: Array  # (n,) lengths `rate_ticks` earlier; NaN if not known, for example at rest
    last_reference_m: Array  # (n,) references of the last action; NaN before the first action
    integral_kpa: Array  # (n,) integral of the sensor-space law


def tip_pose(policy: Policy, spring_m: Array, load_kg: Array | float) -> tuple[Array, Array]:
    """Return the tip pose (..., 6) [mm, deg] of springs (..., n) [m] and a payload () or (...) [kg].

    The second result is its distance from the calibration over the limit; 0 without a sim-to-real network.
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
    """Return the entries (k,) that a policy observes besides pose and goal, float32; None if there are none.

    Args:
        pose (6,) [mm, deg]: tip pose, as `tip_pose` gives it.
        spring_m (n,) [m]: spring lengths.
        motion: used by policies that observe motion.
        load_kg () [kg]: estimated payload, clipped to the range of training.
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
    return array_namespace(observation).tanh(mlp(policy.layers, observation, policy.activation))


def action_towards(policy: Policy, pose: Array, goal: Array, sensed: Array | None = None) -> Array:
    """Return the action (..., n) in [-1, 1] from a pose towards a goal (..., 6) [mm, deg], all float32.

    `sensed` (..., k) holds the result of the function `sensed`.
    """
    scale = ObsScale(*(np.asarray(value, np.float32) for value in policy.obs_scale))
    observation = observe(pose, goal, scale, policy.reward)
    if sensed is not None:
        observation = array_namespace(pose).concat([observation, sensed], axis=-1)
    return actor_output(policy, observation)


class PolicyRunner:
    """The deterministic policy, as training evaluates it; without state.

    Example: `PolicyRunner(load_policy("policy.npz")).act(pose, goal).length_m`.
    """

    def __init__(self, policy: Policy):
        self.policy = policy

    def act(self, pose: ArrayLike, goal: ArrayLike, sensed: ArrayLike | None = None) -> Reference:
        """Return the spring references, within the policy's limits, that bring the tip towards a goal.

        Args:
            pose (..., 6) [mm, deg]: tip pose; see `mjx_softarm.sensing.pose`.
            goal (..., 6) [mm, deg]: target of the tip; leading axes broadcast with those of the pose.
            sensed (..., k): entries from the function `sensed`, for a policy that observes them; leading axes
                broadcast to those of the poses.

        Raises:
            ValueError: see `action`.
        """
        actions = self.policy.actions
        readings = actions.readings(self.action(pose, goal, sensed))  # (..., n)
        return Reference(readings, actions.sensor.lengths(readings).length_m)

    def action(self, pose: ArrayLike, goal: ArrayLike, sensed: ArrayLike | None = None) -> np.ndarray:
        """Return the action (..., n) in [-1, 1], float32; arguments as for `act`.

        Raises:
            ValueError: pose, goal or `sensed` has a wrong shape, a pose or goal is not finite, or the actor
                overflows.
        """
        pose, goal = np.broadcast_arrays(_six("pose", pose), _six("goal", goal))
        n_more = len(self.policy.obs_layout) - OBS_SIZE
        entries = np.asarray([] if sensed is None else sensed, np.float32)
        if entries.shape[-1:] != (n_more,):
            came = "None" if sensed is None else f"shape {entries.shape}"
            expected = f"(..., {n_more})" if n_more else "None"
            kind = self.policy.observation
            raise ValueError(f"sensed: got {came}, expected {expected}: the policy observes the {kind}")
        entries = np.broadcast_to(entries, (*pose.shape[:-1], n_more))
        action = action_towards(self.policy, pose, goal, entries)
        if not np.isfinite(action).all():
            raise ValueError("action: got nan, expected finite numbers; the actor overflows")
        return action


def _six(name: str, value: ArrayLike) -> np.ndarray:
    with np.errstate(over="ignore"):  # refused below
        array = np.asarray(value, np.float32)
    if array.shape[-1:] != (6,):
        raise ValueError(f"{name}: got shape {array.shape}, expected (..., 6): x, y, z, yaw, pitch, roll")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: got {array[~np.isfinite(array)][0]}, expected finite numbers")
    return array
