"""Goals brought back into the workspace."""

import numpy as np

from mjx_softarm.deploy.loop import start, with_goal
from mjx_softarm.policy.reachable import clamped, nearest
from tests.linear_arm import CONTROLLER, FAR, GOALS, POLICY


def test_goal_within_the_workspace_stays():
    for goal in GOALS:
        np.testing.assert_array_equal(clamped(CONTROLLER.reachable, goal, POLICY.reward), goal)


def test_goal_outside_comes_back_and_is_accepted():
    rng = np.random.default_rng(0)
    far = GOALS[0] + rng.uniform(-1, 1, (50, 6)) * [900, 900, 900, 120, 60, 120]
    for goal in [FAR, *far]:
        assert (
            with_goal(CONTROLLER, start(CONTROLLER), goal)[1]
            or nearest(CONTROLLER.reachable, goal, POLICY.reward)[1] <= 1.0
        )
        near = clamped(CONTROLLER.reachable, goal, POLICY.reward)
        state, events = with_goal(CONTROLLER, start(CONTROLLER), near)
        assert events == () and state.goal is not None


def test_goal_is_left_on_the_way_from_the_nearest_pose():
    near, (pose, away) = (
        clamped(CONTROLLER.reachable, FAR, POLICY.reward),
        nearest(CONTROLLER.reachable, FAR, POLICY.reward),
    )
    assert away > 1.0
    way, part = FAR[:3] - pose[:3], near[:3] - pose[:3]
    np.testing.assert_allclose(np.cross(way, part), 0.0, atol=1e-6 * (way @ way))
    np.testing.assert_allclose(np.linalg.norm(part) / np.linalg.norm(way), 0.99 / away, rtol=1e-6)
