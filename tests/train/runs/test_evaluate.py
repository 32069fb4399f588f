"""Evaluation: its arithmetic on results made by hand, and policies whose error is known beforehand."""

import dataclasses
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.env import ReachEnv
from mjx_softarm.env.state import State
from mjx_softarm.mdp.rewards import RewardConfig
from train.runs import evaluate
from train.runs.evaluate import (
    Evaluator,
    PositionEvaluator,
    Reached,
    reach,
    summarise,
    summarise_positions,
    time_near,
)

pytestmark = pytest.mark.usefixtures("quick_compiler")


def reached(error_mm, scaled_error, saturated, settled):
    n = len(error_mm)
    goal = np.zeros((n, 6))
    pose = goal + np.array(error_mm)[:, None] * np.array([0.6, 0.0, -0.8, 0.0, 0.0, 0.0])
    return Reached(
        goal=goal,
        pose=pose,
        scaled_error=np.array(scaled_error),
        saturated_chambers=np.array(saturated),
        settled=np.array(settled),
        pressure_kpa=np.zeros((n, 9)),
        clearance_mm=np.full(n, np.inf),
        near_s=np.full(n, np.nan),
    )


def test_figures_of_results_made_by_hand():
    workspace = reached(
        error_mm=[1.0, 2.0, 3.0, 4.0, 50.0],
        scaled_error=[0.01, 0.029, 0.03, 0.01, 0.01],
        saturated=[0, 0, 0, 2, 0],
        settled=[True, True, True, True, False],
    )
    even = reached([6.0, 8.0], [0.01, 0.04], [0, 0], [True, True])
    circle = reached([1.0, 4.0], [0.01, 0.02], [1, 2], [True, False])
    figures = summarise(workspace, even, circle, threshold=0.03)
    assert figures.median_mm == pytest.approx(3.0)
    assert figures.p95_mm == pytest.approx(4.0 + 0.8 * 46.0)  # linear between the fourth and the fifth
    assert figures.reached_share == 2 / 5  # not at the threshold, not saturated, not unsettled
    assert figures.saturated_share == 1 / 5
    assert figures.unsettled == 2
    assert (figures.even_median_mm, figures.even_p95_mm) == pytest.approx((7.0, 7.9))
    assert figures.even_reached_share == 1 / 2
    assert (figures.circle_mean_mm, figures.circle_max_mm) == pytest.approx((2.5, 4.0))
    assert figures.circle_saturated_chambers == 3


class Scripted:
    """An agent whose policy is an array of actions, looked up by the goal in the observation."""

    def __init__(self, env, goals):
        self._goals = jnp.stack([env.observe(goal, goal) for goal in goals])[:, 6:12]

    def mode(self, actions, obs):
        return actions[jnp.argmin(jnp.sum((self._goals - obs[6:12]) ** 2, axis=-1))]


@pytest.fixture(scope="module")
def evaluator(short_env):
    """Evaluator that takes two actions to each goal, and reports their number as `near_s`."""

    def counted(env, learner, policy, state, goal, *how, take=evaluate.reach):
        after, result = take(env, learner, policy, state, goal, *how)
        return after, result._replace(near_s=after.pipeline_state.n_steps - state.pipeline_state.n_steps)

    goals = short_env.pool.pose[:64]
    evaluator = Evaluator(short_env, Scripted(short_env, goals), n_actions=2, n_goals=len(goals))
    evaluator.goals = jnp.concatenate([goals, goals])  # both sets
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "reach", counted)
        yield evaluator


@pytest.fixture
def actions(short_env):
    """Actions (64, 3) that lead to the goals."""
    return short_env.action_of(short_env.pool.spring_m[:64])


def test_a_policy_that_never_moves_is_as_far_as_the_goals_are(evaluator, actions):
    goals = np.asarray(evaluator.goals)[:64]
    figures, workspace, circle = evaluator(jnp.broadcast_to(actions[:1], actions.shape))
    expected = np.linalg.norm((goals - goals[0])[:, :3], axis=-1)
    np.testing.assert_allclose(workspace.tip_error_mm, expected, atol=0.1)
    assert figures.median_mm == pytest.approx(np.median(expected), abs=0.1)
    around = np.linalg.norm((np.asarray(circle.goal) - goals[0])[:, :3], axis=-1)
    np.testing.assert_allclose(circle.tip_error_mm, around, atol=0.1)
    assert (workspace.near_s == 2).all() and (circle.near_s == 2).all()  # as many actions as asked for


def test_an_arm_that_fails_on_the_way_counts_as_unsettled(evaluator, actions):
    figures, workspace, _ = evaluator(actions.at[3].set(jnp.nan))
    assert not workspace.settled[3] and workspace.settled.sum() == len(actions) - 1
    assert figures.unsettled == 2 and figures.reached_share == 1 - 1 / len(actions)


