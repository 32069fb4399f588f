"""A one-step and a two-step problem whose values are known, learned by the whole of `TQC.update`.

The one needs the critics' regression and the actor's gradient, the other discounting and bootstrapping.
Data are uniform random actions; no simulator is involved.

The temperature is held at a known value. In a one-step problem the critics' target is the reward alone, so
the entropy does not enter the value; the best stochastic policy is then proportional to exp(reward / alpha),
narrow at a small alpha. In the two-step problem the value of the first state carries the entropy of the
second action: the test adds it, with an alpha large enough to see it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.agent.learner import Transition
from train.agent.tqc import TQC, TQCConfig

GAMMA = 0.9
ALPHA, ALPHA_TWO_STEP = 0.02, 0.5
N_ITEMS, BATCH, N_UPDATES = 2048, 64, 1500
# Over six seeds the one-step values are within 0.007 of the truth and the best actions within 0.04. The
# two-step value is within 0.06, its targets carrying the noise of alpha * log_prob; were the entropy left
# out, it would be off by 0.31.
VALUE_TOLERANCE, ACTION_TOLERANCE, TWO_STEP_TOLERANCE = 0.03, 0.1, 0.1

AGENT = TQC(
    obs_size=1,
    action_size=1,
    config=TQCConfig(
        hidden=(32, 32),
        hidden_critic=(32, 32),
        n_quantiles=5,
        n_drop_per_critic=1,
        learning_rate=3e-3,
        learning_rate_alpha=0.0,  # holds the temperature
        gamma=GAMMA,
        tau=0.05,
    ),
)


@pytest.fixture(scope="module")
def learn():
    """Trains a fresh agent on fixed data; compiled once for both problems."""

    def step(carry, key):
        state, data = carry
        key_rows, key_update = jax.random.split(key)
        rows = jax.random.randint(key_rows, (BATCH,), 0, N_ITEMS)
        batch = jax.tree.map(lambda leaf: leaf[rows], data)
        return (AGENT.update(state, batch, key_update)[0], data), None

    def run(data, log_alpha, key):
        key_init, key_steps = jax.random.split(key)
        carry = (AGENT.init(key_init)._replace(log_alpha=log_alpha), data)
        return jax.lax.scan(step, carry, jax.random.split(key_steps, N_UPDATES))[0][0]

    compiled = jax.jit(run)
    return lambda data, alpha=ALPHA, seed=0: compiled(data, jnp.log(jnp.float32(alpha)), jax.random.key(seed))


def transitions(obs, action, reward, next_obs=None, terminated=1.0):
    """N_ITEMS rows from scalars or arrays (N_ITEMS,)."""
    next_obs = obs if next_obs is None else next_obs
    fields = [np.broadcast_to(x, N_ITEMS) for x in (obs, action, reward, next_obs, terminated)]
    obs, action, reward, next_obs, terminated = (jnp.asarray(x, jnp.float32) for x in fields)
    return Transition(obs[:, None], action[:, None], reward, next_obs[:, None], terminated)


def random_actions():
    return np.random.default_rng(1).uniform(-1.0, 1.0, N_ITEMS)


def random_signs():
    return np.random.default_rng(2).choice([-1.0, 1.0], N_ITEMS)


def value(state, obs, action):
    """Mean over critics and quantiles at rows of scalars."""
    obs, action = (jnp.asarray(x, jnp.float32)[:, None] for x in (obs, action))
    quantiles = AGENT.critics.apply(state.critic_params, obs, action)
    return np.mean(quantiles, axis=(1, 2))


def best_action(state, obs):
    return np.asarray(AGENT.mode(state.actor_params, jnp.asarray(obs, jnp.float32)[:, None]))[:, 0]


def greatest_entropy():
    """Greatest entropy [nat] of a tanh-squashed Gaussian of mean zero, by quadrature over its deviation."""
    z = np.linspace(-8.0, 8.0, 4001)
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    entropies = []
    for std in np.linspace(0.3, 2.0, 171):
        u = std * z
        log_cosh = np.logaddexp(u, -u) - np.log(2.0)
        gaussian = 0.5 * np.log(2 * np.pi * np.e * std**2)
        entropies.append(gaussian + np.sum(density * -2.0 * log_cosh) * (z[1] - z[0]))
    return max(entropies)


ACTIONS = np.array([-0.9, -0.3, 0.3, 0.9])


def test_a_reward_one_step_later_is_discounted_and_carries_the_entropy_of_the_step_between(learn):
    # The first state, 0, pays nothing and leads to the second, 1, which pays 1 and terminates. No action
    # matters, so the policy is the squashed Gaussian of greatest entropy: Q(0) = GAMMA (1 + alpha * entropy).
    second = random_signs() > 0.0
    data = transitions(second, random_actions(), reward=second, next_obs=1.0, terminated=second)
    state = learn(data, alpha=ALPHA_TWO_STEP)
    np.testing.assert_allclose(value(state, np.ones(4), ACTIONS), 1.0, atol=TWO_STEP_TOLERANCE)
    expected = GAMMA * (1.0 + ALPHA_TWO_STEP * greatest_entropy())
    np.testing.assert_allclose(value(state, np.zeros(4), ACTIONS), expected, atol=TWO_STEP_TOLERANCE)


def test_policy_finds_the_best_action_of_each_observation(learn):
    actions, signs = random_actions(), random_signs()
    state = learn(transitions(signs, actions, reward=-((actions - 0.5 * signs) ** 2)))
    for sign in (-1.0, 1.0):
        expected = -((ACTIONS - 0.5 * sign) ** 2)
        np.testing.assert_allclose(value(state, np.full(4, sign), ACTIONS), expected, atol=VALUE_TOLERANCE)
    np.testing.assert_allclose(best_action(state, np.array([-1.0, 1.0])), [-0.5, 0.5], atol=ACTION_TOLERANCE)
