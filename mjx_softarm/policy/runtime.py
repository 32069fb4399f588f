"""The policy in NumPy: pose and goal -> spring lengths for the sensor-space law.

Observation, sensors and law are the functions that training uses; only the actor's layers are evaluated here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mjx_softarm._support.mlp import mlp
from mjx_softarm.mdp.observation import ObsScale, observe
from mjx_softarm.policy.file import Policy


class Reference(NamedTuple):
    """Spring references of the policy."""

    readings: np.ndarray  # (..., n) of the sensors
    length_m: np.ndarray  # (..., n) the same, as calibrated lengths: the reference of `control.pressures`


class PolicyRunner:
    """The deterministic policy, as evaluated in training. It has no state.

    Example: `PolicyRunner(load_policy("policy.npz")).act(pose, goal).length_m`.
    """

    def __init__(self, policy: Policy):
        self.policy = policy
        self._scale = ObsScale(*(np.asarray(value, np.float32) for value in policy.obs_scale))

    def act(self, pose: ArrayLike, goal: ArrayLike) -> Reference:
        """Return the spring references that bring the tip from a pose towards a goal.

        Args:
            pose (..., 6) [mm, deg]: of the tip; see `mjx_softarm.sensing.pose`.
            goal (..., 6) [mm, deg]: target of the tip; the leading axes broadcast against the pose's.

        Returns:
            Readings (..., n) and lengths (..., n) [m], both within the policy's limits.

        Raises:
            ValueError: as `action` does.
        """
        actions = self.policy.actions
        readings = actions.readings(self.action(pose, goal))  # (..., n)
        return Reference(readings, actions.sensor.lengths(readings).length_m)

    def action(self, pose: ArrayLike, goal: ArrayLike) -> np.ndarray:
        """Return the action (..., n) in [-1, 1], float32, that `act` maps to readings; arguments as there.

        Raises:
            ValueError: pose or goal has the wrong shape or is not finite, or the actor overflows; what it
                asks for would be springs without a length.
        """
        pose, goal = np.broadcast_arrays(_six("pose", pose), _six("goal", goal))
        observation = observe(pose, goal, self._scale, self.policy.reward)  # (..., 18)
        action = np.tanh(mlp(self.policy.layers, observation))  # (..., n)
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
