"""Strategies: small classes that turn a belief and a goal into references of the springs. Pure; NumPy only.

    policy     goal    strategy
    at rest    fixed   `AtRest`      acts at once, then each time the springs have settled
    in motion  fixed   `Timed`       acts every `Policy.action_s` seconds
    either     moving                see `mjx_softarm.deploy.moving`

A policy takes an arm as specified to a goal; one that observes the payload takes an arm with the estimated
payload there. Other deviations leave an error. At rest it shows once the springs have settled, and is
subtracted from the next goal that the policy is given: the *shift* of the goal.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from mjx_softarm.deploy.belief import Belief, pose_of
from mjx_softarm.deploy.safety import Event, extrapolated, unsettled
from mjx_softarm.mdp.actions import SHIFT_LIMIT
from mjx_softarm.mdp.observation import rate_ticks
from mjx_softarm.mdp.rewards import asked_error, weighted_error
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.lag import SETTLE_TIMEOUT_S
from mjx_softarm.policy.reach import followed
from mjx_softarm.policy.runtime import InMotion, sensed
from mjx_softarm.sensing.load import Load

# Shares of the error left, tried in turn. With the whole error alone, 91 of 918 positions in pipes were left
# more than 8 mm off, and two of nine runs failed their tasks in the narrow pipe. With these, none.
SHARES = (1.0, 0.5, 0.25)
# Last references of a policy of motion: number of corrections, each by this share of the error left. Stops of
# TQC on a twin and two rods: 10, 26 and 73 mm off without, 1.6, 1.5 and 1.7 mm with these. Poses of a rod
# with slow regulators move by six times as much as the goal is shifted: by a half they diverge.
N_CORRECTIONS = 16
CORRECTION_SHARE = 0.15


class Strategy(Protocol):
    """Interface of a strategy: a value with a memory."""

    def references(self, belief: Belief, goal: np.ndarray) -> Answer:
        """Return memory, references and faults towards a goal (6,) [mm, deg], that ahead if it moves."""
        ...


# Strategy with its next memory, None where no further action is due; references
# (n_springs,) [m], None: the last ones stay; faults
Answer = tuple[Strategy | None, np.ndarray | None, tuple[Event, ...]]


class AtRest(NamedTuple):
    """Actions of a policy for arms at rest: at once, then whenever the springs have settled.

    An action that would lead away from the goal is tried with smaller shifts. Where none will do, the arm has
    arrived.
    """

    shift: np.ndarray = np.zeros(6)  # [mm, deg]
    n_actions: int = 0
    acted_load: Load | None = None  # payload at the last action

    def references(self, belief: Belief, goal: np.ndarray) -> Answer:
        # The first action has no shift; the next actions correct the error that it leaves.
        policy = belief.controller.policy
        shifts = [self.shift]
        allowed = None
        events: tuple[Event, ...] = ()
        if self.n_actions:
            if _waits(belief, SETTLE_TIMEOUT_S):
                return self, None, ()
            events = unsettled(belief)
            if self.n_actions == policy.n_actions:
                return None, None, events

        # Shifts that take all, or a share, of the error that the references leave. The payload's deflection
        # is compensated once: by the next action of a policy that observes the payload, else by the shift.
        # So for such a policy the error is estimated with the payload of its last action.
        if self.n_actions and belief.settled:
            reference_m = belief.command.reference_m
            assert reference_m is not None and self.acted_load is not None
            pose = acted = _pose_made(belief, reference_m, belief.load)
            if belief.controller.observes_payload:
                acted = _pose_made(belief, reference_m, self.acted_load)
            left = asked_error(acted, goal, policy.reward)
            shifts = [clipped(self.shift - share * left) for share in SHARES]
            allowed = max(float(weighted_error(pose, goal, policy.reward)), policy.reward.threshold)

        # The first shift whose references leave no larger error counts.
        events += extrapolated(belief)
        for shift in shifts:
            reference_m = planned(belief, belief.pose, goal + shift)
            if allowed is not None:
                pose = _pose_made(belief, reference_m, belief.load)
                if weighted_error(pose, goal, policy.reward) > allowed:
                    continue
            return AtRest(shift, self.n_actions + 1, belief.load), reference_m, events
        return None, None, events


class Timed(NamedTuple):
    """Actions of a policy of motion: at regular times, whether the springs have settled or not.

    Its references lead the arm. The last ones stay, so `_final_references` makes the goal at rest.
    """

    n_actions: int = 0

    def references(self, belief: Belief, goal: np.ndarray) -> Answer:
        policy = belief.controller.policy
        is_over = self.n_actions == policy.n_actions
        if self.n_actions and _waits(belief, SETTLE_TIMEOUT_S if is_over else policy.action_s):
            return self, None, ()
        if is_over:
            return None, None, unsettled(belief)
        n_actions = self.n_actions + 1
        is_last = n_actions == policy.n_actions
        reference_m = _final_references(belief, goal) if is_last else planned(belief, belief.pose, goal)
        return Timed(n_actions), reference_m, extrapolated(belief)


def to_fixed_goal(policy: Policy) -> AtRest | Timed:
    """Return the strategy for a new goal that stands."""
    return Timed() if policy.action_s else AtRest()


def _waits(belief: Belief, timeout_s: float) -> bool:
    """Return True while waiting: not at rest, and no timeout [s] since the last action yet."""
    if belief.settled:
        return bool(belief.n_suspect.any())  # whether a chamber is lost comes first
    return belief.command.n_ticks * belief.controller.dt_s < timeout_s


def planned(belief: Belief, pose: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the policy's references (n_springs,) [m] from a pose (6,) towards a target (6,) [mm, deg]."""
    return belief.controller.plan(pose, target, belief.spring_m, observed(belief))


