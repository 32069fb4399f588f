"""The environment against NumPy, against known equilibria, and against itself where it must agree."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from mjx_softarm.env.reach import POOL_SEED
from mjx_softarm.env.state import State
from tests.arms import SHORT, with_arm

MM, KPA = 1e-3, 1.0
SPREAD = Randomisation(payload_max_kg=0.5, stiffness_spread=0.2)


def numpy_error(pose, goal):
    """The paper's weights, 0.0056 per mm and 0.001 per degree, on pose - goal with angles in [-180, 180]."""
    error = np.float64(pose) - np.float64(goal)
    error[:, 3:] = np.rad2deg(np.angle(np.exp(1j * np.deg2rad(error[:, 3:]))))
    return error * ([0.0056] * 3 + [0.001] * 3)


def leaves_equal(a, b):
    return jax.tree.all(jax.tree.map(lambda x, y: np.array_equal(x, y, equal_nan=True), a, b))


def test_an_action_scales_the_frequency_linearly_between_those_of_the_shortest_and_longest_spring(env, spec):
    sensor = spec.sensor
    coil = 1.26e-6 * sensor.turns**2 * np.pi * sensor.coil_radius_m**2

    def frequency(length):
        inductance = coil / ((length - sensor.delta_m) / sensor.beta) + sensor.compensation_h
        return 1 / (2 * np.pi * np.sqrt(sensor.capacitance_f * inductance))

    lengths = np.linspace(spec.springs.length_min_m, spec.springs.length_max_m, 9)
    ends = frequency(lengths[[0, -1]])
    actions = 2 * (frequency(lengths) - ends[0]) / (ends[1] - ends[0]) - 1
    assert actions[4] > 0.1  # the middle length is not the middle frequency
    np.testing.assert_allclose(env.reference_m(jnp.float32(actions)), lengths, atol=1e-6)
    np.testing.assert_allclose(env.action_of(jnp.float32(lengths)), actions, atol=1e-5)
    # Actions beyond one and lengths beyond the limits are clipped
    shortest, longest = lengths[[0, -1]]
    np.testing.assert_allclose(env.reference_m(jnp.full(9, -3.0)), shortest, atol=1e-7)
    np.testing.assert_allclose(env.reference_m(jnp.full(9, 3.0)), longest, atol=1e-7)
    np.testing.assert_array_equal(env.action_of(jnp.full(9, 0.5 * shortest)), -1.0)
    np.testing.assert_array_equal(env.action_of(jnp.full(9, 2.0 * longest)), 1.0)


def test_starts_and_goals_are_drawn_from_the_pool_each_on_its_own(env, start):
    pool = np.asarray(env.pool.pose)
    rows = {pose.tobytes(): index for index, pose in enumerate(pool)}
    starts = [rows[pose.tobytes()] for pose in np.asarray(start.pipeline_state.pose)]
    goals = [rows[pose.tobytes()] for pose in np.asarray(start.pipeline_state.goal)]
    # 512 draws from 512 hit 1 - 1/e of them: 324, give or take 10.
    assert all(270 < len(set(drawn)) < 380 for drawn in (starts, goals))
    assert sum(a == b for a, b in zip(starts, goals, strict=True)) < 8  # one is expected
    np.testing.assert_array_equal(start.pipeline_state.spring_m, env.pool.spring_m[np.array(starts)])
    np.testing.assert_array_equal(start.pipeline_state.motion.q, env.pool.q[np.array(starts)])


def test_a_share_of_the_poses_is_uniform_in_volume(spec):
    env = ReachEnv(spec, EnvConfig(n_poses=48, even_share=0.25))
    plain, even = env.sample_pool(36, POOL_SEED), env.sample_pool(12, POOL_SEED, evenly=True)
    np.testing.assert_array_equal(env.pool.pose, np.concatenate([plain.pose, even.pose]))
    assert len(np.unique(env.pool.pose, axis=0)) > 40


def test_every_goal_is_reached_to_a_tenth_of_a_millimetre_with_no_chamber_saturated(env, start, step):
    after = step(with_arm(start, goal=env.pool.pose), env.action_of(env.pool.spring_m))
    assert float(after.metrics["tip_error_mm"].max()) < 0.1
    assert np.abs(numpy_error(after.pipeline_state.pose, env.pool.pose)[:, 3:]).max() < 1e-4  # 0.1 deg
    np.testing.assert_array_equal(after.metrics["saturated_chambers"], 0)
    np.testing.assert_array_equal(after.reward, 100.0)


