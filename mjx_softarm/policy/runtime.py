"""The policy in NumPy: pose and goal -> the spring lengths that the sensor-space law holds.

The observation, the sensors and the law are the functions that training uses; only the actor's layers are
written out here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mjx_softarm.mdp.observation import ObsScale, observe
from mjx_softarm.policy.file import Policy


class Reference(NamedTuple):
    """What the policy asks of the springs."""

    readings: np.ndarray  # (..., n) of the sensors
    length_m: np.ndarray  # (..., n) the same, as calibrated lengths: the reference of `control.pressures`


class PolicyRunner:
    """The deterministic policy, as evaluated in training; it has no state.

    Example: `PolicyRunner(load_policy("policy.npz")).act(pose, goal).length_m`.
    """

    def __init__(self, policy: Policy):
        self.policy = policy
        self._scale = ObsScale(*(np.asarray(value, np.float32) for value in policy.obs_scale))

    def act(self, pose: ArrayLike, goal: ArrayLike) -> Reference:
        """References of the springs that bring the tip from a pose towards a goal.

        Args:
            pose (..., 6) [mm, deg]: where the tip is; see `mjx_softarm.sensing.pose`.
            goal (..., 6) [mm, deg]: where it should be; the leading axes broadcast against the pose's.

        Returns:
            Readings (..., n) and lengths (..., n) [m], both within the policy's limits.

        Raises:
            ValueError: as `action` does.
        """
        actions = self.policy.actions
        readings = actions.readings(self.action(pose, goal))  # (..., n)
        return Reference(readings, actions.sensor.lengths(readings).length_m)

    def action(self, pose: ArrayLike, goal: ArrayLike) -> np.ndarray:
        """The action (..., n) in [-1, 1], float32, of which `act` makes readings; arguments as there.

        Raises:
            ValueError: pose or goal has the wrong shape or is not finite, or the actor overflows; what it
                asks for would be springs without a length.
        """
        pose, goal = np.broadcast_arrays(_six("pose", pose), _six("goal", goal))
        x = observe(pose, goal, self._scale, self.policy.reward)  # (..., 18)
        *hidden, (head_weight, head_bias) = self.policy.layers
        for weight, bias in hidden:
            x = np.maximum(x @ weight + bias, 0.0)  # (..., out)
        action = np.tanh(x @ head_weight + head_bias)  # (..., n)
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
