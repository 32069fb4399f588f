"""Actor and critic networks, and the tanh-squashed Gaussian that the actor parametrises."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from mjx_softarm._support.mlp import Activation, activate
from mjx_softarm.mdp.observation import OBS_SIZE

LOG_STD_MIN = -20.0
LOG_STD_MAX = 2.0
COST_AHEAD = 40.0  # initial weight of a predicted error of 1, summed over the predictions


class Actor(nn.Module):
    """Network from an observation to a diagonal Gaussian over pre-squash actions.

    Layers are named `hidden_0`, `hidden_1`, ... and `head`, by which export finds them. The head's first
    `action_size` outputs are the mean, the others the log standard deviation.

    Attributes:
        action_size: number of actions A.
        hidden: width of each hidden layer.
        activation: function after each hidden layer.
    """

    action_size: int
    hidden: tuple[int, ...] = (256, 256)
    activation: Activation = "relu"

    @nn.compact
    def __call__(self, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return mean (..., A) and log standard deviation (..., A), clipped to [-20, 2], at obs (..., O)."""
        x = obs  # (..., O)
        for i, width in enumerate(self.hidden):
            x = activate(nn.Dense(width, name=f"hidden_{i}")(x), self.activation)  # (..., H_i)
        head = nn.Dense(2 * self.action_size, name="head")(x)  # (..., 2A)
        mean, log_std = jnp.split(head, 2, axis=-1)  # (..., A) each
        return mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)


def widened(params: Any, obs_size: int) -> Any:
    """Return an actor's parameters; an actor of pose and goal alone is made to take (..., O).

    The weights of the new entries are zero. An actor that observes more stays as it is.
    """
    params = jax.tree.map(jnp.asarray, params)
    first = params["params"]["hidden_0"]
    unseen = max(0, obs_size - OBS_SIZE) if len(first["kernel"]) == OBS_SIZE else 0
    first["kernel"] = jnp.pad(first["kernel"], ((0, unseen), (0, 0)))
    return params


def descend(
    optimizer: optax.GradientTransformation, gradient: Any, opt_state: optax.OptState, params: Any
) -> tuple[Any, optax.OptState]:
    """Take one step down a gradient; return parameters and optimiser state."""
    updates, opt_state = optimizer.update(gradient, opt_state, params)
    return optax.apply_updates(params, updates), opt_state


def own_buffers(tree: Any) -> Any:
    """Return a copy of a tree of arrays, so that a state that has both can be donated."""
    return jax.tree.map(jnp.copy, tree)


def check_same_shapes(name: str, given: Any, own: Any) -> None:
    """Raise ValueError where a donor's tree of arrays has other shapes than a run's own."""
    got, expected = ([leaf.shape for leaf in jax.tree.leaves(tree)] for tree in (given, own))
    if got != expected:
        raise ValueError(f"{name}: got layers of {got}, expected {expected} as in the new run")


class Critics(nn.Module):
    """An ensemble of independent quantile networks of (observation, action).

    All critics read the same input, so their first layers are one matrix whose columns are split among them.
    Deeper layers are a matrix per critic. No parameter is shared. On a CPU this is faster than a vmapped
    ensemble, which transposes at every layer.

    Attributes:
        n_critics: number of critics C.
        n_quantiles: quantiles per critic M.
        hidden: width of each hidden layer of one critic, at least one.
        layer_norm: normalise each hidden layer before its ReLU.
    """

    n_critics: int = 2
    n_quantiles: int = 25
    hidden: tuple[int, ...] = (256, 256)
    layer_norm: bool = False

    @nn.compact
    def __call__(self, obs: jax.Array, action: jax.Array, ahead: jax.Array | None = None) -> jax.Array:
        """Return the quantiles (..., C, M) of the return, unsorted, at obs (..., O) and action (..., A).

        With errors (..., K, 6) that are predicted after the action, the quantiles fall with their norms.
        """
        inputs = [obs, action]
        if ahead is not None:
            norms = jnp.sqrt(jnp.sum(ahead**2, axis=-1) + 1e-8)  # (..., K)
            inputs += [ahead.reshape(*ahead.shape[:-2], -1), norms]
        x = jnp.concatenate(inputs, axis=-1)  # (..., O + A, and 7 K)
        first = nn.Dense(self.n_critics * self.hidden[0], name="hidden_0")(x)  # (..., C * H_0)
        quantiles = []
        for c, x in enumerate(jnp.split(first, self.n_critics, axis=-1)):  # (..., H_0)
            x = self._activate(x, f"critic_{c}_norm_0")
            for i, width in enumerate(self.hidden[1:], start=1):
                x = nn.Dense(width, name=f"critic_{c}_hidden_{i}")(x)  # (..., H_i)
                x = self._activate(x, f"critic_{c}_norm_{i}")
            quantiles.append(nn.Dense(self.n_quantiles, name=f"critic_{c}_head")(x))  # (..., M)
            if ahead is not None:
                initial = nn.initializers.constant(jnp.log(jnp.expm1(COST_AHEAD / norms.shape[-1])))
                cost = nn.softplus(self.param(f"critic_{c}_cost", initial, norms.shape[-1:]))  # (K,)
                quantiles[c] -= jnp.sum(cost * norms, axis=-1, keepdims=True)
        return jnp.stack(quantiles, axis=-2)  # (..., C, M)

    def _activate(self, x: jax.Array, norm_name: str) -> jax.Array:
        return nn.relu(nn.LayerNorm(name=norm_name)(x) if self.layer_norm else x)


def squash(mean: jax.Array, log_std: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the action a = tanh(u), u = mean + exp(log_std) * noise, and its log-density.

    The Jacobian term uses log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u)), which stays finite and
    differentiable where tanh has already rounded to one.

    Args:
        mean (..., A): mean before squashing.
        log_std (..., A): log standard deviation before squashing.
        noise (..., A): standard normal draw.

    Returns:
        action (..., A) in (-1, 1), up to rounding at the ends, and log_prob (...): the sum over actions.

    Source: Haarnoja et al. 2018, arXiv:1812.05905, appendix C (enforcing action bounds).
    """
    pre_squash = mean + jnp.exp(log_std) * noise  # (..., A)
    log_gaussian = -0.5 * jnp.square(noise) - log_std - 0.5 * jnp.log(2.0 * jnp.pi)  # (..., A)
    log_jacobian = 2.0 * (jnp.log(2.0) - pre_squash - jax.nn.softplus(-2.0 * pre_squash))  # (..., A)
    return jnp.tanh(pre_squash), jnp.sum(log_gaussian - log_jacobian, axis=-1)


def mode(mean: jax.Array) -> jax.Array:
    """Return the deterministic action (..., A): the squashed mean, which is also its median."""
    return jnp.tanh(mean)