def test_observation_is_scaled_pose_scaled_goal_and_error(start, step, random_actions):
    for state in (start, step(start, random_actions)):
        pose, goal = (np.float64(x) for x in (state.pipeline_state.pose, state.pipeline_state.goal))
        centre, scale = np.array([0, 0, -600.0, 0, 0, 0]), np.array([200.0] * 3 + [90.0] * 3)
        expected = [(pose - centre) / scale, (goal - centre) / scale, numpy_error(pose, goal)]
        np.testing.assert_allclose(state.obs, np.concatenate(expected, axis=1), atol=2e-6)
        assert state.obs.dtype == np.float32


def test_reward_done_and_metrics_are_those_of_the_paper_s_three_cases(env, spec, start, step, random_actions):
    # A third of the arms each: random actions, nearly all saturated; own goal; another arm's goal.
    third = np.arange(len(start.obs)) % 3
    other = jnp.roll(env.pool.spring_m, 1, axis=0)
    sent = jnp.where((third == 1)[:, None], env.pool.spring_m, other)
    actions = jnp.where((third == 0)[:, None], random_actions, env.action_of(sent))
    n_steps = np.arange(len(third)) % 4
    after = step(with_arm(start, goal=env.pool.pose, n_steps=jnp.asarray(n_steps, jnp.int32)), actions)
    arm = after.pipeline_state

    off = np.asarray(env.reference_m(actions)) - np.asarray(arm.spring_m)
    pressure = np.asarray(arm.pressure_kpa)
    saturated = ((pressure == spec.chambers.pressure_max_kpa) & (off > 1 * MM)) | (
        (pressure == spec.chambers.pressure_min_kpa) & (off < -1 * MM)
    )
    norm = np.linalg.norm(numpy_error(arm.pose, arm.goal), axis=1)
    blocked, close = saturated.any(axis=1), norm < 0.03
    expected = np.where(blocked, -100.0, np.where(close, 100.0, -10 * norm - 0.1 * (n_steps + 1)))
    assert min(blocked.sum(), (close & ~blocked).sum(), (~close & ~blocked).sum()) > 100  # all three occur

    np.testing.assert_allclose(after.reward, expected, rtol=1e-5)
    np.testing.assert_array_equal(after.done, close & ~blocked)
    np.testing.assert_array_equal(after.metrics["reached"], close & ~blocked)
    np.testing.assert_array_equal(after.metrics["saturated_chambers"], saturated.sum(axis=1))
    np.testing.assert_array_equal(after.info["saturated"], blocked)
    np.testing.assert_array_equal(arm.n_steps, n_steps + 1)
    tip_error = np.linalg.norm(np.asarray(arm.pose - arm.goal)[:, :3], axis=1)
    np.testing.assert_allclose(after.metrics["tip_error_mm"], tip_error, rtol=1e-5)
    names = ("goal", "error", "steps", "saturation", "distance", "clearance")
    terms = sum(after.metrics[f"reward_{name}"] for name in names)
    np.testing.assert_allclose(after.reward, terms, rtol=1e-6)


FAILURES = {
    "a NaN in the action": {"action": jnp.nan},
    "an infinity in the action": {"action": jnp.inf},
    "a payload of a thousand tonnes": {"payload_kg": 1e6},
    "chambers that push apart": {"chamber_stiffness": jnp.full(9, -1e4)},
    "a NaN among the numbers of the arm": {"payload_kg": jnp.nan},
}


@pytest.fixture(scope="module")
def broken(env, reset, step):
    """A batch at its goals, its first arms each broken in one way: before, after, and after when whole."""
    start = reset(0)
    start = with_arm(start, goal=start.pipeline_state.pose)
    arms, actions = start.pipeline_state, env.action_of(start.pipeline_state.spring_m)
    for index, changes in enumerate(FAILURES.values()):
        for name, value in changes.items():
            if name == "action":
                actions = actions.at[index, 3].set(value)
            else:
                arms = arms._replace(**{name: getattr(arms, name).at[index].set(value)})
    before = start.replace(pipeline_state=arms)
    whole = step(start, env.action_of(start.pipeline_state.spring_m))
    return before, step(before, actions), whole


@pytest.mark.parametrize("index", range(len(FAILURES)), ids=FAILURES)
def test_an_arm_that_cannot_settle_keeps_its_pose_earns_nothing_and_ends_its_episode(broken, index):
    before, after, _ = jax.tree.map(lambda x: x[index], broken)
    assert not after.info["valid"] and after.metrics["unsettled"] == 1
    reasons = {name: float(after.metrics[name]) for name in after.metrics if name.startswith("invalid_")}
    assert sum(reasons.values()) == 1, reasons
    assert after.done == 1 and after.reward == 0
    assert after.metrics["reached"] == 0  # it stands on its goal, but did not get there
    assert not after.info["saturated"] and after.metrics["saturated_chambers"] == 0
    assert all(after.metrics[name] == 0 for name in after.metrics if name.startswith("reward_"))
    assert leaves_equal(after.pipeline_state, before.pipeline_state)
    np.testing.assert_array_equal(after.obs, before.obs.at[6:12].set(before.obs[:6]).at[12:].set(0.0))


