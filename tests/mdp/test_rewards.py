"""The reward's cases, worked out by hand."""

import numpy as np
import pytest

from mjx_softarm.mdp import rewards
from mjx_softarm.mdp.rewards import RewardConfig, asked_error, reward, scaled_error
from mjx_softarm.sensing.pose import frame_from_pose

CONFIG = RewardConfig()
HERE = np.array([10.0, -20.0, -500.0, 30.0, -40.0, 50.0])


def away(*offset):
    """A goal so that pose - goal is the offset [mm, deg], with HERE the pose."""
    return HERE - np.array(offset + (0.0,) * (6 - len(offset)))


def reward_of(goal, n_steps=1, saturated=False, config=CONFIG):
    return reward(HERE, goal, n_steps, np.asarray(saturated), config)


@pytest.mark.parametrize(
    ("offset", "n_steps", "expected"),
    [
        ((100.0,), 3, -10 * 0.56 - 0.3),
        ((0.0, -100.0), 1, -10 * 0.56 - 0.1),
        ((30.0, 0.0, 40.0), 2, -10 * 0.28 - 0.2),  # 50 mm
        ((0.0, 0.0, 0.0, 0.0, 0.0, 90.0), 4, -10 * 0.09 - 0.4),
        ((0.0, 0.0, 5.0, 0.0, 45.0), 1, -10 * np.hypot(0.028, 0.045) - 0.1),
    ],
)
def test_on_the_way_the_error_and_each_step_cost(offset, n_steps, expected):
    value, reached, terms = reward_of(away(*offset), n_steps)
    assert value == pytest.approx(expected, rel=1e-9) and not reached
    assert terms["steps"] == pytest.approx(-0.1 * n_steps)
    assert terms["goal"] == terms["saturation"] == 0.0


# 0.03 / 0.0056 = 5.357 mm
@pytest.mark.parametrize(("mm", "expected"), [(0.0, True), (5.35, True), (5.36, False)])
def test_the_goal_is_reached_within_the_threshold(mm, expected):
    value, reached, terms = reward_of(away(mm), n_steps=7)
    flags = reached, value == 100.0, terms["goal"] == 100.0, terms["steps"] == 0.0, terms["error"] == 0.0
    assert {bool(flag) for flag in flags} == {expected}


@pytest.mark.parametrize("mm", [0.0, 100.0])
def test_saturation_overrules_all_else_even_a_reached_goal(mm):
    value, reached, terms = reward_of(away(mm), n_steps=3, saturated=True)
    assert value == -100.0 and not reached
    others = dict.fromkeys(("goal", "error", "steps", "distance", "clearance"), 0.0)
    assert terms == {"saturation": -100.0, **others}


@pytest.mark.parametrize(
    ("mm", "saturated", "rest"), [(1.0, False, 100.0), (1.0, True, -100.0), (50.0, False, -2.9)]
)
def test_a_distance_costs_in_every_case(mm, saturated, rest):
    config = RewardConfig(distance_cost=200.0)
    value, _, terms = reward_of(away(mm), saturated=saturated, config=config)
    assert terms["distance"] == pytest.approx(-200.0 * 0.0056 * mm)
    assert value == pytest.approx(rest - 200.0 * 0.0056 * mm)


def test_every_weight_of_the_config_counts():
    config = RewardConfig(7.0, 2.0, 0.5, 3.0, threshold=0.5, weight_per_mm=0.1, weight_per_deg=0.2)
    assert reward_of(away(4.0), config=config)[0] == 7.0
    assert reward_of(away(10.0), 3, config=config)[0] == pytest.approx(-2.0 * 1.0 - 0.5 * 3)
    assert reward_of(away(0.0, 0.0, 0.0, 10.0), 3, config=config)[0] == pytest.approx(-2.0 * 2.0 - 0.5 * 3)
    assert reward_of(away(0.0), saturated=True, config=config)[0] == -3.0


YAW = RewardConfig(axes=(1.0, 1.0, 1.0, 3.0, 1.0, 0.0))


def test_axes_multiply_the_weights_and_0_leaves_an_axis_out():
    goal = away(10.0, 20.0, -10.0, 10.0, -10.0, 10.0)
    weighted = [0.056, 0.112, -0.056, 0.01, -0.01, 0.01]
    np.testing.assert_allclose(scaled_error(HERE, goal, CONFIG), weighted, atol=1e-12)
    weighted[3:] = 0.03, -0.01, 0.0
    np.testing.assert_allclose(scaled_error(HERE, goal, YAW), weighted, atol=1e-12)
    np.testing.assert_allclose(asked_error(HERE, goal, YAW), [10, 20, -10, 10, -10, 0], atol=1e-12)
    position = RewardConfig(axes=(1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
    value, reached, _ = reward_of(away(0.0, 0.0, 0.0, 90.0, 30.0, 170.0), config=position)
    assert reached and value == position.goal_bonus


def test_small_errors_of_weighted_angles_and_positions_are_the_scaled_error():
    goal = away(3.0, -2.0, 1.0, 0.2, -0.1, 0.3)
    (position_m, rotation), (goal_m, goal_rotation) = map(frame_from_pose, (HERE, goal))
    moved = rewards.weighted_position(position_m, YAW) - rewards.weighted_position(goal_m, YAW)
    turned = rewards.weighted_angles(rotation, YAW) - rewards.weighted_angles(goal_rotation, YAW)
    expected = scaled_error(HERE, goal, YAW)
    np.testing.assert_allclose(moved, expected[:3], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(turned), np.linalg.norm(expected[3:]), rtol=1e-4)
