"""Prediction of an arm in motion, which its critics observe beside observation and action.

A network predicts the observation after an action from the pose, the sensed entries and the action. The goal
does not enter, so transitions of all goals teach it. It is applied n times with the action held. The critics
observe the predicted errors, and their quantiles fall in proportion to the norms of these.

Sources: critics that observe a learned prediction, Fujimoto et al., "For SALE: State-Action Representation
Learning for Deep Reinforcement Learning", NeurIPS 2023; critics that fall with a distance to the goal, Liu et
al., "Metric Residual Networks for Sample Efficient Goal-Conditioned Reinforcement Learning", AAAI 2023.

Shapes: B batch, O observation, A action, C critics, M quantiles per critic.
"""

from __future__ import annotations

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax import Array

from mjx_softarm.mdp.observation import ERROR, GOAL, OBS_SIZE, POSE
from train.agent.networks import Critics

Params = Any  # a flax parameter tree
ERROR_UNIT = 0.2  # error of 1 in the network's units: some 36 mm, what an arm moves in half a second
LOSS_WEIGHT = 10.0  # weight of the prediction's loss beside that of the critics


class Predictor(nn.Module):
    """ReLU network that predicts the change of an observation by an action.

    Attributes:
        hidden: width of each hidden layer.
    """

    hidden: tuple[int, ...] = (256, 256)

    @nn.compact
    def __call__(self, obs: Array, action: Array) -> Array:
        """Return the changes (..., O - 6 - A) of pose, error and what is sensed, without goal and action."""
        x = jnp.concatenate([obs[..., POSE], obs[..., OBS_SIZE:], action], axis=-1)
        for i, width in enumerate(self.hidden):
            x = nn.relu(nn.Dense(width, name=f"hidden_{i}")(x))
        n_sensed = obs.shape[-1] - OBS_SIZE - action.shape[-1]
        small = nn.initializers.variance_scaling(0.1, "fan_in", "truncated_normal")  # no change, at first
        return nn.Dense(12 + n_sensed, kernel_init=small, name="head")(x)


class PredictiveCritics:
    """Quantile critics that observe the errors predicted for an action that is held.

    It takes the place of `Critics`. The critics' loss does not teach the predictor; `loss` does.

    Args:
        critics: networks of the quantiles.
        predictor: network of the prediction.
        n_ahead: number of actions that are predicted.
    """

    def __init__(self, critics: Critics, predictor: Predictor, n_ahead: int):
        self.critics: Any = critics  # flax's own types do not tell what a module returns
        self.predictor: Any = predictor
        self.n_ahead = n_ahead

    def init(self, key: Array, obs: Array, action: Array) -> dict[str, Params]:
        """Return fresh parameters for observations (B, O) and actions (B, A)."""
        keys = jax.random.split(key)
        ahead = jnp.zeros((*obs.shape[:-1], self.n_ahead, 6))
        return {
            "critics": self.critics.init(keys[0], obs, action, ahead),
            "predictor": self.predictor.init(keys[1], obs, action),
        }

    def apply(self, params: dict[str, Params], obs: Array, action: Array) -> Array:
        """Return the quantiles (..., C, M) of the return at obs (..., O) and action (..., A)."""
        predictor, later, ahead = jax.lax.stop_gradient(params["predictor"]), obs, []
        for _ in range(self.n_ahead):
            later = self.after(predictor, later, action)
            ahead.append(later[..., ERROR])
        return self.critics.apply(params["critics"], obs, action, jnp.stack(ahead, axis=-2))

    @functools.partial(jax.jit, static_argnums=0)  # traced once for all that look ahead
    def after(self, predictor: Params, obs: Array, action: Array) -> Array:
        """Return the observation (..., O) that is predicted after an action (..., A)."""
        change = self.predictor.apply(predictor, obs, action)
        pose, error, sensed = jnp.split(change, (6, 12), axis=-1)
        known = (obs[..., OBS_SIZE : -action.shape[-1]] + sensed, action)
        moved = obs[..., POSE] + pose, obs[..., GOAL], obs[..., ERROR] + ERROR_UNIT * error
        return jnp.concatenate([*moved, *known], axis=-1)

    def loss(self, params: dict[str, Params], obs: Array, action: Array, next_obs: Array) -> Array:
        """Return the prediction's loss (): a square up to one unit, then linear, for angles that wrap."""
        off = self.after(params["predictor"], obs, action) - next_obs
        off = off.at[..., ERROR].divide(ERROR_UNIT)
        return LOSS_WEIGHT * 2.0 * jnp.mean(optax.huber_loss(off))
