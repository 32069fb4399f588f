"""The gradient-descent baseline against JAX's gradient, closed forms and its own forward kinematics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.paper.gradient_descent import descend, forward_kinematics, gradient, gradient_descent
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.mdp.rewards import scaled_error
from mjx_softarm.sensing.estimator import estimate
from mjx_softarm.sensing.pose import pose_error
from mjx_softarm.sensing.s2r import correct
from tests.benchmarks.paper.made_up import SPEC, N, make_policy

LOW_M, HIGH_M = SPEC.springs.length_min_m, SPEC.springs.length_max_m


@pytest.fixture(scope="module")
def policy(make_arm_model):
    return make_policy(make_arm_model, s2r=True)


def random_springs(n, seed=0):
    return np.random.default_rng(seed).uniform(0.15, 0.23, (n, N))


def forward(policy, spring_m):
    """The loop's estimate, in float32 as the loop has it."""
    pose = estimate(policy.estimator, spring_m, 0.0)
    return pose if policy.s2r is None else correct(policy.s2r, pose, spring_m)


@pytest.mark.parametrize("s2r", [False, True])
def test_forward_kinematics_are_the_loop_s(make_arm_model, s2r):
    policy, spring_m = make_policy(make_arm_model, s2r=s2r), random_springs(4).astype(np.float32)
    assert np.allclose(forward_kinematics(policy)(spring_m), forward(policy, spring_m), atol=0.01)


def test_gradient_is_that_of_automatic_differentiation(policy):
    here, there = random_springs(2)
    goal = forward_kinematics(policy)(there)

    def cost(spring_m):
        return 0.5 * jnp.sum(pose_error(forward(policy, spring_m), jnp.asarray(goal, jnp.float32)) ** 2)

    expected = jax.jit(jax.grad(cost))(jnp.asarray(here, jnp.float32))
    found = gradient(lambda x: pose_error(forward_kinematics(policy)(x), goal), here)
    assert np.linalg.norm(found - expected) < 2e-3 * np.linalg.norm(expected)


def test_goals_of_the_own_forward_kinematics_are_reached(policy):
    plan, pose_of = gradient_descent(policy), forward_kinematics(policy)
    goals = pose_of(random_springs(2, seed=5))
    for goal in goals:
        spring_m = np.full(N, 0.19)
        for _ in range(N_ACTIONS):  # as the loop asks for them
            spring_m = plan(np.zeros(6), goal, spring_m, None)
        pose = pose_of(spring_m)
        assert np.linalg.norm(pose[:3] - goal[:3]) < 0.2
        # Yaw, which springs along the arm hardly turn, comes last; the paper's goal counts as reached at 1.
        assert np.linalg.norm(scaled_error(pose, goal, policy.reward)) < 0.2 * policy.reward.threshold
        assert np.all((spring_m >= LOW_M) & (spring_m <= HIGH_M))


def test_search_beyond_the_limits_ends_at_them():
    target = np.linspace(0.0, 0.3, N)
    found = descend(lambda x: 1e3 * (x - target), np.full(N, 0.5), np.full(N, 0.1), np.full(N, 0.2))
    assert np.allclose(found, np.clip(target, 0.1, 0.2), atol=5e-5)
