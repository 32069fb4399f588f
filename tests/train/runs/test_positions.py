"""Evaluation on demonstrated positions: figures, walls, and the first stage by itself."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.env import ReachEnv
from train.runs.evaluate import PositionEvaluator, Reached, summarise_positions

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
    figures, at = evaluator(short_env).on(changed(short_env, pipe_diameter_mm=pipe_mm), 4)(0.0)
    assert figures.reached_share == 1.0 and figures.max_mm < 0.05 and len(figures.error_mm) == n
    assert (
        figures.success_share == (pipe_mm is None) and figures.outside_positions == (pipe_mm is not None) * n
    )
    assert (np.isinf(at.reached.clearance_mm) if pipe_mm is None else at.reached.clearance_mm < 0.0).all()


def test_positions_with_saturation_or_a_body_outside_are_counted():
    zero, poses = np.zeros(4), np.zeros((4, 6))
    saturated, clearance_mm = np.array([0, 2, 0, 0]), np.array([5.0, 5, -1, 5])
    settled = np.array([True, True, True, False])
    reached = Reached(poses, poses, zero, saturated, settled, zero, clearance_mm, zero)
    figures, at = summarise_positions(reached, 0.03, np.array([True, True, False, False]))
    assert (figures.saturated_positions, figures.outside_positions, figures.unsettled) == (1, 1, 1)
    assert figures.success == (True, False, False, False) == tuple(at.success)
    assert (figures.success_share, figures.success_first_share) == (0.25, 0.5)  # of all, of the first stage
