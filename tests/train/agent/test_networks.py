"""Networks against NumPy, and the squashed Gaussian against the change of variables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.agent.networks import Actor, squash
from train.agent.tqc import Critics

pytestmark = pytest.mark.usefixtures("strict", "quick_compiler")

OBS, ACTION = 3, 2


def numpy_dense(layer, x):
    return x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)


def relu(x):
    return np.maximum(x, 0.0)


def test_log_std_is_clipped_at_both_ends():
    actor = Actor(1, hidden=())
    params = {"params": {"head": {"kernel": jnp.array([[0.0, 100.0]]), "bias": jnp.zeros(2)}}}
    _, log_std = actor.apply(params, jnp.array([[-1.0], [1.0]]))
    np.testing.assert_array_equal(log_std, [[-20.0], [2.0]])


def test_each_critic_equals_its_own_network_in_numpy():
    n_critics, width = 3, 5
    critics = Critics(n_critics, n_quantiles=4, hidden=(width, 6))
    obs = jax.random.normal(jax.random.key(0), (2, 4, OBS))
    action = jax.random.uniform(jax.random.key(1), (2, 4, ACTION))
    params = jax.jit(critics.init)(jax.random.key(2), obs, action)
    quantiles = critics.apply(params, obs, action)
    assert quantiles.shape == (2, 4, n_critics, 4)

    layers = params["params"]
    x = np.concatenate([obs, action], axis=-1).astype(np.float64)
    for c in range(n_critics):
        first = relu(numpy_dense(layers["hidden_0"], x)[..., c * width : (c + 1) * width])
        expected = numpy_dense(
            layers[f"critic_{c}_head"], relu(numpy_dense(layers[f"critic_{c}_hidden_1"], first))
        )
        np.testing.assert_allclose(quantiles[..., c, :], expected, atol=1e-5)


def test_layer_norm_makes_a_critic_blind_to_the_scale_of_its_first_layer():
    critics = Critics(2, n_quantiles=4, hidden=(8,), layer_norm=True)
    obs, action = jnp.ones((1, OBS)), jnp.full((1, ACTION), 0.5)
    params = jax.jit(critics.init)(jax.random.key(0), obs, action)
    first = params["params"]["hidden_0"]
    scaled = {"params": {**params["params"], "hidden_0": jax.tree.map(lambda leaf: 10.0 * leaf, first)}}
    # LayerNorm adds 1e-6 to a variance of order one, hence equality up to about 1e-6.
    np.testing.assert_allclose(
        critics.apply(scaled, obs, action), critics.apply(params, obs, action), atol=1e-5
    )


def test_log_prob_equals_the_numerical_change_of_variables():
    mean, log_std, noise = (np.array(x) for x in ([0.3, -0.8], [-0.5, 0.4], [1.1, -0.6]))
    action, log_prob = squash(*(jnp.asarray(x, jnp.float32) for x in (mean, log_std, noise)))

    std = np.exp(log_std)
    u, h = mean + std * noise, 1e-6
    density_u = np.exp(-0.5 * noise**2) / (std * np.sqrt(2 * np.pi))
    da_du = (np.tanh(u + h) - np.tanh(u - h)) / (2 * h)  # central difference, good to about 1e-10
    np.testing.assert_allclose(action, np.tanh(u), rtol=1e-6)
    np.testing.assert_allclose(log_prob, np.sum(np.log(density_u / da_du)), rtol=1e-5)


@pytest.mark.parametrize("pre_squash", [-40.0, -12.0, 12.0, 40.0])
def test_log_prob_and_its_gradient_stay_exact_where_tanh_rounds_to_one(pre_squash):
    def log_prob(mean):
        return squash(mean, jnp.zeros(1), jnp.zeros(1))[1]

    value, gradient = jax.value_and_grad(log_prob)(jnp.array([pre_squash]))
    log_cosh = np.logaddexp(pre_squash, -pre_squash) - np.log(2.0)
    # log(1 - tanh(u)^2) = -2 log cosh u, with the derivative -2 tanh u.
    assert value == pytest.approx(-0.5 * np.log(2 * np.pi) + 2.0 * log_cosh, rel=1e-6)
    assert gradient[0] == pytest.approx(2.0 * np.tanh(pre_squash), rel=1e-6)
