"""Relabelling of what real arms did, against the environment that they did it in."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.agent import hindsight
from train.agent.hindsight import HindsightConfig, later_pose, relabel
from train.agent.learner import Transition
from train.agent.tqc import TQCConfig
from train.epoch.replay_epoch import ReplayEpoch

N_COPIES = 8  # of every transition, for shares that are as they should be


@pytest.fixture(scope="module")
def transition(env, reset, step, random_actions):
    """State, action and successor; half of the arms saturate, a quarter reach their goal."""
    state = reset(0)
    arm = state.pipeline_state._replace(n_steps=jnp.arange(len(state.obs), dtype=jnp.int32) % 4)
    state = state.replace(pipeline_state=arm._replace(goal=env.pool.pose))
    state = state.replace(obs=env.observe(arm.pose, env.pool.pose))
    kind = (jnp.arange(len(state.obs)) % 4)[:, None]
    elsewhere = env.action_of(jnp.roll(env.pool.spring_m, 1, axis=0))
    action = jnp.where(
        kind < 2, random_actions, jnp.where(kind == 2, elsewhere, env.action_of(env.pool.spring_m))
    )
    after = step(state, action)
    saturated, reached = (np.asarray(x) > 0 for x in (after.info["saturated"], after.done))
    assert min(saturated.sum(), reached.sum(), (~saturated & ~reached).sum()) > 100
    return state, action, after


@pytest.fixture(scope="module")
def stored(env, transition):
    """The transitions as an epoch stores them."""
    return ReplayEpoch(TQCConfig(), env, learner=None)._experience(*transition)


@pytest.fixture(scope="module")
def relabelled(env, stored):
    """Shares -> the stored transitions, and N_COPIES of them relabelled, as arrays (N_COPIES * n, ...)."""
    many = jax.tree.map(lambda x: jnp.concatenate([x] * N_COPIES), stored)

    def of(key=0, **shares):
        batch = relabel(many, jax.random.key(key), HindsightConfig(**shares), env)
        same = np.all(goal_of(env, batch.obs) == goal_of(env, env.observe(many.pose, many.goal)), axis=-1)
        np.testing.assert_array_equal(batch.relabelled, ~same)
        return many, batch

    return of


def goal_of(env, obs):
    """Goals [mm, deg] that observations speak of."""
    return obs[:, 6:12] * env.scale.scale + env.scale.centre


def test_with_both_shares_zero_a_batch_is_what_the_environment_gave(transition, relabelled):
    state, action, after = transition
    _, batch = relabelled(reached_share=0.0, near_share=0.0)
    given = Transition(state.obs, action, after.reward, after.obs, after.done)
    for name, got, own in zip(Transition._fields[:5], batch[:5], given[:5], strict=True):
        tolerance = {"rtol": 1e-6} if name == "reward" else {"atol": 1e-6}
        np.testing.assert_allclose(got, jnp.concatenate([own] * N_COPIES), **tolerance)


def test_a_pose_that_was_reached_as_a_goal_earns_the_bonus_and_ends_the_episode(env, relabelled):
    many, batch = relabelled(reached_share=1.0)
    np.testing.assert_array_equal(batch.reward, env.config.reward.goal_bonus)
    np.testing.assert_array_equal(batch.terminated, 1.0)
    np.testing.assert_array_equal(batch.obs, env.observe(many.pose, many.next_pose))
    np.testing.assert_array_equal(batch.next_obs, env.observe(many.next_pose, many.next_pose))
    np.testing.assert_array_equal(batch.next_obs[:, 12:], 0.0)


def test_only_a_saturated_action_is_exchanged_for_the_sensed_one(env, relabelled):
    many, batch = relabelled(reached_share=0.5, near_share=0.5)
    np.testing.assert_array_equal(
        batch.action, jnp.where(many.saturated[:, None], many.sensed_action, many.action)
    )
    assert float(jnp.abs(many.sensed_action - many.action)[many.saturated].max()) > 0.5
    assert -100.0 not in np.asarray(batch.reward)
    # As printed, actions stay, and a pose reached pays though a chamber saturates.
    for costs in (False, True):
        settings = {"exchange_actions": False, "saturation_costs": costs}
        many, batch = relabelled(reached_share=1.0, **settings)
        np.testing.assert_array_equal(batch.action, many.action)
        paid = np.where(costs & np.asarray(many.saturated), -100.0, env.config.reward.goal_bonus)
        np.testing.assert_array_equal(batch.reward, paid)


def test_a_sensed_action_leads_to_the_same_rest_with_no_chamber_saturated(transition, stored, step):
    state, _, after = transition
    again = step(state, stored.sensed_action)
    np.testing.assert_allclose(again.pipeline_state.pose, after.pipeline_state.pose, atol=0.05)
    np.testing.assert_allclose(
        again.pipeline_state.pressure_kpa, after.pipeline_state.pressure_kpa, atol=0.01
    )
    np.testing.assert_array_equal(again.metrics["saturated_chambers"], 0)
    assert float(after.metrics["saturated_chambers"].sum()) > 500


def test_near_goals_lie_at_log_uniform_distances_and_earn_what_these_say(env, relabelled):
    many, batch = relabelled(reached_share=0.0, near_share=1.0)
    offset = np.asarray(goal_of(env, batch.obs) - many.next_pose)
    distance = np.linalg.norm(offset[:, :3], axis=1)
    assert distance.min() > 0.99 and distance.max() < 100.01
    share = np.log(distance) / np.log(100.0)  # uniform in [0, 1]
    counts, _ = np.histogram(share, 16, (0.0, 1.0))
    assert abs(counts / len(share) - 1 / 16).max() < 5 * np.sqrt(1 / 16 / len(share))
    direction = offset[:, :3] / distance[:, None]
    assert abs(direction.mean(axis=0)).max() < 5 * np.sqrt(1 / 3 / len(direction))
    assert abs((direction**2).mean(axis=0) - 1 / 3).max() < 0.03
    # They earn what their distance says.
    offset = -offset.astype(np.float64)
    offset[:, 3:] = (offset[:, 3:] + 180.0) % 360.0 - 180.0
    norm = np.linalg.norm(offset * ([0.0056] * 3 + [0.001] * 3), axis=1)
    clear = abs(norm - 0.03) > 1e-4  # of the threshold, where rounding decides
    expected = np.where(norm < 0.03, 100.0, -10 * norm - 0.1 * np.asarray(many.n_steps))
    np.testing.assert_allclose(np.asarray(batch.reward)[clear], expected[clear], atol=2e-3)
    np.testing.assert_array_equal(np.asarray(batch.terminated)[clear], (norm < 0.03)[clear])
    assert 0.05 < np.mean(norm < 0.03) < 0.95


def test_a_later_pose_is_the_goal_reached_and_the_centre_of_half_of_those_nearby(env, stored, monkeypatch):
    monkeypatch.setattr(hindsight, "NEAR_MM", (1e-3, 1e-3))
    later = jnp.roll(stored.next_pose, 1, axis=0)
    with_later = jax.tree.map(lambda x: jnp.concatenate([x] * N_COPIES), stored._replace(later_pose=later))

    def goals(**shares):
        batch = relabel(with_later, jax.random.key(0), HindsightConfig(**shares), env)
        return np.asarray(goal_of(env, batch.obs)[:, :3])

    own, other = np.asarray(with_later.next_pose[:, :3]), np.asarray(with_later.later_pose[:, :3])
    np.testing.assert_allclose(goals(reached_share=1.0), other, atol=1e-3)
    near = goals(reached_share=0.0, near_share=1.0)
    by_later, by_own = (np.linalg.norm(near - pose, axis=1) < 0.01 for pose in (other, own))
    assert (by_later | by_own).all()
    assert abs(by_later.mean() - 0.5) < 0.05


def test_a_later_pose_is_of_the_same_episode_or_the_transition_s_own(stored):
    now = jax.tree.map(lambda x: x[:3], stored)
    later = jax.tree.map(lambda x: x[3:6], stored)._replace(goal=now.goal, n_steps=now.n_steps + 2)
    ahead = jnp.full(3, 2)
    np.testing.assert_array_equal(later_pose(now, later, ahead), later.next_pose)
    other_goal = later._replace(goal=later.goal.at[1, 5].add(1.0))
    other_count = other_goal._replace(n_steps=later.n_steps.at[2].add(-1))
    got = later_pose(now, other_count, ahead)
    np.testing.assert_array_equal(got[0], later.next_pose[0])
    np.testing.assert_array_equal(got[1:], now.next_pose[1:])


def test_shares_are_kept_and_the_rest_is_as_it_was(env, transition, relabelled):
    many, batch = relabelled(reached_share=0.3, near_share=0.25)
    kept_goal = env.observe(many.pose, many.goal)[:, 6:12]
    reached = np.asarray(jnp.all(batch.next_obs[:, 12:] == 0.0, axis=1))
    kept = np.asarray(jnp.all(batch.obs[:, 6:12] == kept_goal, axis=1)) & ~reached
    n = len(kept)
    for share, expected in ((reached, 0.3), (kept, 0.45), (~reached & ~kept, 0.25)):
        assert abs(share.mean() - expected) < 5 * np.sqrt(expected * (1 - expected) / n)
    given = np.concatenate([transition[2].reward] * N_COPIES)
    np.testing.assert_allclose(np.asarray(batch.reward)[kept], given[kept], rtol=1e-6)
    np.testing.assert_array_equal(np.asarray(batch.action)[kept], np.asarray(many.action)[kept])
    assert (given[kept] == -100.0).any()  # a saturated action that keeps its goal keeps its price


def test_what_is_sensed_follows_pose_and_goal_and_knows_the_action_exchanged(env, stored):
    n = len(stored.n_steps)
    before, after = jnp.full((n, 12), 2.0), jnp.full((n, 12), 3.0)
    moving = stored._replace(sensed=before, next_sensed=after)
    config, key = HindsightConfig(reached_share=1.0), jax.random.key(0)
    motion = copy.copy(env)
    changes = {"engine": "mjx", "mode": "dynamic", "observation": "motion", "goal_ends": False}
    motion.config = dataclasses.replace(env.config, **changes)
    batch = relabel(moving, key, config, motion)
    np.testing.assert_array_equal(batch.obs[:, 18:], before)
    n_springs = batch.action.shape[1]
    np.testing.assert_array_equal(batch.next_obs[:, 18:-n_springs], after[:, :-n_springs])
    np.testing.assert_array_equal(batch.next_obs[:, -n_springs:], batch.action)
    assert (batch.action != stored.action).any()
    assert batch.reward.max() > 50.0 and not batch.terminated.any()  # reached, and it goes on
    carrying = stored._replace(sensed=before[:, :1], next_sensed=after[:, :1])
    batch = relabel(carrying, key, config, env)
    np.testing.assert_array_equal(batch.obs[:, 18:], before[:, :1])
    np.testing.assert_array_equal(batch.next_obs[:, 18:], after[:, :1])