def test_an_arm_that_cannot_settle_leaves_the_others_alone(broken):
    _, after, whole = jax.tree.map(lambda x: x[len(FAILURES) :], broken)
    np.testing.assert_array_equal(after.info["valid"], True)
    np.testing.assert_array_equal(after.done, 1)
    assert leaves_equal(after, whole)


class Few(NamedTuple):
    """Four randomised arms in the chain engine: two track, one saturates, one has a NaN among its numbers."""

    env: ReachEnv
    fresh: State  # as reset
    before: State  # with the NaN
    actions: jax.Array
    after: State


ARMS = [pytest.param(SHORT, id="short"), pytest.param(ArmSpec.default(), id="paper", marks=pytest.mark.slow)]


@pytest.fixture(scope="module", params=ARMS)
def few(request, quick_compiler):
    env = ReachEnv(request.param, EnvConfig(engine="chain", n_poses=64, randomisation=SPREAD))
    fresh, step = compiled(env)
    before = with_arm(fresh, payload_kg=fresh.pipeline_state.payload_kg.at[3].set(jnp.nan))
    lengths = jax.random.uniform(jax.random.key(1), (4, env.action_size), minval=0.16, maxval=0.19)
    actions = env.action_of(lengths).at[2].set(1.0)
    return Few(env, fresh, before, actions, step(before, actions))


def compiled(env):
    """Four arms, reset, and step."""
    keys = jax.random.split(jax.random.key(3), 4)
    reset, step = (xla.jit(jax.vmap(function)) for function in (env.reset, env.step))
    return reset(keys), step


def test_engine_mjx_steps_like_engine_chain(few):
    env = ReachEnv(few.env.spec, dataclasses.replace(few.env.config, engine="mjx"))
    fresh, step = compiled(env)
    assert leaves_equal(fresh, few.fresh)
    after = step(few.before, few.actions)
    assert jax.tree.map(jax.typeof, after) == jax.tree.map(jax.typeof, few.before)
    # MJX in single precision: positions within a micrometre
    moved, proposed = after.pipeline_state, few.after.pipeline_state
    np.testing.assert_allclose(moved.pose[:, :3], proposed.pose[:, :3], atol=1e-3)
    np.testing.assert_allclose(moved.pose[:, 3:], proposed.pose[:, 3:], atol=0.01)
    np.testing.assert_allclose(moved.spring_m, proposed.spring_m, atol=1e-6)
    np.testing.assert_allclose(after.reward, few.after.reward, atol=0.01)
    for state in (after, few.after):
        np.testing.assert_array_equal(state.info["saturated"], [False, False, True, False])
        np.testing.assert_array_equal(state.info["valid"], [True, True, True, False])


@pytest.mark.parametrize("engine", ["mjx", "mjx-step"])
def test_mode_dynamic_comes_to_rest_at_the_quasi_static_equilibrium(few, engine):
    moving = {"engine": engine, "mode": "dynamic", "dynamic_step_s": 1.0}
    env = ReachEnv(few.env.spec, dataclasses.replace(few.env.config, **moving))
    fresh, step = compiled(env)
    # Reasons of failures are those of motion, and there is a path.
    before = few.before.replace(metrics=fresh.metrics, info=fresh.info)
    assert leaves_equal(fresh.pipeline_state, few.fresh.pipeline_state)
    first = now = step(before, few.actions)
    assert jax.tree.map(jax.typeof, first) == jax.tree.map(jax.typeof, before)
    for _ in range(29):
        now = step(now, few.actions)
    moving, resting, truth = (
        jax.tree.map(lambda x: np.asarray(x)[:3], state.pipeline_state) for state in (first, now, few.after)
    )
    assert np.linalg.norm((moving.pose - truth.pose)[:, :3], axis=1).max() > 3.0  # a transient
    assert np.linalg.norm((resting.pose - truth.pose)[:, :3], axis=1).max() < 1.0
    np.testing.assert_allclose(resting.spring_m, truth.spring_m, atol=0.5 * MM)
    np.testing.assert_allclose(resting.pressure_kpa, truth.pressure_kpa, atol=0.2 * KPA)
    np.testing.assert_array_equal(resting.n_steps, 30)
    np.testing.assert_array_equal(now.info["saturated"], [False, False, True, False])
    # The fourth arm stays where it was, and its velocity and pressures do not turn into NaN.
    np.testing.assert_array_equal(first.info["valid"], [True, True, True, False])
    assert first.done[3] == 1 and first.reward[3] == 0
    assert leaves_equal(*(jax.tree.map(lambda x: x[3], state.pipeline_state) for state in (few.before, now)))
