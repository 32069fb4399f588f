"""Reachability of goals: by a search, on an arm with a closed form; by distances to stored poses."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm.deploy.goals import with_goal
from mjx_softarm.deploy.loop import start
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy.reach import Reachable, clamped, nearest, nearest_poses
from mjx_softarm.sensing.estimator import estimate
from tests.linear_arm import CONTROLLER, FAR, GAIN_M_PER_KPA, GOALS, HIGH_KPA, LOW_KPA, POLICY, REST_M, N


def poses(pressure_kpa):
    return estimate(POLICY.estimator, REST_M + np.asarray(pressure_kpa) @ GAIN_M_PER_KPA.T, 0.0).astype(float)


def test_poses_between_the_limits_are_reached():
    goals = poses(np.random.default_rng(5).uniform(LOW_KPA, HIGH_KPA, (100, N)))
    near, error = nearest_poses(POLICY, goals)
    assert error.max() < 0.1 * POLICY.reward.threshold
    np.testing.assert_allclose(near[:, :3], goals[:, :3], atol=0.6)


@pytest.mark.parametrize(("limit_kpa", "sign"), [(LOW_KPA, 1.0), (HIGH_KPA, -1.0)])
@pytest.mark.parametrize("beyond_mm", [2.0, 25.0])
def test_straight_arm_ends_where_its_limits_do(limit_kpa, sign, beyond_mm):
    """All chambers at one limit give the shortest or the longest straight arm; all else is less far."""
    [end] = poses(np.full((1, N), limit_kpa))
    goal = np.array([[0.0, 0.0, end[2] + sign * beyond_mm, 0.0, 0.0, 0.0]])
    [near], [error] = nearest_poses(POLICY, goal)
    np.testing.assert_allclose(near[:3], [0.0, 0.0, end[2]], atol=0.5)
    assert error == pytest.approx(beyond_mm * POLICY.reward.weight_per_mm, rel=0.1)
    assert (error > POLICY.reward.threshold) == (beyond_mm > 10.0)


def test_a_turn_that_no_pressures_give_is_told_where_it_is_asked_for():
    turned = np.array([[0.0, 0.0, -600.0, 90.0, 0.0, 0.0]])  # an arm without torsion
    [near], [error] = nearest_poses(POLICY, turned)
    assert error > POLICY.reward.threshold and abs(near[3]) < 60.0
    policy = dataclasses.replace(POLICY, reward=RewardConfig(axes=(1.0, 1.0, 1.0, 0.0, 1.0, 1.0)))
    [near], [error] = nearest_poses(policy, turned)
    assert error < 0.1 * policy.reward.threshold
    np.testing.assert_allclose(near[:3], [0.0, 0.0, -600.0], atol=0.6)


@pytest.mark.parametrize(
    ("axes", "turn_deg"),
    [((1,) * 6, 2.0), ((1, 1, 1, 0, 0, 0), 0.0), ((1, 1, 1, 0, 1, 1), 0.0), ((1, 1, 1, 3, 1, 1), 6.0)],
)
def test_distance_to_reachable_poses_weighs_the_axes_of_the_goal(axes, turn_deg):
    pose = np.array([[0, 0, -600, 0, 0, 0], [0, 0, -590, 0, 0, 0], [0, 30, -600, 0, 0, 0]], float)
    reward = RewardConfig(axes=tuple(map(float, axes)))
    reachable = Reachable.from_poses(pose, reward)
    assert reachable.limit == pytest.approx(30 * reward.weight_per_mm)
    near, distance = nearest(reachable, np.array([0, 60, -600, 0, 0, 0]))
    np.testing.assert_array_equal(near, pose[2])
    assert distance == pytest.approx(1.0)
    _, turned = nearest(reachable, np.array([0, 0, -600, 2, 0, 0]))
    assert turned * reachable.limit == pytest.approx(turn_deg * reward.weight_per_deg, rel=1e-3, abs=1e-6)


def test_goal_outside_comes_back_and_is_accepted():
    rng, state = np.random.default_rng(0), start(CONTROLLER)
    for goal in GOALS:
        np.testing.assert_array_equal(clamped(CONTROLLER.reachable, goal), goal)
    far = GOALS[0] + rng.uniform(-1, 1, (50, 6)) * [900, 900, 900, 120, 60, 120]
    for goal in [FAR, *far]:
        assert with_goal(state, goal)[1] or nearest(CONTROLLER.reachable, goal)[1] <= 1.0
        accepted, events = with_goal(state, clamped(CONTROLLER.reachable, goal))
        assert events == () and accepted.goal is not None


def test_goal_is_left_on_the_way_from_the_nearest_pose():
    pose, distance = nearest(CONTROLLER.reachable, FAR)
    assert distance > 1.0
    way, part = FAR[:3] - pose[:3], clamped(CONTROLLER.reachable, FAR)[:3] - pose[:3]
    np.testing.assert_allclose(np.cross(way, part), 0.0, atol=1e-6 * (way @ way))
    np.testing.assert_allclose(np.linalg.norm(part) / np.linalg.norm(way), 0.99 / distance, rtol=1e-6)
