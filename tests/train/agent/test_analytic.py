"""Learning through the equilibrium on a short arm: what is learned, and what is left out."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from mjx_softarm.spec import ArmSpec
from train.agent.analytic import Analytic, AnalyticConfig

SHORT = ArmSpec.default().replace(structure={"n_sections": 1, "links_per_section": 2})
N_ARMS, N_UPDATES = 32, 150
CONFIG = AnalyticConfig(hidden=(32, 32), n_arms=N_ARMS)
FEW = dataclasses.replace(CONFIG, n_arms=4)

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(scope="module")
def learner():
    """Arms that differ in payload, stiffness and sensor bias."""
    randomisation = Randomisation(payload_max_kg=0.2, stiffness_spread=0.05, sensor_noise_mm=0.5)
    env = ReachEnv(SHORT, EnvConfig(engine="chain", n_poses=256, randomisation=randomisation))
    return Analytic(CONFIG, env)


@pytest.fixture(scope="module")
def update(learner):
    return jax.jit(lambda state, key: learner.update(state, None, key))


@pytest.fixture(scope="module")
def start(learner):
    return jax.jit(learner.init)(jax.random.key(0))


@pytest.fixture(scope="module")
def tip_error_mm(learner):
    """Policy -> mean tip error after one action, of the arms that training begins with."""

    @jax.jit
    def measure(policy, arms):
        after = jax.vmap(learner.env.step)(arms, learner.mode(policy, arms.obs))
        return jnp.mean(after.metrics["tip_error_mm"])

    return measure


def test_it_learns_to_reach(learner, update, start, tip_error_mm):
    state = start
    for key in jax.random.split(jax.random.key(1), N_UPDATES):
        state, metrics = update(state, key)
    assert metrics["analytic/left_out"] == 0
    before, after = (tip_error_mm(learner.policy(s), start.arms) for s in (start, state))
    assert after < 0.2 * before


def test_arms_go_on_from_where_their_actions_led_and_some_begin_anew(learner, update, start):
    after, _ = update(start, jax.random.key(2))
    begun = np.asarray(after.arms.pipeline_state.n_steps) == 0
    assert 0 < begun.sum() < N_ARMS
    moved = jax.jit(jax.vmap(learner.env.step))(start.arms, learner.mode(start.actor_params, start.arms.obs))
    np.testing.assert_allclose(
        after.arms.pipeline_state.pose[~begun], moved.pipeline_state.pose[~begun], atol=5e-3
    )


def test_an_arm_that_does_not_settle_is_left_out_and_begins_anew(update, start):
    arm = start.arms.pipeline_state
    broken = arm._replace(payload_kg=arm.payload_kg.at[0].set(jnp.nan))
    after, metrics = update(start._replace(arms=start.arms.replace(pipeline_state=broken)), jax.random.key(3))
    assert metrics["analytic/left_out"] == pytest.approx(1 / N_ARMS)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after.actor_params))
    assert np.isfinite(after.arms.pipeline_state.payload_kg).all()


def test_the_gradient_of_moving_arms_looks_several_actions_ahead():
    """Against differences of the loss, for changes of the first and of the last of three actions."""
    env = ReachEnv(SHORT, EnvConfig(n_poses=64, mode="dynamic", dynamic_step_s=0.1, goal_ends=False))
    learner = Analytic(dataclasses.replace(FEW, horizon=3), env)
    state = jax.jit(learner.init)(jax.random.key(0))
    loss = jax.vmap(jax.value_and_grad(learner._loss, has_aux=True), in_axes=(0, 0, None))
    at = jax.jit(lambda changes: loss(changes, state.arms, state.actor_params))
    changes = jnp.zeros((4, 3, env.action_size))
    (_, ahead), slope = at(changes)
    assert np.asarray(ahead.valid).all() and ahead.obs.shape == (4, 3, env.observation_size)
    np.testing.assert_array_equal(ahead.obs[:, 0], state.arms.obs)
    for k in (0, 2):
        way = jax.random.normal(jax.random.key(k), (env.action_size,))
        (above, _), _ = at(changes.at[:, k].set(3e-3 * way))
        (below, _), _ = at(changes.at[:, k].set(-3e-3 * way))
        np.testing.assert_allclose(slope[:, k] @ way, (above - below) / 6e-3, rtol=0.05, atol=2e-3)
    assert np.abs(slope[:, 0]).max() > 0.01  # what is done first counts later


def test_a_policy_is_adopted_and_may_observe_less(learner, start):
    env = ReachEnv(SHORT, EnvConfig(n_poses=64, mode="dynamic", observation="motion"))
    wider = Analytic(FEW, env)
    own = jax.jit(wider.init)(jax.random.key(1))
    obs = np.random.default_rng(0).normal(size=(5, env.observation_size)).astype(np.float32)
    expected = learner.mode(learner.policy(start), obs[:, : learner.env.observation_size])
    adopted = wider.adopt(own, learner.parts(start))
    np.testing.assert_allclose(wider.mode(wider.policy(adopted), obs), expected, atol=1e-6)
    smaller = Analytic(dataclasses.replace(FEW, hidden=(8,)), env)
    with pytest.raises(ValueError, match="actor: got layers of"):
        smaller.adopt(jax.eval_shape(smaller.init, jax.random.key(2)), learner.parts(start))
    carrying = Analytic(FEW, ReachEnv(SHORT, EnvConfig(engine="chain", n_poses=64, observation="payload")))
    with pytest.raises(ValueError, match="actor: got layers of"):  # it observes other things, not less
        wider.adopt(own, carrying.parts(jax.jit(carrying.init)(jax.random.key(2))))


@pytest.mark.parametrize(
    ("name", "value"), [("mean_share", 2.0), ("learning_rate_half", 0.0), ("horizon", 0)]
)
def test_a_setting_out_of_range_is_named(name, value):
    with pytest.raises(ValueError, match=f"learner.{name}: got {value}"):
        dataclasses.replace(CONFIG, **{name: value})
