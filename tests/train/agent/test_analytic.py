"""Learning through the equilibrium on a short arm: what is learned, and what is left out."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from tests.arms import SHORT
from train.agent.analytic import Analytic, AnalyticConfig, GradientEpoch

N_ARMS, N_UPDATES = 32, 150
CONFIG = AnalyticConfig(hidden=(32, 32), n_arms=N_ARMS)

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def epoch():
    """Arms that differ in payload, stiffness and sensor bias."""
    randomisation = Randomisation(payload_max_kg=0.2, stiffness_spread=0.05)
    env = ReachEnv(SHORT, EnvConfig(engine="chain", n_poses=256, randomisation=randomisation))
    return CONFIG.make_epoch(env)


@pytest.fixture(scope="module")
def update(epoch):
    return jax.jit(lambda state: epoch._step(state, None))


@pytest.fixture(scope="module")
def start(epoch):
    return jax.jit(epoch.first)(jax.random.PRNGKey(0))


@pytest.fixture(scope="module")
def tip_error_mm(epoch):
    """Policy -> mean tip error after one action, of the arms that training begins with."""

    @jax.jit
    def measure(policy, arms):
        after = jax.vmap(epoch.env.step)(arms, epoch.learner.mode(policy, arms.obs))
        return jnp.mean(after.metrics["tip_error_mm"])

    return measure


def test_it_learns_to_reach(epoch, update, start, tip_error_mm):
    state = start
    for _ in range(N_UPDATES):
        state, metrics = update(state)
    assert metrics["analytic/left_out"] == 0
    before, after = (tip_error_mm(epoch.learner.policy(s.learner), start.arms) for s in (start, state))
    assert after < 0.2 * before


def test_arms_go_on_from_where_their_actions_led_and_some_begin_anew(epoch, update, start):
    after, _ = update(start)
    begun = np.asarray(after.arms.pipeline_state.n_steps) == 0
    assert 0 < begun.sum() < N_ARMS
    moved = jax.jit(jax.vmap(epoch.env.step))(
        start.arms, epoch.learner.mode(start.learner.actor_params, start.arms.obs)
    )
    np.testing.assert_allclose(
        after.arms.pipeline_state.pose[~begun], moved.pipeline_state.pose[~begun], atol=5e-3
    )


def test_an_arm_that_does_not_settle_is_left_out_and_begins_anew(update, start):
    arm = start.arms.pipeline_state
    broken = arm._replace(payload_kg=arm.payload_kg.at[0].set(jnp.nan))
    after, metrics = update(start._replace(arms=start.arms.replace(pipeline_state=broken)))
    assert metrics["analytic/left_out"] == pytest.approx(1 / N_ARMS)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after.learner.actor_params))
    assert np.isfinite(after.arms.pipeline_state.payload_kg).all()


def test_the_gradient_of_moving_arms_looks_several_actions_ahead():
    """Against differences of the loss, for changes of the first and of the last of two actions."""
    env = ReachEnv(SHORT, EnvConfig(n_poses=64, mode="dynamic", dynamic_step_s=0.06, goal_ends=False))
    epoch = GradientEpoch(dataclasses.replace(CONFIG, n_arms=4, horizon=2), env)
    state = jax.jit(epoch.first)(jax.random.PRNGKey(0))
    loss = jax.vmap(jax.value_and_grad(epoch._loss, has_aux=True), in_axes=(0, 0, None))
    at = jax.jit(lambda changes: loss(changes, state.arms, state.learner.actor_params))
    changes = jnp.zeros((4, 2, env.action_size))
    (_, ahead), slope = at(changes)
    assert np.asarray(ahead.valid).all() and ahead.obs.shape == (4, 2, env.observation_size)
    np.testing.assert_array_equal(ahead.obs[:, 0], state.arms.obs)
    for k in (0, 1):
        way = jax.random.normal(jax.random.key(k), (env.action_size,))
        (above, _), _ = at(changes.at[:, k].set(3e-3 * way))
        (below, _), _ = at(changes.at[:, k].set(-3e-3 * way))
        np.testing.assert_allclose(slope[:, k] @ way, (above - below) / 6e-3, rtol=0.05, atol=2e-3)
    assert np.abs(slope[:, 0]).max() > 0.01  # what is done first counts later


def test_a_policy_is_adopted_and_may_observe_less():
    def new(obs_size, hidden=(8, 8)):
        learner = Analytic(obs_size, 3, dataclasses.replace(CONFIG, hidden=hidden))
        return learner, jax.jit(learner.init)(jax.random.key(obs_size))

    (learner, donor), (wider, state) = new(18), new(57)
    obs = np.random.default_rng(0).normal(size=(5, 57)).astype(np.float32)
    adopted = wider.adopt(state, learner.parts(donor))
    expected = learner.mode(learner.policy(donor), obs[:, :18])
    np.testing.assert_allclose(wider.mode(wider.policy(adopted), obs), expected, atol=1e-6)
    for other, given in (new(57, hidden=(8,)), new(19)):  # another size, and other things rather than less
        with pytest.raises(ValueError, match="actor: got layers of"):
            wider.adopt(state, other.parts(given))
