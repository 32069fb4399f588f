"""Losses against loops in NumPy, and one update against what it must and must not depend on."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from train.agent import tqc
from train.agent.learner import Transition
from train.agent.networks import squash
from train.agent.tqc import TQC, TQCConfig

B, OBS, ACTION, C, M, DROP = 4, 3, 2, 2, 5, 1
K = C * (M - DROP)
CONFIG = TQCConfig(
    hidden=(8,),
    hidden_critic=(8, 8),
    n_critics=C,
    n_quantiles=M,
    n_drop_per_critic=DROP,
    learning_rate=1e-2,
    learning_rate_alpha=1e-2,
    tau=0.1,
    reward_scale=2.0,
)

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture(autouse=True, scope="module")
def strict():
    # Ranks only: optax's Adam raises a float to an integer power, which strict dtypes refuse.
    with jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture
def strict_dtypes():
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(scope="module")
def agent():
    return TQC(OBS, ACTION, CONFIG)


@pytest.fixture(scope="module")
def init(agent):
    return jax.jit(agent.init)


@pytest.fixture(scope="module")
def state(init):
    """Target critics unlike the critics, as after some updates."""
    return init(jax.random.key(0))._replace(target_params=init(jax.random.key(1)).critic_params)


@pytest.fixture(scope="module")
def update(agent):
    return jax.jit(agent.update)


def make_batch():
    rng = np.random.default_rng(0)

    def draw(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    return Transition(
        obs=draw(B, OBS),
        action=jnp.tanh(draw(B, ACTION)),
        reward=draw(B),
        next_obs=draw(B, OBS),
        terminated=jnp.array([0.0, 1.0, 0.0, 1.0]),
    )


def equal(tree_a, tree_b):
    return jax.tree.all(jax.tree.map(np.array_equal, tree_a, tree_b))


def quantile_huber_by_loops(quantiles, targets):
    terms = []
    for b, c, m, k in np.ndindex(B, C, M, K):
        delta = targets[b, k] - quantiles[b, c, m]
        huber = 0.5 * delta**2 if abs(delta) <= 1.0 else abs(delta) - 0.5
        terms.append(abs((m + 0.5) / M - (delta < 0.0)) * huber)
    return sum(terms) / len(terms)


def test_quantile_huber_loss_is_that_of_loops_and_its_gradient_that_of_finite_differences(strict_dtypes):
    rng = np.random.default_rng(0)  # differences on both sides of zero and of the Huber corner at one
    quantiles, targets = rng.normal(size=(B, C, M)), 2.0 * rng.normal(size=(B, K))
    gradient = jax.jit(jax.value_and_grad(tqc.quantile_huber_loss, argnums=(0, 1)))
    given = (jnp.asarray(x, jnp.float32) for x in (quantiles, targets))
    loss, (d_quantiles, d_targets) = gradient(*given)
    # 320 terms of order one in float32.
    assert loss == pytest.approx(quantile_huber_by_loops(quantiles, targets), rel=1e-5)
    h = 1e-5  # the loss is piecewise quadratic: a central difference is exact away from its corners
    expected = np.zeros_like(quantiles)
    for index in np.ndindex(quantiles.shape):
        step = np.zeros_like(quantiles)
        step[index] = h
        above = quantile_huber_by_loops(quantiles + step, targets)
        expected[index] = (above - quantile_huber_by_loops(quantiles - step, targets)) / (2 * h)
    np.testing.assert_allclose(d_quantiles, expected, atol=1e-6)  # entries of order 1 / (B C M) = 0.025
    np.testing.assert_array_equal(d_targets, 0.0)


@pytest.mark.parametrize("n_drop", [0, 1, 4, 9])
def test_drop_largest_keeps_what_a_sort_keeps_also_with_ties(n_drop, strict_dtypes):
    rng = np.random.default_rng(n_drop)
    samples = rng.integers(-3, 4, size=(50, 10)).astype(np.float32)
    kept = np.asarray(jax.jit(tqc.drop_largest, static_argnums=1)(jnp.asarray(samples), n_drop))
    np.testing.assert_array_equal(np.sort(kept, axis=-1), np.sort(samples, axis=-1)[:, : 10 - n_drop])


def test_update_is_one_adam_step_on_each_loss_at_the_incoming_state(agent, state, update):
    batch, key = make_batch(), jax.random.key(1)
    got, metrics = update(state, batch, key)
    noise, next_noise = jax.random.normal(key, (2, B, ACTION))
    alpha = jnp.exp(state.log_alpha)

    @jax.jit
    def next_step(state):
        action, log_prob = squash(*agent.actor.apply(state.actor_params, batch.next_obs), next_noise)
        return agent.critics.apply(state.target_params, batch.next_obs, action), log_prob

    next_quantiles, next_log_prob = map(np.asarray, next_step(state))
    pools = np.sort(next_quantiles.reshape(B, C * M))[:, :K]
    reward = CONFIG.reward_scale * np.asarray(batch.reward)[:, None]
    lasts = 1.0 - np.asarray(batch.terminated)[:, None]
    targets = reward + CONFIG.gamma * lasts * (pools - alpha * next_log_prob[:, None])

    def critic_objective(params):
        return tqc.quantile_huber_loss(
            agent.critics.apply(params, batch.obs, batch.action), jnp.asarray(targets)
        )

    def actor_objective(params):
        action, log_prob = squash(*agent.actor.apply(params, batch.obs), noise)
        quantiles = agent.critics.apply(state.critic_params, batch.obs, action)
        loss = jnp.mean(alpha * log_prob - jnp.mean(quantiles, axis=(1, 2)))
        return loss, jnp.mean(log_prob)

    loss_critic, d_critic = jax.jit(jax.value_and_grad(critic_objective))(state.critic_params)
    actor_grad = jax.jit(jax.value_and_grad(actor_objective, has_aux=True))
    (loss_actor, mean_log_prob), d_actor = actor_grad(state.actor_params)
    d_log_alpha = -mean_log_prob + ACTION  # the target entropy is minus the number of actions
    assert metrics["tqc/critic_loss"] == pytest.approx(float(loss_critic), rel=1e-5)
    assert metrics["tqc/actor_loss"] == pytest.approx(float(loss_actor), rel=1e-5)
    assert metrics["tqc/entropy"] == pytest.approx(-float(mean_log_prob), rel=1e-5)
    for grads, opt_state, before, after in (
        (d_critic, got.critic_opt_state, state.critic_params, got.critic_params),
        (d_actor, got.actor_opt_state, state.actor_params, got.actor_params),
        (d_log_alpha, got.alpha_opt_state, state.log_alpha, got.log_alpha),
    ):
        momentum = optax.tree.get(opt_state, "mu")
        for g, mu, old, new in zip(*map(jax.tree.leaves, (grads, momentum, before, after)), strict=True):
            g, mu, old, new = (np.asarray(x, np.float64) for x in (g, mu, old, new))
            np.testing.assert_allclose(mu, 0.1 * g, rtol=1e-4, atol=1e-7)  # Adam's first moment, 1 - b1 = 0.1
            # Adam's first step is rate * g / (|g| + 1e-8): the gradient's sign, but for rounding about zero.
            step, certain = CONFIG.learning_rate * g / (np.abs(g) + 1e-8), np.abs(g) > 1e-6
            np.testing.assert_allclose((old - new)[certain], step[certain], atol=2e-2 * CONFIG.learning_rate)


@pytest.mark.parametrize(
    "network, average", [("critic_params", "target_params"), ("actor_params", "mean_actor_params")]
)
def test_averages_begin_with_the_networks_and_move_by_tau_towards_new_ones(
    state, init, update, network, average
):
    first = init(jax.random.key(2))
    assert equal(getattr(first, network), getattr(first, average))
    before = state._replace(**{average: getattr(init(jax.random.key(7)), network)})
    got, _ = update(before, make_batch(), jax.random.key(1))
    trees = getattr(got, network), getattr(before, average), getattr(got, average)
    for new, old, mean in zip(*map(jax.tree.leaves, trees), strict=True):
        expected = (1.0 - CONFIG.tau) * np.asarray(old) + CONFIG.tau * np.asarray(new)
        np.testing.assert_allclose(mean, expected, atol=1e-6)


def test_acting_samples_around_the_mode(agent, state):
    obs = jnp.ones((OBS,))
    mean, log_std = agent.actor.apply(state.actor_params, obs)
    key = jax.random.key(4)
    np.testing.assert_allclose(agent.mode(state.actor_params, obs), np.tanh(mean), rtol=1e-6)
    expected = np.tanh(mean + np.exp(log_std) * jax.random.normal(key, (ACTION,)))
    np.testing.assert_allclose(agent.act(state, obs, key), expected, rtol=1e-5)


@pytest.mark.parametrize("field", Transition._fields[:5])
def test_a_batch_field_of_the_wrong_shape_is_named(agent, state, field):
    batch = make_batch()
    wrong = batch._replace(**{field: getattr(batch, field)[..., None]})
    with pytest.raises(ValueError, match=rf"Transition\.{field}: got shape .* expected "):
        agent.update(state, wrong, jax.random.key(0))
