"""The learned reward: losses against NumPy, descent on them, and an expert that is recovered by it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.agent.gail import Gail, GailConfig, gradient_penalty
from train.agent.learner import Transition
from train.agent.tqc import TQC, TQCConfig

RNG = np.random.default_rng(0)
OBS, ACTION = RNG.normal(size=(64, 5)), RNG.normal(size=(64, 3))


@pytest.mark.parametrize("penalty_on", ["logit", "probability"])
def test_losses_and_reward_are_the_paper_s_with_a_penalty_on_the_logit_or_on_the_probability(penalty_on):
    """The probability's slope is D (1 - D) times the logit's; the reward is log(1 - D) of the agent's D."""
    gail = Gail(5, 3, GailConfig(hidden=(8,), input_scale=1.0, penalty_on=penalty_on))
    state, (obs, action) = gail.init(jax.random.PRNGKey(0)), (jnp.array(OBS), jnp.array(ACTION))
    pair = (obs, action), (obs, action)  # all points between the two are the pair itself
    _, metrics = jax.jit(gail.update)(state, *pair, jax.random.PRNGKey(1))
    logit = lambda x: gail.network.apply(state.params, x[:5], x[5:])  # noqa: E731
    rows = jnp.concatenate([obs, action], axis=-1)
    slope = np.linalg.norm(jax.vmap(jax.grad(logit))(rows), axis=-1)
    probability = 1.0 / (1.0 + np.exp(-jax.vmap(logit)(rows)))  # of the expert
    if penalty_on == "probability":
        slope = slope * probability * (1.0 - probability)
    np.testing.assert_allclose(metrics["gradient_penalty"], np.mean((slope - 1.0) ** 2), rtol=1e-4)
    entropy = -np.mean(np.log(probability)) - np.mean(np.log(1.0 - probability))
    np.testing.assert_allclose(metrics["discriminator_loss"], entropy, rtol=1e-4)
    of_agent = 1.0 - probability
    np.testing.assert_allclose(gail.reward(state.params, obs, action), np.log(1.0 - of_agent), rtol=1e-4)


def test_penalty_and_its_slope_are_finite_where_the_discriminator_is_flat():
    value, slope = jax.value_and_grad(
        lambda w: gradient_penalty(lambda o, a: w * jnp.sum(o, -1) + 0.0 * a[..., 0], OBS, ACTION)
    )(0.0)
    assert value == 1.0 and slope == 0.0


def test_an_update_descends_on_the_loss_and_its_penalty():
    gail = Gail(5, 3, GailConfig(hidden=(32, 32), learning_rate=1e-2, input_scale=1.0))
    state = gail.init(jax.random.PRNGKey(0))
    expert, agent = (jnp.array(OBS), jnp.array(ACTION)), (jnp.array(OBS), jnp.array(ACTION + 2.0))
    update = jax.jit(lambda state, key: gail.update(state, expert, agent, key))
    state, first = update(state, jax.random.PRNGKey(1))
    for key in jax.random.split(jax.random.PRNGKey(1), 99):
        state, last = update(state, key)
    assert last["discriminator_loss"] < 0.6 * first["discriminator_loss"]
    assert last["gradient_penalty"] < 0.05 < first["gradient_penalty"]
    assert last["accuracy"] > 0.9


@pytest.mark.slow
def test_an_expert_is_recovered_from_its_actions_alone():
    """Eight goals in the plane; the reward is the learned one, a quarter of a batch the expert's."""
    goals = jnp.asarray(np.random.default_rng(1).uniform(-1.0, 1.0, (8, 2)), jnp.float32)
    answers = jnp.stack(
        [0.7 * jnp.sin(2.0 * goals[:, 0]), 0.5 * goals[:, 1] - 0.3 * goals[:, 0] ** 2], axis=-1
    )
    n = 1600
    gail = Gail(2, 2, GailConfig(hidden=(64, 64), learning_rate=1e-3))
    config = TQCConfig(
        n_arms=1,
        total_env_steps=n,
        hidden=(64, 64),
        hidden_critic=(64, 64),
        learning_rate=1e-3,
        learning_rate_end=0.02,
        initial_alpha=0.02,
        learning_rate_alpha=1e-2,
        target_entropy=-6.0,
        reward_scale=10.0,
    )
    tqc = TQC(2, 2, config)
    assert config.n_decay_updates == n

    def update(states, key):
        agent, discriminator = states
        key_goal, key_act, key_gail, key_tqc = jax.random.split(key, 4)
        k = jax.random.randint(key_goal, (64,), 0, 8)
        goal, action = goals[k], tqc.act(agent, goals[k], key_act)
        discriminator, _ = gail.update(discriminator, (goal, answers[k]), (goal, action), key_gail)
        action = jnp.concatenate([answers[k][:16], action[16:]])
        reward = gail.reward(discriminator.params, goal, action)
        batch = Transition(goal, action, reward, goal, jnp.ones(64))
        return (tqc.update(agent, batch, key_tqc)[0], discriminator), None

    def error(agent):
        return float(jnp.mean(jnp.abs(tqc.mode(agent.actor_params, goals) - answers)))

    states = (tqc.init(jax.random.PRNGKey(0)), gail.init(jax.random.PRNGKey(1)))
    before = error(states[0])
    run = jax.jit(lambda states, keys: jax.lax.scan(update, states, keys)[0])
    agent, _ = run(states, jax.random.split(jax.random.PRNGKey(3), n))
    assert error(agent) < 0.07 < 0.2 < before
