"""Losses of truncated quantile critics, as pure functions of network outputs.

Shapes: B batch, C critics, M quantiles per critic, K kept target quantiles.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def quantile_huber_loss(quantiles: Array, targets: Array) -> Array:
    """Return the critics' loss: regression of every predicted quantile m on every target k.

    With delta = target_k - quantile_m, clip = delta limited to [-1, 1], tau_m = (m + 1/2) / M, a pair costs
    |tau_m - 1[delta < 0]| * Huber(delta), where Huber(delta) = clip * (delta - clip / 2) has the slope clip.
    The loss () is the mean over B, K, C and M, as in stable-baselines3-contrib; the paper sums over M. First
    derivatives are exact, second derivatives are zero.

    Args:
        quantiles (B, C, M): predictions.
        targets (B, K): samples of the target distribution, constants here.

    Source: Dabney et al. 2017, arXiv:1710.10044, eq. 10; Kuznetsov et al. 2020, section 3.
    """
    n_quantiles = quantiles.shape[-1]
    tau = (jnp.arange(n_quantiles, dtype=quantiles.dtype)[None, None, None, :] + 0.5) / n_quantiles
    fixed = jax.lax.stop_gradient(quantiles)  # (B, C, M)
    delta = jax.lax.stop_gradient(targets)[:, :, None, None] - fixed[:, None, :, :]  # (B, K, C, M)
    clip = jnp.clip(delta, -1.0, 1.0)  # (B, K, C, M)
    slope = jnp.where(clip < 0.0, 1.0 - tau, tau) * clip  # (B, K, C, M)
    loss = jnp.mean(slope * (delta - 0.5 * clip), axis=1)  # (B, C, M)
    # One pass over the pairs gives loss and slope: a term of value zero has the slope as its derivative.
    return jnp.mean(loss - jnp.mean(slope, axis=1) * (quantiles - fixed))


def drop_largest(samples: Array, n_drop: int) -> Array:
    """Return rows (B, N) without their `n_drop` largest entries, in their order: (B, N - n_drop)."""
    # To find a few maxima and to close the gaps costs a fraction of sorting the row.
    dropped = jnp.sort(jax.lax.top_k(samples, n_drop)[1], axis=-1)  # (B, n_drop) columns, ascending
    n_kept_before = dropped - jnp.arange(n_drop)[None, :]  # (B, n_drop) kept columns left of each dropped one
    kept = jnp.arange(samples.shape[-1] - n_drop)[None, :]  # (1, N - n_drop) index among the kept
    n_skipped = jnp.sum(n_kept_before[:, None, :] <= kept[:, :, None], axis=-1)  # (B, N - n_drop)
    return jnp.take_along_axis(samples, kept + n_skipped, axis=-1)


def truncated_targets(
    next_quantiles: Array,
    next_log_prob: Array,
    reward: Array,
    terminated: Array,
    alpha: Array,
    *,
    gamma: float,
    n_drop_per_critic: int,
) -> Array:
    """Return samples (B, K) of the soft target distribution, without its largest against overestimation.

    The C * M quantiles z of the target critics are pooled, and the C * n_drop_per_critic largest are dropped.
    The K others become y = reward + gamma * (1 - terminated) * (z - alpha * next_log_prob), in no order.

    Args:
        next_quantiles (B, C, M): target critics at the next observation and the actor's action there.
        next_log_prob (B,): log-density of that action.
        reward (B,): scaled reward.
        terminated (B,): 1 where no value follows, else 0.
        alpha (): temperature.
        gamma: discount factor.
        n_drop_per_critic: quantiles dropped per critic.

    Source: Kuznetsov et al. 2020, section 3 (target distribution).
    """
    pooled = jnp.reshape(next_quantiles, (next_quantiles.shape[0], -1))  # (B, C * M)
    kept = drop_largest(pooled, next_quantiles.shape[1] * n_drop_per_critic)  # (B, K)
    soft = kept - alpha * next_log_prob[:, None]  # (B, K)
    return reward[:, None] + gamma * (1.0 - terminated)[:, None] * soft


def actor_loss(log_prob: Array, quantiles: Array, alpha: Array) -> Array:
    """Return the mean () of alpha * log_prob - Q over the actor's actions; Q is the mean of all quantiles.

    Args:
        log_prob (B,): log-density of the actions.
        quantiles (B, C, M): critics at those actions.
        alpha (): temperature.

    Source: Kuznetsov et al. 2020, section 3 (policy loss).
    """
    return jnp.mean(alpha * log_prob - jnp.mean(quantiles, axis=(1, 2)))


def alpha_loss(log_alpha: Array, log_prob: Array, target_entropy: float) -> Array:
    """Return the mean () of -log_alpha * (log_prob + target_entropy); alpha rises while entropy is too low.

    Args:
        log_alpha (): log temperature.
        log_prob (B,): log-density of the actor's actions, a constant here.
        target_entropy: target entropy [nat].

    Source: Haarnoja et al. 2018, arXiv:1812.05905, section 6; log_alpha in place of alpha, as in its code.
    """
    return -log_alpha * jnp.mean(jax.lax.stop_gradient(log_prob) + target_entropy)
