"""Straight lines in x / (1 - share x) that minimise Huber's loss, by L-BFGS."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from calib.fit.leastsquares import SIGMA_PER_MEDIAN

HUBER = 1.345  # in standard deviations of the noise: 95 % of the efficiency of least squares
ROUNDS = 5  # of scale and parameters in turn
ITERATIONS = 40  # of L-BFGS in each round


@functools.partial(jax.jit, static_argnames="fit_share")
def descend(x: Array, y: Array, share: Array, fit_share: bool) -> Array:
    """Return slopes (k,), offsets (k,) and, if fitted, the change of the share that minimise Huber's loss.

    Args:
        x, y (n, k): columns, NaN where missing; y has unit spread.
        share (): start of the share.
        fit_share: whether to fit the share.
    """
    known = jnp.isfinite(x) & jnp.isfinite(y)
    n, k = known.sum(axis=0), x.shape[1]
    x, y = jnp.where(known, x, 0.0), jnp.where(known, y, 0.0)

    def features(p: Array) -> tuple[Array, Array, Array]:  # standardised, with mean and spread
        wire = wire_length(x, share + p[2 * k :].sum())
        mean = jnp.sum(known * wire, axis=0) / n
        spread = jnp.sqrt(jnp.maximum(jnp.sum(known * (wire - mean) ** 2, axis=0) / n, 1e-300))
        return (wire - mean) / spread, mean, spread

    def residual(p: Array) -> Array:
        return jnp.where(known, p[:k] * features(p)[0] + p[k : 2 * k] - y, 0.0)

    def minimise(p: Array, scale: Array) -> Array:
        def loss(p):
            huber = jnp.where(known, optax.losses.huber_loss(residual(p) / scale, delta=HUBER), 0.0)
            return jnp.min(scale) ** 2 * jnp.sum(huber) / jnp.sum(n)

        optimiser = optax.lbfgs(linesearch=optax.scale_by_backtracking_linesearch(20, store_grad=True))

        def iterate(carry):
            p, state, count, _ = carry
            value, slope = optax.value_and_grad_from_state(loss)(p, state=state)
            step, state = optimiser.update(slope, state, p, value=value, grad=slope, value_fn=loss)
            return optax.apply_updates(p, step), state, count + 1, optax.tree.norm(slope)

        start = (p, optimiser.init(p), 0, jnp.inf)
        goal = 1e-10 * jnp.min(scale)
        end = jax.lax.while_loop(lambda c: (c[2] < ITERATIONS) & (c[3] > goal), iterate, start)
        return jnp.asarray(end[0])

    def next_round(count: Array, p: Array) -> Array:
        size = jnp.nanmedian(jnp.where(known, jnp.abs(residual(p)), jnp.nan), axis=0)
        return minimise(p, jnp.where(count == 0, 1e3, jnp.maximum(SIGMA_PER_MEDIAN * size, 1e-9)))

    start = jnp.concatenate([jnp.ones(k), jnp.zeros(k + fit_share)])
    p = jax.lax.fori_loop(0, ROUNDS, next_round, start)  # least squares first, then Huber's loss
    _, mean, spread = features(p)
    slope = p[:k] / spread
    return jnp.concatenate([slope, p[k : 2 * k] - slope * mean, p[2 * k :]])


def wire_length(x: Any, share: Any) -> Any:
    """Return the wire length, but for a factor, from x = w / w_max and share = I_comp w_max."""
    rest = 1.0 - share * x
    return x / (jnp if isinstance(rest, Array) else np).maximum(rest, 1e-3)
