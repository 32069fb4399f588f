"""The policy that a run of TQC in motion begins with, which the actor leaves as the critics become exact.

A policy that was trained at rest also serves in motion. New critics do not know that, and an actor that
climbs them unlearns it at once. Three things hold the actor back:

- Actor and temperature wait while the critics learn from what the given policy does.
- The actor's learning rate is a tenth of the critics'.
- The actor's loss charges for departures from the given policy pi_0, by the error e before the action, since
  a policy at rest is most exact close to the goal:

    w E[ ||pi(s) - pi_0(s)||^2 / (min(||e||, FAR)^2 + NEAR^2) ]

  with a weight w that falls over the run.

Source: a cost of departures beside the critics, Fujimoto, Gu, "A Minimalist Approach to Offline Reinforcement
Learning", NeurIPS 2021.

Shapes: B batch, O observation, A action.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from mjx_softarm.mdp.observation import ERROR

WEIGHT = 100.0  # weight of departures at the start of the run
WEIGHT_END = 0.05  # share of the weight at the end
NEAR, FAR = 0.02, 0.1  # scaled errors, some 4 and 18 mm, between which departures become cheaper
WAIT = 3_000  # gradient steps of the critics before the actor's first
RISE = 2_000  # gradient steps over which the actor's learning rate then rises
RATE_SHARE = 0.1  # learning rate of the actor over that of the critics


def held_back(rate: float | optax.Schedule, share: float = 1.0) -> optax.Schedule:
    """Return a share of a learning rate, after a wait at zero and a rise."""

    def at(n_updates: Any) -> Any:
        full = rate(n_updates) if callable(rate) else rate
        return share * full * jnp.clip((n_updates - WAIT) / RISE, 0.0, 1.0)

    return at


def departure_cost(obs: Array, action: Array, given: Array, done: Array) -> Array:
    """Return the cost () of actions (B, A) that depart from the given policy's (B, A) at obs (B, O).

    Args:
        obs: observations.
        action: the actor's deterministic actions.
        given: actions of the policy that the run began with, constants here.
        done (): share of the run's gradient steps that are taken.
    """
    squares = jnp.sum((action - jax.lax.stop_gradient(given)) ** 2, axis=-1)  # (B,)
    errors = jnp.sum(obs[:, ERROR] ** 2, axis=-1)  # (B,)
    return WEIGHT * WEIGHT_END**done * jnp.mean(squares / (jnp.minimum(errors, FAR**2) + NEAR**2))
