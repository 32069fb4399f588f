"""The policy network of every learner, and the tanh-squashed Gaussian that it parametrises."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from mjx_softarm._support.mlp import Activation, activate
from mjx_softarm.mdp.observation import OBS_SIZE

LOG_STD_MIN = -20.0
LOG_STD_MAX = 2.0


class Actor(nn.Module):
    """Network from an observation to a diagonal Gaussian over pre-squash actions.

    Layers are named `hidden_0`, `hidden_1`, ... and `head`, by which export finds them. The head's first
    `action_size` outputs are the mean, the others the log standard deviation.
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


def squash(mean: jax.Array, log_std: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the action a = tanh(u), u = mean + exp(log_std) * noise, and its log-density.

    The Jacobian term uses log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u)), which stays finite and
    differentiable where tanh has already rounded to one.

    Mean, log standard deviation and the standard normal noise are (..., A), and so is the action in (-1, 1),
    up to rounding at the ends; the log-density (...) is the sum over actions.

    Source: Haarnoja et al. 2018, arXiv:1812.05905, appendix C (enforcing action bounds).
    """
    pre_squash = mean + jnp.exp(log_std) * noise  # (..., A)
    log_gaussian = -0.5 * jnp.square(noise) - log_std - 0.5 * jnp.log(2.0 * jnp.pi)  # (..., A)
    log_jacobian = 2.0 * (jnp.log(2.0) - pre_squash - jax.nn.softplus(-2.0 * pre_squash))  # (..., A)
    return jnp.tanh(pre_squash), jnp.sum(log_gaussian - log_jacobian, axis=-1)


def mode(mean: jax.Array) -> jax.Array:
    """Return the deterministic action (..., A): the squashed mean, which is also its median."""
    return jnp.tanh(mean)
