"""Distances of goals to reachable poses, and goals brought back into the workspace."""

import numpy as np
import pytest

from mjx_softarm.deploy.loop import start, with_goal
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy.reach import Reachable, clamped, nearest
from tests.linear_arm import CONTROLLER, FAR, GOALS


def away(goal):
    return nearest(CONTROLLER.reachable, goal)[1]


def near(goal):
    return clamped(CONTROLLER.reachable, goal)


def test_distance_to_reachable_poses():
    reward = RewardConfig()
    pose = np.array([[0, 0, -600, 0, 0, 0], [0, 0, -590, 0, 0, 0], [0, 30, -600, 0, 0, 0]], float)
    found = Reachable.from_poses(pose, reward)
    assert found.limit == pytest.approx(30 * reward.weight_per_mm)
    near, distance = nearest(found, np.array([0, 60, -600, 0, 0, 0]))
    np.testing.assert_array_equal(near, pose[2])
    assert distance == pytest.approx(1.0)
    _, turned = nearest(found, np.array([0, 0, -600, 0, 0, 90]))
    assert turned == pytest.approx(90 * reward.weight_per_deg / found.limit)


@pytest.mark.parametrize(
    ("axes", "turn_deg"), [((1, 1, 1, 0, 0, 0), 0.0), ((1, 1, 1, 0, 1, 1), 0.0), ((1, 1, 1, 3, 1, 1), 6.0)]
)
def test_distance_weighs_the_axes_of_the_goal(axes, turn_deg):
    pose = np.array([[0, 0, -600, 0, 0, 0], [0, 0, -590, 0, 0, 0], [0, 30, -600, 0, 0, 0]], float)
    reward = RewardConfig(axes=tuple(map(float, axes)))
    found = Reachable.from_poses(pose, reward)
    _, distance = nearest(found, np.array([0, 0, -600, 2, 0, 0]))
    assert distance * found.limit == pytest.approx(turn_deg * reward.weight_per_deg, rel=1e-3, abs=1e-6)


def test_goal_within_the_workspace_stays():
    for goal in GOALS:
        np.testing.assert_array_equal(near(goal), goal)


def test_goal_outside_comes_back_and_is_accepted():
    rng, state = np.random.default_rng(0), start(CONTROLLER)
    far = GOALS[0] + rng.uniform(-1, 1, (50, 6)) * [900, 900, 900, 120, 60, 120]
    for goal in [FAR, *far]:
        assert with_goal(CONTROLLER, state, goal)[1] or away(goal) <= 1.0
        accepted, events = with_goal(CONTROLLER, state, near(goal))
        assert events == () and accepted.goal is not None


def test_goal_is_left_on_the_way_from_the_nearest_pose():
    pose, distance = nearest(CONTROLLER.reachable, FAR)
    assert distance > 1.0
    way, part = FAR[:3] - pose[:3], near(FAR)[:3] - pose[:3]
    np.testing.assert_allclose(np.cross(way, part), 0.0, atol=1e-6 * (way @ way))
    np.testing.assert_allclose(np.linalg.norm(part) / np.linalg.norm(way), 0.99 / distance, rtol=1e-6)