class Tip(NamedTuple):
    """A tip that goes where an action says, and a little farther."""

    pose: jax.Array = jnp.zeros(6)
    goal: jax.Array = jnp.zeros(6)
    sensed: None = None
    pressure_kpa: jax.Array = jnp.zeros(1)


LIMIT = np.repeat([25.0, 5.0], 3)


@pytest.mark.parametrize(
    ("limit", "reward", "left"),
    [
        (evaluate.UNCORRECTED, RewardConfig(), [12.0, -4.0, 0.0, 6.0, 0.0, 0.0]),
        (LIMIT, RewardConfig(), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
        (np.repeat([10.0, 9.0], 3), RewardConfig(), [2.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        (LIMIT, RewardConfig(axes=(1.0, 0.0, 1.0, 1.0, 1.0, 1.0)), [0.0, -4.0, 0.0, 1.0, 0.0, 0.0]),
    ],
)
def test_a_corrected_goal_removes_an_error_up_to_the_limit(limit, reward, left):
    away = jnp.array([12.0, -4.0, 0.0, 6.0, 0.0, 0.0])

    def step(state, action):
        return state.replace(pipeline_state=state.pipeline_state._replace(pose=action + away))

    env = SimpleNamespace(
        step=step,
        observe=lambda pose, goal, sensed: goal,
        config=SimpleNamespace(in_motion=False, reward=reward),
    )
    info, metrics = {"valid": jnp.array(True), "clearance_mm": jnp.inf}, {"saturated_chambers": jnp.zeros(())}
    begin = State(Tip(), jnp.zeros(6), jnp.zeros(()), jnp.zeros(()), metrics, info)
    goal = jnp.array([30.0, 0.0, 500.0, 0.0, 10.0, 0.0])
    obedient = SimpleNamespace(mode=lambda policy, obs: obs)
    _, found = reach(env, obedient, None, begin, goal, 3, limit)
    np.testing.assert_allclose(found.pose - goal, left, atol=1e-4)
    np.testing.assert_array_equal(found.goal, goal)


def test_when_a_tip_is_near_for_good():
    x = np.array([40.0, 20.0, 4.0, -8.0, -3.0, 1.0])  # near, beyond by 8 mm, near again
    way = jnp.asarray(np.stack([x, 0.0 * x, 0.0 * x], axis=-1))
    assert time_near(way, jnp.zeros(3), 0.02) == pytest.approx(0.08)
    assert np.isinf(time_near(way[:4], jnp.zeros(3), 0.02))
    assert time_near(way[4:], jnp.zeros(3), 0.02) == 0.0


def test_figures_of_a_motion():
    still = reached([1.0, 9.0, 2.0], [0.01] * 3, [0] * 3, [True] * 3)
    moving = still._replace(near_s=np.array([0.4, np.inf, 0.8]))
    at_rest = summarise(still, still, still, 0.03)
    assert at_rest.near_share is None and "near_share" not in at_rest.to_dict()
    figures = summarise(moving, moving, moving, 0.03)
    assert (figures.near_share, figures.near_median_s) == (pytest.approx(2 / 3), pytest.approx(0.8))
    never = moving._replace(near_s=np.array([0.4, np.inf, np.inf]))
    assert summarise(never, moving, moving, 0.03).near_median_s is None  # at one of three alone
    assert len(figures.rows()) == 2 + len(at_rest.rows())


@pytest.mark.parametrize("pipe_mm", [None, 130.0], ids=["open", "narrower than the arm"])
def test_positions_are_evaluated_with_body_and_pressures(short_env, shown, pipe_mm):
    n = len(shown.positions)
    piped = ReachEnv(short_env.spec, dataclasses.replace(short_env.config, pipe_diameter_mm=pipe_mm))
    positions, first = np.asarray(shown.positions), np.arange(n) % 2 == 0
    knowing = Scripted(short_env, jnp.asarray(positions))
    figures, at = PositionEvaluator(piped, knowing, positions=positions, first=first)(shown.actions)
    assert figures.reached_share == 1.0 and figures.max_mm < 0.05 and len(figures.error_mm) == n
    assert (
        figures.success_share == (pipe_mm is None) and figures.outside_positions == (pipe_mm is not None) * n
    )
    assert (np.isinf(at.clearance_mm) if pipe_mm is None else at.clearance_mm < 0.0).all()


def test_positions_with_saturation_or_a_body_outside_are_counted():
    zero, poses = np.zeros(4), np.zeros((4, 6))
    saturated, clearance_mm = np.array([0, 2, 0, 0]), np.array([5.0, 5, -1, 5])
    settled = np.array([True, True, True, False])
    reached = Reached(poses, poses, zero, saturated, settled, zero, clearance_mm, zero)
    figures = summarise_positions(reached, 0.03, np.array([True, True, False, False]))
    assert (figures.saturated_positions, figures.outside_positions, figures.unsettled) == (1, 1, 1)
    assert figures.success == (True, False, False, False)
    assert (figures.success_share, figures.success_first_share) == (0.25, 0.5)  # of all, of the first stage
