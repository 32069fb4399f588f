"""Strategies towards a moving goal. Pure; NumPy only.

    policy     strategy
    at rest    `Predicting`  acts several times in each tick, each time from a predicted pose
    in motion  `Chasing`     acts in each tick

Both are given the goal ahead, corrected by the error of the way so far (`mjx_softarm.deploy.moving.error`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm.deploy.belief import Belief, pose_of
from mjx_softarm.deploy.moving.error import WayError
from mjx_softarm.deploy.moving.lead import RATE_S
from mjx_softarm.deploy.strategy import Choice, clipped, observed, planned
from mjx_softarm.mdp.rewards import asked_error
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.lag import ShapeLag, spring_lag_s


class Predicting(NamedTuple):
    """Actions of a policy for arms at rest towards a moving goal: all of them in each tick.

    The first one begins at the believed pose, each next one at the pose predicted for the last references.
    The lengths at the goal are due half of `RATE_S` later. The references lead the lengths that
    are due by the lag of the springs.
    """

    shift: np.ndarray = np.zeros(6)  # [mm, deg]
    lengths_m: tuple[np.ndarray, ...] = ()  # (n_springs,) each, of the last ticks, oldest first
    shape: ShapeLag = ShapeLag()  # memory of an arm with these lengths
    behind: np.ndarray | float = 0.0  # (6,) [mm, deg] pose at rest with the last lengths less that in motion
    way: WayError = WayError()

    def references(self, belief: Belief, goal: np.ndarray) -> Choice:
        """Act several times; the last references count."""
        # Lengths at the goal, of an arm whose shape lags and that has been beside its way
        controller, policy, pose = belief.controller, belief.controller.policy, belief.pose
        shift, length_m = self.shift, belief.spring_m
        way = self.way.after(goal, pose - self.behind, controller)
        goal = goal + self.behind + way.correction
        for _ in range(policy.n_actions):
            length_m = planned(belief, pose, goal + shift)
            pose, _ = pose_of(controller, length_m, belief.load)
            left = asked_error(np.asarray(pose, float), goal, policy.reward)
            shift = clipped(shift - left)
        shape, behind = self.shape.after(policy, length_m, belief.load.believed_kg, controller.dt_s)

        # Lengths due now, their rate, and the lag of springs that move so
        n_ticks = 2 * max(1, round(0.5 * RATE_S / controller.dt_s))
        lengths_m = (*self.lengths_m, length_m)[-n_ticks - 1 :]
        rate = (lengths_m[-1] - lengths_m[0]) / (controller.dt_s * max(len(lengths_m) - 1, 1))
        lag_s = spring_lag_s(policy, belief.command.pressure_kpa)
        reference_m = lengths_m[(len(lengths_m) - 1) // 2] + lag_s @ rate
        return Choice(Predicting(shift, lengths_m, shape, behind, way), reference_m)


class Chasing(NamedTuple):
    """Actions of a policy of motion towards a moving goal: one in each tick.

    It observes as its last action that of `Policy.action_s` seconds ago, as in training. Circle in 20 s, four
    policies of TQC and two of `motion-analytic`: 3.1 and 1.5 mm; with an action every 0.5 s 3.5 and 1.8 mm.
    """

    references_m: tuple[np.ndarray | None, ...] = ()  # (n_springs,) each, of the last ticks, oldest first
    shape: ShapeLag = ShapeLag()
    way: WayError = WayError()

    def references(self, belief: Belief, goal: np.ndarray) -> Choice:
        """Act from the pose in motion towards the goal, corrected by its error on the way."""
        controller, policy = belief.controller, belief.controller.policy
        load_kg = belief.load.believed_kg
        shape, behind = self.shape.after(policy, belief.spring_m, load_kg, controller.dt_s)
        pose = belief.pose - behind
        way = self.way.after(goal, pose, controller)

        # The last action that it observes, from those in force at the stop on
        last_m = self.references_m or (belief.command.reference_m,)
        seen = observed(belief, last_m[0])
        reference_m = controller.plan(pose, goal + way.correction, belief.spring_m, seen)
        n_ticks = max(1, round(policy.action_s / controller.dt_s))
        return Choice(Chasing((*last_m, reference_m)[-n_ticks:], shape, way), reference_m)


def to_moving_goal(policy: Policy) -> Predicting | Chasing:
    """Return the strategy for a goal that begins to move."""
    return Chasing() if policy.action_s else Predicting()
