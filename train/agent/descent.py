"""Steps of an optimiser, and the schedule of its learning rate."""

from __future__ import annotations

from typing import Any

import optax

from train.agent.learner import ReplayConfig

Params = Any  # a flax parameter tree


def learning_rate(config: ReplayConfig, rate: float, end: float) -> float | optax.Schedule:
    """Return a learning rate with a half-cosine decay over a run, to a share `end` of it; 1 is no decay."""
    return rate if end == 1.0 else optax.cosine_decay_schedule(rate, config.n_decay_updates, end)


def descend(
    optimizer: optax.GradientTransformation, gradient: Params, opt_state: optax.OptState, params: Params
) -> tuple[Params, optax.OptState]:
    """Take one step down a gradient; return parameters and optimiser state."""
    updates, opt_state = optimizer.update(gradient, opt_state, params)
    return optax.apply_updates(params, updates), opt_state
