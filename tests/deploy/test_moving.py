"""Moving goals and policies of motion: corrections of goals, leads, the lag of the shape."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.moving import ShapeLag, WayError, tip_lag_s
from mjx_softarm.deploy.session import trace
from mjx_softarm.policy.lag import spring_lag_s
from mjx_softarm.sensing.estimator import estimate_frame
from mjx_softarm.sensing.s2r import inputs
from tests.linear_arm import DT_S, POLICY, SPEC, LinearArm, N, go, moves_aside
from tests.networks import s2r_of


@pytest.mark.parametrize("n_lead", [0, 1, 25])
def test_an_error_that_stays_beside_a_round_way_is_made_up_for(n_lead):
    """The tip is late, wide and high by constants in the axes of the way, less the correction of its goal."""
    way, corrected, per_tick, n_ago = WayError(n_lead * DT_S), [], 2 * np.pi / 20.0 * DT_S, max(n_lead, 1)
    controller = Controller.of(POLICY)

    def axes(k):
        at = k * per_tick
        outward = np.array([np.cos(at), np.sin(at), 0.0])
        return outward, np.array([-np.sin(at), np.cos(at), 0.0]), np.array([0.0, 0.0, 1.0])

    for k in range(1500):
        now, ahead = (np.append(80.0 * axes(tick)[0], np.zeros(3)) for tick in (k, k + n_lead))
        late = corrected[-n_ago] if len(corrected) >= n_ago else np.zeros(6)  # the correction is in force
        outward, along, up = axes(k)
        off_mm = 3.0 * outward - 4.0 * along + 2.0 * up
        way = way.advance(ahead, now + np.append(off_mm, np.zeros(3)) + late, controller)
        corrected.append(way.correction)
    assert np.linalg.norm(off_mm + late[:3]) < 0.02 * np.linalg.norm(off_mm)
    assert not corrected[n_lead].any() and not way.correction[3:].any()


@pytest.mark.parametrize("load_kg", [0.0, 1.0])
@pytest.mark.parametrize("corrected", [False, True])
def test_the_shape_lags_by_the_time_constant_of_the_backbone_and_is_at_rest_with_the_springs(
    load_kg, corrected
):
    """The payload doubles what lags; a sim-to-real network that turns with the springs does not lag."""
    policy = moves_aside(POLICY)
    if corrected:
        straight_m = np.full(N, SPEC.geometry.section_length_m, np.float32)
        n_in = len(inputs(estimate_frame(policy.estimator, straight_m, 0.0), straight_m))
        layers = ((np.full((n_in, 6), 0.1, np.float32), np.zeros(6, np.float32)),)
        policy = dataclasses.replace(policy, s2r=s2r_of(layers, 0.1))
    lag_s, rate_m_per_s = SPEC.shape_lag_s, 5e-3 * (np.arange(N) == N - 1)
    start_m = np.full(N, SPEC.geometry.section_length_m)  # the straight arm, whose plates are level
    shape, behind = ShapeLag().advance(policy, start_m, load_kg, DT_S)
    assert not behind.any()
    for k in range(1, round(8.0 * lag_s / DT_S)):
        spring_m = start_m + k * DT_S * rate_m_per_s
        shape, behind = shape.advance(policy, spring_m, load_kg, DT_S)
    expected_mm = 2.5 * (1.0 + load_kg) * lag_s  # 5 mm/s of the spring
    np.testing.assert_allclose(behind, [expected_mm, 0.0, 0.0, 0.0, 0.0, 0.0], rtol=1e-3, atol=2e-3)
    for _ in range(round(12.0 * lag_s / DT_S)):
        shape, behind = shape.advance(policy, spring_m, load_kg, DT_S)
    np.testing.assert_allclose(behind, 0.0, atol=1e-3)


# Chambers of a section lengthen all its springs alike, so that the tip moves up and down
_GAIN = np.kron(np.eye(SPEC.structure.n_sections), np.full((3, 3), 3e-4)).astype(np.float32)
_SPRINGS = POLICY.spring_model._replace(layers=((_GAIN, np.zeros(N, np.float32)),))
OF_MOTION = dataclasses.replace(POLICY, spring_model=_SPRINGS, action_s=0.3)


def high(pose, goal, spring_m, sensed):
    """Springs of the straight arm at the goal's height."""
    return np.full(N, -1e-3 * goal[2] / 3)


@pytest.mark.parametrize("slower", [1.0, 2.0])
def test_the_tip_lags_by_the_law(slower):
    """By the time in which a reference is approached, the lag of the springs and a tick."""
    gains = OF_MOTION.gains._replace(ki_kpa_per_ms=OF_MOTION.gains.ki_kpa_per_ms / slower)
    policy = dataclasses.replace(OF_MOTION, gains=gains)
    law_s = np.mean(spring_lag_s(policy, np.zeros(N)) @ np.ones(N))
    lag_s = tip_lag_s(Controller.of(policy, high))
    assert lag_s == pytest.approx(SPEC.control.reference_s + law_s + DT_S, rel=0.1)


GOAL = np.array([0.0, 0.0, -585.0, 0.0, 0.0, 0.0])


def test_the_last_references_of_a_policy_of_motion_make_the_goal_by_its_own_models():
    """Its references miss goals by 3 mm and a third more than they are asked to move."""

    def plan(pose, goal, spring_m, sensed):
        asked_mm.append(goal[2] - GOAL[2])
        off = GOAL + [0.0, 0.0, 3.0 + 1.33 * asked_mm[-1], 0.0, 0.0, 0.0]
        return high(pose, off, spring_m, sensed)

    asked_mm = []
    of_motion = dataclasses.replace(POLICY, action_s=0.1)
    run = go(LinearArm(), [GOAL], Controller.of(of_motion, plan))
    assert asked_mm[: of_motion.n_actions] == of_motion.n_actions * [0.0]
    off_mm = (run.log.estimate - run.log.goal)[run.arrivals[0].row, 2]
    assert asked_mm[-1] == pytest.approx(-3.0 / 1.33, abs=0.1) and abs(off_mm) < 0.3


def test_a_policy_of_motion_makes_up_for_an_offset_beside_the_way_and_for_its_lag():
    def plan(pose, goal, spring_m, sensed):
        off_mm = 8.0 if goal[0] > 5.0 else 0.0  # from 5 s after the first stop on
        return high(pose, goal + [0.0, 0.0, off_mm, 0.0, 0.0, 0.0], spring_m, sensed)

    of_motion = dataclasses.replace(POLICY, action_s=0.1)
    aside = np.array([GOAL, GOAL + [20.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    run = trace(LinearArm(), Controller.of(of_motion, plan), aside, pace_s=20.0)
    off_mm = (run.log.estimate - run.log.goal)[run.ways[0]]
    assert abs(off_mm[100:250, 2]).max() > 4.0 and abs(off_mm[-300:, 2]).max() < 1.0
    assert abs(off_mm[:, 0]).max() > 19.0  # this arm moves up and down alone

    up = np.array([GOAL, GOAL + [0.0, 0.0, 60.0, 0.0, 0.0, 0.0]])
    run = trace(LinearArm(), Controller.of(of_motion, high), up, pace_s=10.0)
    off_mm = abs((run.log.estimate - run.log.goal)[run.ways[0], 2])
    assert off_mm.max() > 1.0 and off_mm[300:450].mean() < 0.3  # its lag is not that of its models
