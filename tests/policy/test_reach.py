"""Nearest reachable poses on the linear arm, whose pressures give the tip in closed form."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy.reach import nearest_poses
from mjx_softarm.sensing.estimator import estimate
from tests.linear_arm import GAIN_M_PER_KPA, HIGH_KPA, LOW_KPA, POLICY, REST_M, N


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


def test_turns_that_no_pressures_give_are_told():
    turned = np.array([[0.0, 0.0, -600.0, 90.0, 0.0, 0.0]])  # an arm without torsion
    [near], [error] = nearest_poses(POLICY, turned)
    assert error > POLICY.reward.threshold and abs(near[3]) < 60.0


def test_a_turn_that_is_not_asked_for_costs_nothing():
    policy = dataclasses.replace(POLICY, reward=RewardConfig(axes=(1.0, 1.0, 1.0, 0.0, 1.0, 1.0)))
    turned = np.array([[0.0, 0.0, -600.0, 90.0, 0.0, 0.0]])
    [near], [error] = nearest_poses(policy, turned)
    assert error < 0.1 * policy.reward.threshold
    np.testing.assert_allclose(near[:3], [0.0, 0.0, -600.0], atol=0.6)