def observed(belief: Belief, last_m: np.ndarray | None = None) -> np.ndarray | None:
    """Return what the policy observes besides pose and goal; see `sensed`.

    `last_m` (n_springs,) [m] are the last references, by default those in force.
    """
    controller = belief.controller
    lengths_m = belief.window_m
    last_m = belief.command.reference_m if last_m is None else last_m
    before_m = lengths_m[-1 - min(rate_ticks(controller.policy.rate_hz), len(lengths_m) - 1)]
    last_m = np.full_like(before_m, np.nan) if last_m is None else last_m
    motion = InMotion(before_m, last_m, belief.command.law.integral_kpa)
    # The tip's velocity is that of poses at rest, now and before, also where `pose` is that of a moving arm
    return sensed(controller.policy, belief.pose, belief.spring_m, motion, belief.load.believed_kg)


def _final_references(belief: Belief, goal: np.ndarray) -> np.ndarray:
    """Return the last references (n_springs,) [m] of a policy of motion for a goal (6,) [mm, deg].

    The goal is shifted by a share of the error that the references would leave at rest, several times. Those
    that would leave the least count.
    """
    controller = belief.controller
    policy = controller.policy
    seen = observed(belief)
    shift = np.zeros(6)
    least = np.inf
    best_m = belief.spring_m
    for _ in range(1 + N_CORRECTIONS):
        reference_m = controller.plan(belief.pose, goal + shift, belief.spring_m, seen)
        pose = pose_of(policy, reference_m, belief.load.believed_kg)
        error = float(weighted_error(pose, goal, policy.reward))
        if error < least:
            least, best_m = error, reference_m
        left = asked_error(pose, goal, policy.reward)
        shift = clipped(shift - CORRECTION_SHARE * left)
    return best_m


def _pose_made(belief: Belief, reference_m: np.ndarray, load: Load) -> np.ndarray:
    """Return the pose (6,) [mm, deg] of an arm at rest on its last references, moved to others."""
    policy = belief.controller.policy
    asked_m = belief.command.reference_m
    assert asked_m is not None
    spring_m = followed(reference_m, belief.mean_m, asked_m, belief.saturated, policy)
    return pose_of(policy, spring_m, load.believed_kg)


def clipped(shift: np.ndarray) -> np.ndarray:
    """Return a shift (6,) [mm, deg] of the goal within `SHIFT_LIMIT`."""
    return np.clip(shift, -SHIFT_LIMIT, SHIFT_LIMIT)
