"""Discriminator between the expert's actions and the agent's, and the reward that it learns.

The logit h(s, a, g) is high where the expert acts. It is trained by cross-entropy, expert 1 and agent 0. A
penalty holds the length of its gradient near one at points between both. The paper's penalty is on the
gradient of the probability D instead, which vanishes where the discriminator is sure. The reward
log sigmoid(h) is the paper's log(1 - D) with D the probability of the agent. It changes with every update, so
it is computed when a batch is sampled.

Source: Ho and Ermon 2016, arXiv:1606.03476; gradient penalty: Gulrajani et al. 2017, arXiv:1704.00028.

Shapes: B batch, O observation (which holds the goal), A action.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax import Array

from mjx_softarm._support.fields import Amount, Positive, check_ranges
from train.agent.networks import descend


@dataclass(frozen=True)
class GailConfig:
    """Hyperparameters of the discriminator."""

    hidden: tuple[int, ...] = (256, 256)  # widths of the hidden layers
    learning_rate: Amount = 3e-4  # learning rate (Adam)
    gradient_penalty: Amount = 20.0  # weight of the gradient penalty, the paper's lambda
    penalty_on: Literal["logit", "probability"] = "logit"
    """output whose gradient is penalised; the paper's is the probability"""
    input_scale: Positive = 10.0  # factor on observations and actions, hence on the logit's slope

    def __post_init__(self) -> None:
        check_ranges("learner.gail.", self)


class DiscriminatorState(NamedTuple):
    """Parameters and state of the optimiser."""

    params: Any
    opt_state: optax.OptState


class Discriminator(nn.Module):
    """ReLU network from observation and action to one logit, high for the expert."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, obs: Array, action: Array) -> Array:
        x = jnp.concatenate([obs, action], axis=-1)  # (..., O + A)
        for i, width in enumerate(self.hidden):
            x = nn.relu(nn.Dense(width, name=f"hidden_{i}")(x))
        return nn.Dense(1, name="head")(x)[..., 0]


class Gail:
    """Network and optimiser of fixed structure, and pure functions of a `DiscriminatorState`."""

    def __init__(self, obs_size: int, action_size: int, config: GailConfig = GailConfig()) -> None:
        self.obs_size, self.action_size, self.config = obs_size, action_size, config
        self.network: Any = Discriminator(config.hidden)
        self.optimizer = optax.adam(config.learning_rate)

    def init(self, key: Array) -> DiscriminatorState:
        """Return fresh parameters."""
        params = self.network.init(key, jnp.zeros((1, self.obs_size)), jnp.zeros((1, self.action_size)))
        return DiscriminatorState(params, self.optimizer.init(params))

    def reward(self, params: Any, obs: Array, action: Array) -> Array:
        """Return the learned reward (...) of actions (..., A) at observations (..., O), never positive."""
        return jax.nn.log_sigmoid(self.network.apply(params, *self._scaled(obs, action)))

    def update(
        self,
        state: DiscriminatorState,
        expert: tuple[Array, Array],
        agent: tuple[Array, Array],
        key: Array,
    ) -> tuple[DiscriminatorState, dict[str, Array]]:
        """Take one gradient step; return the next state, and scalar metrics.

        `expert` and `agent` are observations (B, O) and actions (B, A). Row k of both has one goal, so the
        points between them have this goal, too.
        """
        # Points between expert and agent, where the gradient's norm should be 1.
        expert, agent = self._scaled(*expert), self._scaled(*agent)
        mix = jax.random.uniform(key, (expert[0].shape[0], 1))  # (B, 1)
        between = jax.tree.map(lambda e, a: mix * e + (1.0 - mix) * a, expert, agent)  # (B, O), (B, A)

        # Cross-entropy with the penalty, and one step of the optimiser.
        def loss(params: Any) -> tuple[Array, dict[str, Array]]:
            logits = functools.partial(self.network.apply, params)
            on_expert, on_agent = logits(*expert), logits(*agent)
            entropy = jnp.mean(jax.nn.softplus(-on_expert)) + jnp.mean(jax.nn.softplus(on_agent))
            probability = lambda *pair: jax.nn.sigmoid(logits(*pair))  # noqa: E731
            on_logit = self.config.penalty_on == "logit"
            penalty = gradient_penalty(logits if on_logit else probability, *between)
            accuracy = 0.5 * (jnp.mean(on_expert > 0.0) + jnp.mean(on_agent < 0.0))
            metrics = {"discriminator_loss": entropy, "gradient_penalty": penalty, "accuracy": accuracy}
            return entropy + self.config.gradient_penalty * penalty, metrics

        grads, metrics = jax.grad(loss, has_aux=True)(state.params)
        return DiscriminatorState(*descend(self.optimizer, grads, state.opt_state, state.params)), metrics

    def _scaled(self, obs: Array, action: Array) -> tuple[Array, Array]:
        return self.config.input_scale * obs, self.config.input_scale * action


def gradient_penalty(score: Callable[[Array, Array], Array], obs: Array, action: Array) -> Array:
    """Return the mean of (|grad score| - 1)^2 over points (B, O), (B, A), with the gradient by both.

    Where the gradient vanishes, the derivative of its length is taken as zero.
    """
    d_obs, d_action = jax.grad(lambda o, a: jnp.sum(score(o, a)), argnums=(0, 1))(obs, action)
    square = jnp.sum(d_obs**2, axis=-1) + jnp.sum(d_action**2, axis=-1)  # (B,)
    flat = square == 0.0  # (B,)
    length = jnp.where(flat, 0.0, jnp.sqrt(jnp.where(flat, 1.0, square)))  # (B,)
    return jnp.mean((length - 1.0) ** 2)
