"""Demonstrations taken from a steered arm: static poses for `train imitate`, each checked as it is taken."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_softarm.control import saturated
from mjx_softarm.deploy.link import Recorder
from mjx_softarm.deploy.loop import LoopState
from mjx_softarm.logs.schema import Log
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.lag import still
from mjx_softarm.sensing.pose import pose_error, pose_from_quaternion, quaternion_from_pose

APART = np.repeat([1.0, 1.0], 3)  # [mm, deg] smallest difference from the last taken pose, in one number


class TakenPoses:
    """Poses of one sequence, in the order in which they were taken."""

    def __init__(self, policy: Policy):
        self._policy, self._rows = policy, Recorder()
        self._last = np.full(6, np.inf)

    def __len__(self) -> int:
        return len(self._rows)

    def take(self, state: LoopState, row: Mapping[str, Any]) -> str:
        """Keep the pose of a tick if training can use it; return a message.

        Args:
            state: state of the loop after the tick.
            row: log row of the tick. Without motion capture its estimate is the pose.
        """
        seen = np.isfinite(row.get("tip_quaternion", np.nan)).all()
        pose = pose_from_quaternion(row["tip_m"], row["tip_quaternion"]) if seen else row["estimate"]
        refused = self._refused(state, row["readings"], np.asarray(pose, float))
        if refused:
            return f"pose not taken: {refused}"
        tip = {"tip_m": 1e-3 * pose[:3], "tip_quaternion": quaternion_from_pose(pose)}
        self._rows.add({"time_s": row["time_s"], "readings": row["readings"], "sequence": 0} | tip)
        self._last = pose
        place = ", ".join(f"{value:.0f}" for value in pose[:3])
        return f"pose {len(self)} taken: tip at {place} mm, {'seen' if seen else 'believed'}"

    def log(self) -> Log:
        """Return the poses as a log."""
        return self._rows.log("demonstrations", self._policy.sensor)

    def _refused(self, state: LoopState, readings: np.ndarray, pose: np.ndarray) -> str:
        """Return the reason to refuse a pose, or an empty text."""
        # The arm must be at rest, with all readings, no chamber saturated.
        policy, belief, command = self._policy, state.belief, state.command
        low, high = np.sort(policy.actions[1:], axis=0)
        if command.reference_m is None or state.goal is not None or not still(belief.window.spring_m):
            return "got an arm that moves or has no pressure, expected one at rest"
        if belief.lost.any() or not np.isfinite(pose).all():
            return f"spring {np.argmax(belief.lost)}: got no reading, expected one"
        held = command.pressure_kpa, command.reference_m, belief.spring_m
        mask = saturated(*held, policy.gains, policy.tolerance_m)
        if mask.any():
            return f"chamber {np.argmax(mask)}: got its limit of pressure, its spring off the reference"
        # The pose must be an action, and a new one.
        outside = (readings < low) | (readings > high)
        if outside.any():
            k = int(np.argmax(outside))
            got = f"spring {k}: got {readings[k]:.6g} {policy.sensor.unit}"
            return f"{got}, expected {low[k]:.6g} to {high[k]:.6g}, the range of actions"
        with np.errstate(invalid="ignore"):
            if (np.abs(pose_error(pose, self._last)) < APART).all():
                return "got the pose that was taken last, expected another"
        return ""
