"""Evaluation on demonstrated positions: figures, walls, and the first stage told apart."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.env import Randomisation, ReachEnv
from train.runs.evaluate import Reached
from train.runs.positions import N_STARTS, PositionEvaluator, summarise

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture
def perfect(short_env, shown):
    """A learner whose policy knows every answer; `policy` is the error [mm] below which it turns away."""

    class Perfect:
        def mode(self, policy, obs):
            goal = obs[6:12] * short_env.scale.scale + short_env.scale.centre
            nearest = jnp.argmin(jnp.sum((jnp.asarray(shown.positions) - goal) ** 2, axis=-1))
            answer, off_mm = jnp.asarray(shown.actions)[nearest], jnp.linalg.norm(obs[12:15]) / 0.0056
            return jnp.where(off_mm < policy, -answer, answer)

    return Perfect()


@pytest.fixture
def evaluator(perfect, shown):
    """An environment -> its evaluation, half of the positions in the first stage."""

    def make(env, n_actions=4):
        first = np.arange(len(shown.positions)) % 2 == 0
        return PositionEvaluator(env, perfect, shown, first, n_actions)

    return make


def changed(env, **config):
    return ReachEnv(env.spec, dataclasses.replace(env.config, **config))


@pytest.mark.parametrize("pipe_mm", [None, 130.0], ids=["open", "narrower than the arm"])
def test_positions_are_evaluated_with_body_and_pressures(short_env, evaluator, shown, pipe_mm):
    n = len(shown.positions)
    figures, at = evaluator(changed(short_env, pipe_diameter_mm=pipe_mm))(0.0)
    assert figures.reached_share == 1.0 and figures.max_mm < 0.05 and len(figures.error_mm) == n
    assert (
        figures.success_share == (pipe_mm is None) and figures.outside_positions == (pipe_mm is not None) * n
    )
    assert (np.isinf(at.reached.clearance_mm) if pipe_mm is None else at.reached.clearance_mm < 0.0).all()
    assert figures.held_share is None


def test_in_motion_arms_have_to_stay_with_the_body_inside_all_the_way(
    short_env, moving_env, evaluator, shown
):
    """A policy that knows the answers, in actions of a second, in a pipe that the arm just fits."""
    config = {"pipe_diameter_mm": 300.0, "dynamic_step_s": 1.0}
    at_rest = evaluator(changed(short_env, **config))
    moving = at_rest.on(changed(moving_env, **config))
    (_, rest), (figures, motion) = at_rest(0.0), moving(0.0)
    assert figures.median_mm < 2.0 and figures.unsettled == 0
    # Each position is visited from every start, and the way to it counts.
    m = len(shown.positions)
    at = np.arange(N_STARTS * m) % m
    np.testing.assert_array_equal(motion.position, at)
    np.testing.assert_array_equal(motion.reached.goal, np.asarray(shown.positions)[at])
    np.testing.assert_array_equal(np.reshape(figures.success, -1), motion.success)
    less_mm = rest.reached.clearance_mm[at] - motion.reached.clearance_mm
    assert less_mm.min() > -2.0 and less_mm.max() > 10.0
    # A policy that turns away where it has arrived does not hold a position.
    assert figures.held_share > 0.9 and moving(4.0)[0].held_share < 0.1


def test_in_motion_an_arm_on_its_way_has_not_succeeded(moving_env, evaluator):
    """One action of 0.2 s is too short; arms with payloads of their own are not at one place after it."""
    randomisation = Randomisation(payload_max_kg=0.5)
    figures, at = evaluator(changed(moving_env, dynamic_step_s=0.2, randomisation=randomisation), 1)(0.0)
    assert figures.success_share == figures.held_share == 0.0 and figures.reached_share < 0.1
    tip_mm = at.reached.pose.reshape(N_STARTS, -1, 6)[:, 3, :3]
    assert len(np.unique(np.round(tip_mm, 2), axis=0)) == N_STARTS


def test_an_arm_that_diverges_at_a_position_does_not_hold_it(moving_env, evaluator, monkeypatch):
    """It keeps its last pose there; the policy says whether actions succeed."""
    zero = jnp.zeros(())

    def reach(env, learner, policy, state, goal, n_actions):
        return state, Reached(goal, goal, zero, zero, policy > 0.0, zero, zero, zero, zero)

    monkeypatch.setattr("train.runs.positions.reach", reach)
    evaluate = evaluator(moving_env)
    assert [evaluate(policy)[0].held_share for policy in (1.0, 0.0)] == [1.0, 0.0]


def test_success_at_the_first_stages_positions_is_told_apart():
    zero, poses = np.zeros((1, 3)), np.zeros((1, 3, 6))
    reached = Reached(poses, poses, zero, zero, zero == 0, zero, np.array([[5.0, -1, -1]]), zero, zero)
    figures, _ = summarise(reached, None, 0.03, np.array([True, True, False]))
    assert (figures.success_share, figures.success_first_share) == (pytest.approx(1 / 3), 0.5)
    assert figures.outside_positions == 2


def test_a_position_counts_as_saturated_or_outside_from_any_start():
    zero, poses = np.zeros((2, 3)), np.zeros((2, 3, 6))
    saturated, clearance_mm = np.array([[0, 1, 0], [0, 2, 0]]), np.array([[5.0, 5, -1], [-1, 5, 5]])
    reached = Reached(poses, poses, zero, saturated, zero == 0, zero, clearance_mm, zero, zero)
    held = np.array([[True, True, True], [True, True, False]])
    figures, at = summarise(reached, held, 0.03, np.ones(3, bool))
    assert (figures.saturated_positions, figures.outside_positions) == (1, 2)
    assert figures.success == ((True, False, False), (False, False, False))
    assert figures.held_share == pytest.approx(5 / 6) and at.success.sum() == 1


def test_an_evaluation_at_rest_corrects_positions(short_env, evaluator, shift_limit):
    found = evaluator(short_env).on(short_env, 1, shift_limit)(0.0)[1]
    assert (found.reached.near_s == shift_limit[0]).all()
