"""Policies of motion in the loop: their last references, their goals on a way."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.session import trace
from mjx_softarm.deploy.way_error import WayError
from tests.linear_arm import CONTROLLER, DT_S, POLICY, LinearArm, N, go

GOAL = np.array([0.0, 0.0, -585.0, 0.0, 0.0, 0.0])


def straight(pose, goal, spring_m, sensed):
    """Springs of the straight arm at the goal's height."""
    return np.full(N, -1e-3 * goal[2] / 3)


def test_the_last_references_of_a_policy_of_motion_make_the_goal_by_its_own_models():
    """Its references miss goals by 3 mm and a third more than they are asked to move."""

    def plan(pose, goal, spring_m, sensed):
        asked_mm.append(goal[2] - GOAL[2])
        off = GOAL + [0.0, 0.0, 3.0 + 1.33 * asked_mm[-1], 0.0, 0.0, 0.0]
        return straight(pose, off, spring_m, sensed)

    asked_mm = []
    of_motion = dataclasses.replace(POLICY, action_s=0.1)
    run = go(LinearArm(), [GOAL], Controller.of(of_motion, plan))
    assert asked_mm[: of_motion.n_actions] == of_motion.n_actions * [0.0]
    off_mm = (run.log.estimate - run.log.goal)[run.arrivals[0].row, 2]
    assert asked_mm[-1] == pytest.approx(-3.0 / 1.33, abs=0.1) and abs(off_mm) < 0.3


def test_a_policy_of_motion_makes_up_for_an_offset_beside_the_way_and_for_its_lag():
    def plan(pose, goal, spring_m, sensed):
        off_mm = 8.0 if goal[0] > 5.0 else 0.0  # from 5 s after the first stop on
        return straight(pose, goal + [0.0, 0.0, off_mm, 0.0, 0.0, 0.0], spring_m, sensed)

    of_motion = dataclasses.replace(POLICY, action_s=0.1)
    aside = np.array([GOAL, GOAL + [20.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    run = trace(LinearArm(), Controller.of(of_motion, plan), aside, pace_s=20.0)
    off_mm = (run.log.estimate - run.log.goal)[run.ways[0]]
    assert abs(off_mm[100:250, 2]).max() > 4.0 and abs(off_mm[-300:, 2]).max() < 1.0
    assert abs(off_mm[:, 0]).max() > 19.0  # this arm moves up and down alone

    up = np.array([GOAL, GOAL + [0.0, 0.0, 60.0, 0.0, 0.0, 0.0]])
    run = trace(LinearArm(), Controller.of(of_motion, straight), up, pace_s=10.0)
    off_mm = abs((run.log.estimate - run.log.goal)[run.ways[0], 2])
    assert off_mm.max() > 1.0 and off_mm[300:450].mean() < 0.3  # its lag is not that of its models


def test_an_error_that_stays_beside_a_round_way_is_made_up_for():
    """The tip is late, wide and high by constants in the axes of the way, less the correction of its goal."""
    way, corrected = WayError(), []
    n_lead, per_tick = round(CONTROLLER.lead_s / DT_S), 2 * np.pi / 20.0 * DT_S

    def axes(k):
        at = k * per_tick
        outward = np.array([np.cos(at), np.sin(at), 0.0])
        return outward, np.array([-np.sin(at), np.cos(at), 0.0]), np.array([0.0, 0.0, 1.0])

    for k in range(1500):
        now, ahead = (np.append(80.0 * axes(tick)[0], np.zeros(3)) for tick in (k, k + n_lead))
        late = corrected[-n_lead] if len(corrected) >= n_lead else np.zeros(6)  # the correction is in force
        outward, along, up = axes(k)
        off_mm = 3.0 * outward - 4.0 * along + 2.0 * up
        way = way.after(ahead, now + np.append(off_mm, np.zeros(3)) + late, CONTROLLER)
        corrected.append(way.correction)
    assert np.linalg.norm(off_mm + late[:3]) < 0.02 * np.linalg.norm(off_mm)
    assert not corrected[n_lead].any() and not way.correction[3:].any()
