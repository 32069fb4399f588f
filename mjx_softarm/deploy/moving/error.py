"""The tip's error behind a moving goal, and the correction of the goal that makes up for it. NumPy only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.mdp.actions import SHIFT_LIMIT
from mjx_softarm.mdp.rewards import asked_error

# Share of the error along and beside the way by which the goal is corrected in a second. Circle in 20 s, a
# policy of TQC in motion, which arrives early: 11.3 mm without, 5.3 mm with 0.6, 4.1 mm with this. At 2.5 per
# second, policies trained at rest oscillate on rods.
WAY_SHARE_PER_S = 1.0


class WayError(NamedTuple):
    """Memory of the tip's errors behind a moving goal, and the correction of the goal.

    The correction integrates the believed errors. It turns with the direction of the way: relative to it,
    errors along the way, such as a lag, and across it stay nearly constant on a bend.
    """

    goals: tuple[np.ndarray, ...] = ()  # (6,) [mm, deg] of each tick, from the one two ticks ago to the lead
    correction_mm: np.ndarray = np.zeros(3)  # correction of the goal now

    def after(self, goal: np.ndarray, pose: np.ndarray, controller: Controller) -> WayError:
        """Return the memory a tick later, for a goal ahead (6,) and a believed pose now (6,) [mm, deg]."""
        # Wait until the goals reach back to the present one.
        dt_s, lead_s = controller.dt_s, controller.lead_s
        goals = (*self.goals, goal)[-round(lead_s / dt_s) - 3 :]
        if dt_s * (len(goals) - 3) < lead_s - 0.5 * dt_s:
            return WayError(goals)
        # Turn the correction with the way, and integrate the error.
        before, last, now = goals[:3]
        kept_mm = _turned(self.correction_mm, (last - before)[:3], (now - last)[:3])
        error_mm = asked_error(pose, now, controller.policy.reward)[:3]
        correction_mm = kept_mm - WAY_SHARE_PER_S * dt_s * error_mm
        return WayError(goals, np.clip(correction_mm, -SHIFT_LIMIT[:3], SHIFT_LIMIT[:3]))

    @property
    def correction(self) -> np.ndarray:
        """Correction (6,) [mm, deg] of the goal ahead."""
        if len(self.goals) < 3:
            return np.zeros(6)
        steps = (self.goals[2] - self.goals[1])[:3], (self.goals[-1] - self.goals[-2])[:3]
        return np.append(_turned(self.correction_mm, *steps), np.zeros(3))


def _turned(vector: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return a vector (3,) turned as the direction `before` (3,) has to turn to become `after` (3,)."""
    lengths = np.linalg.norm(before), np.linalg.norm(after)
    if min(lengths) < 1e-9:
        return vector
    a, b = before / lengths[0], after / lengths[1]
    if a @ b < -0.9:  # back again: about any axis
        return -vector
    turn = np.cross(a, b)
    across = np.cross(turn, vector)
    return vector + across + np.cross(turn, across) / (1.0 + a @ b)
