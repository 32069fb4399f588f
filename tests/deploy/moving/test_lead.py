"""The lag of a policy of motion's tip: the law's, and what its plan adds to it."""

import dataclasses
from collections import deque

import numpy as np
import pytest

from mjx_softarm.deploy.moving.lead import tip_lag_s
from mjx_softarm.mdp.observation import RATE_S, TIP_MM_PER_S
from mjx_softarm.policy.lag import spring_lag_s
from mjx_softarm.policy.runtime import tip_pose
from tests.linear_arm import DT_S, POLICY, SPEC, SPRINGS_M, N, moves_aside

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
    lag_s = tip_lag_s(policy, high)
    assert lag_s == pytest.approx(SPEC.control.reference_s + law_s + DT_S, rel=0.1)


def test_what_a_plan_waits_is_part_of_the_lag():
    kept = deque(maxlen=11)

    def late(pose, goal, spring_m, sensed):
        kept.append(goal)
        return high(pose, kept[0], spring_m, sensed)

    assert tip_lag_s(OF_MOTION, late) - tip_lag_s(OF_MOTION, high) == pytest.approx(10 * DT_S, abs=1e-3)


def test_the_rehearsal_tells_the_policy_of_motion_what_the_loop_tells_it():
    """The tip's velocity is that of poses at rest; the pose itself lags."""
    told = []

    def noting(pose, goal, spring_m, sensed):
        told.append((pose, tip_pose(policy, spring_m, 0.0)[0], sensed))
        return SPRINGS_M[len(told) // 10 % 2]  # moves on, sometimes

    policy = moves_aside(dataclasses.replace(POLICY, observation="motion", action_s=0.3))
    tip_lag_s(policy, noting)
    poses, at_rest, sensed = map(np.array, zip(*told[:200], strict=True))
    moved_mm = at_rest[50:, :3] - at_rest[45:-5, :3]
    velocity = slice(2 * N, 2 * N + 3)
    np.testing.assert_allclose(sensed[50:, velocity] * TIP_MM_PER_S * RATE_S, moved_mm, atol=0.05)
    assert np.abs(poses - at_rest).max() > 1.0
