"""Evaluation on demonstrated positions: figures, walls, and the first stage told apart."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.env import ReachEnv
from train.runs.evaluate import Reached
from train.runs.positions import PositionEvaluator, summarise

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture
def perfect(short_env, shown):
    """A learner whose policy knows every answer."""

    class Perfect:
        def mode(self, policy, obs):
            goal = obs[6:12] * short_env.scale.scale + short_env.scale.centre
            nearest = jnp.argmin(jnp.sum((jnp.asarray(shown.positions) - goal) ** 2, axis=-1))
            return jnp.asarray(shown.actions)[nearest]

    return Perfect()


@pytest.mark.parametrize("pipe_mm", [None, 130.0], ids=["open", "narrower than the arm"])
def test_positions_are_evaluated_with_body_and_pressures(short_env, perfect, shown, pipe_mm):
    env = ReachEnv(short_env.spec, dataclasses.replace(short_env.config, pipe_diameter_mm=pipe_mm))
    n = len(shown.positions)
    figures, at = PositionEvaluator(env, perfect, shown.positions, np.arange(n) % 2 == 0)({})
    assert figures.reached_share == 1.0 and figures.max_mm < 0.05 and len(figures.error_mm) == n
    assert (
        figures.success_share == (pipe_mm is None) and figures.outside_positions == (pipe_mm is not None) * n
    )
    assert (np.isinf(at.reached.clearance_mm) if pipe_mm is None else at.reached.clearance_mm < 0.0).all()


def test_in_motion_the_body_has_to_be_inside_all_the_way(short_env, moving_env, perfect, shown):
    """A policy that knows the answers, in actions of a second, in a pipe that the arm just fits."""
    envs = [
        ReachEnv(env.spec, dataclasses.replace(env.config, pipe_diameter_mm=300.0, dynamic_step_s=1.0))
        for env in (short_env, moving_env)
    ]
    at_rest = PositionEvaluator(envs[0], perfect, shown.positions, np.arange(len(shown.positions)) < 1)
    (_, rest), (figures, motion) = at_rest({}), at_rest.on(envs[1])({})
    assert figures.median_mm < 2.0 and figures.unsettled == 0
    assert at_rest.on(envs[1], n_actions=1)({})[0].median_mm > 2.0 * figures.median_mm
    less_mm = rest.reached.clearance_mm - motion.reached.clearance_mm
    assert less_mm.min() > -2.0 and less_mm.max() > 10.0


def test_success_at_the_first_stages_positions_is_told_apart():
    zero, poses = np.zeros(3), np.zeros((3, 6))
    reached = Reached(poses, poses, zero, zero, zero == 0, zero, np.array([5.0, -1, -1]), zero, zero)
    figures, _ = summarise(reached, 0.03, np.array([True, True, False]))
    assert (figures.success_share, figures.success_first_share) == (pytest.approx(1 / 3), 0.5)
    assert figures.outside_positions == 2
