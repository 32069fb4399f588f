"""Strategies towards a moving goal. Pure; NumPy only.

    policy     strategy
    at rest    `Predicting`  acts several times in each tick, each time from a predicted pose
    in motion  `Chasing`     acts in each tick

Both are given the place of the goal some time ahead, its *lead*, corrected by the error of the way so far.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm.control import LawState, pressures
from mjx_softarm.deploy.belief import Belief, pose_of
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.strategy import Answer, clipped, observed, planned
from mjx_softarm.mdp.actions import SHIFT_LIMIT
from mjx_softarm.mdp.observation import rate_ticks
from mjx_softarm.mdp.rewards import asked_error
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.lag import spring_lag_s
from mjx_softarm.policy.runtime import InMotion, sensed
from mjx_softarm.sensing.estimator import Frame, estimate, even_pose, expected_springs
from mjx_softarm.sensing.pose import pose_error

# Share of the error along and beside the way by which the goal is corrected in a second. Circle in 20 s, a
# policy of TQC in motion, which arrives early: 11.3 mm without, 5.3 mm with 0.6, 4.1 mm with this. At 2.5 per
# second, policies trained at rest oscillate on rods.
WAY_SHARE_PER_S = 1.0

RATE_S = 0.2  # time over which the rate of a moving goal's references is taken, of policies at rest

# Goals that swing between two poses; by hand
_N_SWINGS = 4
_SWING_S = 10.0  # period; slow enough for the phase to be a lag
_SWING = 0.3  # largest difference of the poses' pressures from the middle, in ranges of pressure


class ShapeLag(NamedTuple):
    """Memory of how unevenly the sections of a moving arm bend.

    The pose at rest with some springs differs from that of sections that bend evenly. In motion this
    difference lags behind the springs, see `calib.fit.motion.shape`. Both poses are the simulation's: the
    sim-to-real network's correction does not lag.
    """

    uneven: np.ndarray | None = None  # (6,) [mm, deg] difference that lags; None before the first lengths

    def advance(
        self, policy: Policy, spring_m: np.ndarray, load_kg: float, dt_s: float
    ) -> tuple[ShapeLag, np.ndarray]:
        """Return the memory a time dt_s later, and the pose (6,) [mm, deg] at rest minus that in motion.

        Then the springs have lengths (n_springs,) [m], and the arm carries a payload.
        """
        lag_s = policy.spec.shape_lag_s
        if not lag_s:
            return self, np.zeros(6)
        model = policy.estimator
        base = Frame(model.base_position_m, model.base_rotation)
        pose = np.asarray(estimate(model, spring_m, load_kg), float)
        uneven = pose_error(pose, even_pose(base, model.spring_site_m, spring_m))
        if self.uneven is None:  # the arm begins at rest
            return ShapeLag(uneven), np.zeros(6)
        now = self.uneven + dt_s / (lag_s + dt_s) * pose_error(uneven, self.uneven)
        return ShapeLag(now), pose_error(uneven, now)


class WayError(NamedTuple):
    """Memory of the tip's errors behind a moving goal, and the correction of the goal.

    The correction integrates the believed errors. It turns with the direction of the way: relative to it,
    errors along the way, such as a lag, and across it stay nearly constant on a bend.
    """

    lead_s: float  # time by which the goal ahead is ahead
    goals: tuple[np.ndarray, ...] = ()  # (6,) [mm, deg] of each tick, from the one two ticks ago to the lead
    correction_mm: np.ndarray = np.zeros(3)  # correction of the goal now

    def advance(self, goal: np.ndarray, pose: np.ndarray, controller: Controller) -> WayError:
        """Return the memory a tick later, for a goal ahead (6,) and a believed pose now (6,) [mm, deg]."""
        # Wait until the goals reach back to the present one.
        dt_s = controller.dt_s
        goals = (*self.goals, goal)[-round(self.lead_s / dt_s) - 3 :]
        if dt_s * (len(goals) - 3) < self.lead_s - 0.5 * dt_s:
            return WayError(self.lead_s, goals)
        # Turn the correction with the way, and integrate the error.
        before, last, now = goals[:3]
        kept_mm = _turned(self.correction_mm, (last - before)[:3], (now - last)[:3])
        error_mm = asked_error(pose, now, controller.policy.reward)[:3]
        correction_mm = kept_mm - WAY_SHARE_PER_S * dt_s * error_mm
        return WayError(self.lead_s, goals, np.clip(correction_mm, -SHIFT_LIMIT[:3], SHIFT_LIMIT[:3]))

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


class Predicting(NamedTuple):
    """Actions of a policy for arms at rest towards a moving goal: all of them in each tick.

    The first one begins at the believed pose, each next one at the pose predicted for the last references.
    The lengths at the goal are due half of `RATE_S` later. The references lead the lengths that
    are due by the lag of the springs.
    """

    way: WayError
    shift: np.ndarray = np.zeros(6)  # [mm, deg]
    lengths_m: tuple[np.ndarray, ...] = ()  # (n_springs,) each, of the last ticks, oldest first
    shape: ShapeLag = ShapeLag()  # memory of an arm with these lengths
    behind: np.ndarray | float = 0.0  # (6,) [mm, deg] pose at rest with the last lengths less that in motion

    def references(self, belief: Belief, goal: np.ndarray) -> Answer:
        # Lengths at the goal, of an arm whose shape lags and that has been beside its way
        controller = belief.controller
        policy = controller.policy
        pose = belief.pose
        shift = self.shift
        length_m = belief.spring_m
        way = self.way.advance(goal, pose - self.behind, controller)
        goal = goal + self.behind + way.correction
        for _ in range(policy.n_actions):
            length_m = planned(belief, pose, goal + shift)
            pose = pose_of(policy, length_m, belief.load.believed_kg)
            shift = clipped(shift - asked_error(pose, goal, policy.reward))
        shape, behind = self.shape.advance(policy, length_m, belief.load.believed_kg, controller.dt_s)

        # Lengths due now, their rate, and the lag of springs that move so
        n_ticks = 2 * max(1, round(0.5 * RATE_S / controller.dt_s))
        lengths_m = (*self.lengths_m, length_m)[-n_ticks - 1 :]
        rate = (lengths_m[-1] - lengths_m[0]) / (controller.dt_s * max(len(lengths_m) - 1, 1))
        lag_s = spring_lag_s(policy, belief.command.pressure_kpa)
        reference_m = lengths_m[(len(lengths_m) - 1) // 2] + lag_s @ rate
        return Predicting(way, shift, lengths_m, shape, behind), reference_m, ()


class Chasing(NamedTuple):
    """Actions of a policy of motion towards a moving goal: one in each tick.

    It observes as its last action that of `Policy.action_s` seconds ago, as in training. Circle in 20 s, four
    policies of TQC and two of `motion-analytic`: 3.1 and 1.5 mm; with an action every 0.5 s 3.5 and 1.8 mm.
    """

    way: WayError
    references_m: tuple[np.ndarray | None, ...] = ()  # (n_springs,) each, of the last ticks, oldest first
    shape: ShapeLag = ShapeLag()

    def references(self, belief: Belief, goal: np.ndarray) -> Answer:
        # Pose in motion, and the goal corrected by its error on the way
        controller = belief.controller
        load_kg = belief.load.believed_kg
        shape, behind = self.shape.advance(controller.policy, belief.spring_m, load_kg, controller.dt_s)
        pose = belief.pose - behind
        way = self.way.advance(goal, pose, controller)

        # The last action that it observes, from those in force at the stop on
        last_m = self.references_m or (belief.command.reference_m,)
        seen = observed(belief, last_m[0])
        reference_m = controller.plan(pose, goal + way.correction, belief.spring_m, seen)
        n_ticks = max(1, round(controller.policy.action_s / controller.dt_s))
        return Chasing(way, (*last_m, reference_m)[-n_ticks:], shape), reference_m, ()


def to_moving_goal(policy: Policy, lead_s: float) -> Predicting | Chasing:
    """Return the strategy for a goal that begins to move and is given a time [s] ahead."""
    way = WayError(lead_s)
    return Chasing(way) if policy.action_s else Predicting(way)


def lead_of(controller: Controller) -> tuple[float, float]:
    """Return the lead [s] of a moving goal, and the time [s] until an arm at rest answers to such a goal.

    The second is of whole ticks. For a policy of motion it takes seconds to find them.
    """
    policy = controller.policy
    if policy.action_s:
        lead_s = round(max(0.0, tip_lag_s(controller)) * policy.rate_hz) / policy.rate_hz
        return lead_s, lead_s
    # The rate of the references is known after `RATE_S`, and the actuators have a dead time
    lead_s = float(np.mean(policy.gains.reference_s)) + 0.5 * RATE_S
    start_s = RATE_S + float(np.mean(policy.spec.actuators.delay_s))
    return lead_s, round(start_s * policy.rate_hz) / policy.rate_hz


def tip_lag_s(controller: Controller) -> float:
    """Return the time [s] by which the tip of an arm with a policy of motion is behind a moving goal.

    Goals swing sinusoidally between two poses that the arm reaches. The lag is the phase of the tip's motion
    along the line between them, after half a period; the median of several goals.
    """
    policy = controller.policy
    rng = np.random.default_rng(0)
    n_ticks = round(_SWING_S * policy.rate_hz)
    low, high = policy.gains.pressure_min_kpa, policy.gains.pressure_max_kpa
    phase = 2.0 * np.pi * np.arange(3 * n_ticks // 2) / n_ticks

    lags_s = []
    for _ in range(_N_SWINGS):
        shares = 0.5 + _SWING * rng.uniform(-1.0, 1.0, (2, policy.spec.n_chambers))
        ends_kpa = low + (high - low) * shares
        ends_m = expected_springs(policy.spring_model, ends_kpa)
        first, last = (pose_of(policy, spring_m, 0.0) for spring_m in ends_m)
        swing = pose_error(last, first)
        goals = first + 0.5 * (1.0 - np.cos(phase))[:, None] * swing
        along = _tip_path(controller, ends_kpa[0], goals) @ swing[:3]
        phasor = -np.sum((along * np.exp(1j * phase))[-n_ticks:])  # of the tip, relative to the goal
        lags_s.append(np.angle(phasor) / (2.0 * np.pi) * _SWING_S)
    return float(np.median(lags_s))


def _tip_path(controller: Controller, pressure_kpa: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Return the tip's positions (t, 3) [mm] for goals (t, 6) of ticks, of an arm that begins at rest.

    The law, the actuators and the shape move in time; springs are those at rest with the pressures. Chambers
    have the volumes of the straight arm.
    """
    # The arm at rest
    policy = controller.policy
    dt_s = controller.dt_s
    straight_m = policy.spec.at_chambers(policy.spec.geometry.section_length_m)
    air = policy.spec.pneumatics(straight_m, dt_s)
    air.hold(pressure_kpa, straight_m)
    spring_m = _springs(policy, pressure_kpa)
    law = LawState.at_rest(pressure_kpa, spring_m)

    # References and pressures of each tick
    lengths_m = [spring_m]
    references_m = [spring_m]
    tip_mm = []
    shape = ShapeLag()
    for goal in goals:
        shape, behind = shape.advance(policy, spring_m, 0.0, dt_s)
        at_rest = pose_of(policy, spring_m, 0.0)
        pose = at_rest - behind
        tip_mm.append(pose[:3])
        motion = InMotion(lengths_m[0], references_m[0], law.integral_kpa)
        reference_m = controller.plan(pose, goal, spring_m, sensed(policy, at_rest, spring_m, motion, 0.0))
        command_kpa, law = pressures(reference_m, spring_m, law, policy.gains, dt_s)
        air.command(command_kpa)
        spring_m = _springs(policy, air.step(straight_m))
        lengths_m = [*lengths_m, spring_m][-1 - rate_ticks(policy.rate_hz) :]
        references_m = [*references_m, reference_m][-max(1, round(policy.action_s / dt_s)) :]
    return np.array(tip_mm)


def _springs(policy: Policy, pressure_kpa: np.ndarray) -> np.ndarray:
    return np.asarray(expected_springs(policy.spring_model, pressure_kpa), float)
