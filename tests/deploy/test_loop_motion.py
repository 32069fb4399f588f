"""Policies of motion in the loop: their last references, their goals on a way."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.session import trace
from tests.linear_arm import POLICY, LinearArm, N, go

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
