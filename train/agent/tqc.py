"""Truncated quantile critics: an off-policy actor-critic with a learned temperature.

Kuznetsov et al. 2020, arXiv:2005.04269, on top of soft actor-critic, Haarnoja et al. 2018, arXiv:1812.05905.
From top to bottom: settings, losses, critics, a prediction of arms in motion that critics may observe, and
`TQC`, which joins them.

`TQC` is usable alone, on transitions of any environment with actions in [-1, 1], see docs/extend.md. Nothing
here is jitted: wrap the outermost function, such as a scan of updates, and donate the state.

Shapes: B batch, O observation, A action, C critics, M quantiles per critic, K kept target quantiles.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax import Array

from mjx_softarm._support import draws
from mjx_softarm._support.errors import check_settings
from mjx_softarm._support.fields import Amount, Count, Number, Positive, PositiveShare, Rule, Share
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.mdp.observation import ERROR, GOAL, OBS_SIZE, POSE
from train.agent import networks
from train.agent.hindsight import HindsightConfig
from train.agent.learner import Transition
from train.epoch.replay_epoch import ReplayConfig

Params = Any  # a flax parameter tree
Finite = Annotated[float, Rule()]
ERROR_UNIT = 0.2  # error of 1 in the predictor's units: some 36 mm, what an arm moves in half a second
PREDICTION_WEIGHT = 10.0  # weight of the prediction's loss beside that of the critics
COST_AHEAD = 40.0  # initial weight of a predicted error of 1, summed over the predictions


@dataclass(frozen=True)
class TQCConfig(ReplayConfig):
    """Hyperparameters, by default stable-baselines3-contrib's. Raises InputError naming a bad field."""

    VARIABLE = ("learning_rate", "learning_rate_alpha", "gamma", "tau", "initial_alpha", "target_entropy")
    VARIABLE += ("reward_scale", *(f"hindsight.{name}" for name in HindsightConfig.VARIABLE))

    hidden_critic: tuple[int, ...] = (256, 256)  # widths of each critic's hidden layers
    n_critics: Count = 2  # number of critics
    n_quantiles: Count = 25  # quantiles per critic
    n_drop_per_critic: Number = 2  # largest pooled target quantiles dropped, per critic
    layer_norm: bool = False  # layer normalisation in the critics
    n_ahead: Number = 0  # held actions whose predicted errors the critics observe, in motion; see `Predictor`
    learning_rate: Amount = 3e-4  # learning rate of actor and critics (Adam)
    learning_rate_end: Share = 1.0  # share of the learning rate left at the end of a half-cosine decay
    learning_rate_alpha: Amount = 3e-4  # learning rate of the temperature; 0 holds it at initial_alpha
    gamma: Share = 0.99  # discount per step
    tau: PositiveShare = 0.005  # Polyak rate of the target critics and of the mean actor, per update
    initial_alpha: Positive = 1.0  # initial temperature
    target_entropy: Finite | None = None  # target entropy [nat]; None is minus the number of actions
    reward_scale: Positive = 1.0  # factor on every reward in the critics' targets

    def __post_init__(self) -> None:
        super().__post_init__()
        required = {
            "hidden_critic": (len(self.hidden_critic) > 0, "at least one layer"),
            "n_drop_per_critic": (self.n_drop_per_critic < self.n_quantiles, "less than n_quantiles"),
        }
        check_settings("learner", self, required)

    def check(self, env: EnvConfig) -> None:
        """Raise InputError where the learner cannot learn in an environment."""
        super().check(env)
        seen = self.n_ahead == 0 or env.observation == "motion"
        check_settings("learner", self, {"n_ahead": (seen, "0 without env.observation 'motion'")})

    def make_learner(self, env: ReachEnv) -> TQC:
        """Return TQC for the observations and actions of an environment."""
        return TQC(env.observation_size, env.action_size, self)


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
        reward, terminated (B,): scaled reward; 1 where no value follows, else 0.
        alpha (): temperature.

    Source: Kuznetsov et al. 2020, section 3 (target distribution).
    """
    pooled = jnp.reshape(next_quantiles, (next_quantiles.shape[0], -1))  # (B, C * M)
    kept = drop_largest(pooled, next_quantiles.shape[1] * n_drop_per_critic)  # (B, K)
    soft = kept - alpha * next_log_prob[:, None]  # (B, K)
    return reward[:, None] + gamma * (1.0 - terminated)[:, None] * soft


def actor_loss(log_prob: Array, quantiles: Array, alpha: Array) -> Array:
    """Return the mean () of alpha * log_prob - Q over the actor's actions; Q is the mean of all quantiles.

    `log_prob` (B,) is the log-density of the actions, `quantiles` (B, C, M) are the critics there.

    Source: Kuznetsov et al. 2020, section 3 (policy loss).
    """
    return jnp.mean(alpha * log_prob - jnp.mean(quantiles, axis=(1, 2)))


def alpha_loss(log_alpha: Array, log_prob: Array, target_entropy: float) -> Array:
    """Return the mean () of -log_alpha * (log_prob + target_entropy); alpha rises while entropy is too low.

    Source: Haarnoja et al. 2018, arXiv:1812.05905, section 6; log_alpha in place of alpha, as in its code.
    """
    return -log_alpha * jnp.mean(jax.lax.stop_gradient(log_prob) + target_entropy)


class Critics(nn.Module):
    """An ensemble of independent quantile networks of (observation, action).

    All critics read the same input, so their first layers are one matrix whose columns are split among them.
    Deeper layers are a matrix per critic. No parameter is shared. On a CPU this is faster than a vmapped
    ensemble, which transposes at every layer.
    """

    n_critics: int = 2
    n_quantiles: int = 25  # per critic
    hidden: tuple[int, ...] = (256, 256)  # widths of one critic's hidden layers, at least one
    layer_norm: bool = False  # normalise each hidden layer before its ReLU

    @nn.compact
    def __call__(self, obs: Array, action: Array, ahead: Array | None = None) -> Array:
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

    def _activate(self, x: Array, norm_name: str) -> Array:
        return nn.relu(nn.LayerNorm(name=norm_name)(x) if self.layer_norm else x)


class Predictor(nn.Module):
    """ReLU network that predicts the change of a moving arm's observation by an action.

    The goal does not enter, so transitions of all goals teach it.

    Source: critics that observe a learned prediction, Fujimoto et al., "For SALE: State-Action Representation
    Learning for Deep Reinforcement Learning", NeurIPS 2023.
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
    """Quantile critics that observe the errors predicted for `n_ahead` actions, while an action is held.

    It takes the place of `Critics`. The critics' loss does not teach the predictor; `loss` does. The
    quantiles fall in proportion to the norms of the predicted errors.

    Source: critics that fall with a distance to the goal, Liu et al., "Metric Residual Networks for Sample
    Efficient Goal-Conditioned Reinforcement Learning", AAAI 2023.
    """

    def __init__(self, critics: Critics, predictor: Predictor, n_ahead: int):
        self.critics: Any = critics  # flax does not type what a module returns
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
        next_pose = obs[..., POSE] + pose
        next_error = obs[..., ERROR] + ERROR_UNIT * error
        next_sensed = obs[..., OBS_SIZE : -action.shape[-1]] + sensed
        return jnp.concatenate([next_pose, obs[..., GOAL], next_error, next_sensed, action], axis=-1)

    def loss(self, params: dict[str, Params], obs: Array, action: Array, next_obs: Array) -> Array:
        """Return the prediction's loss (): a square up to one unit, then linear, for angles that wrap."""
        off = self.after(params["predictor"], obs, action) - next_obs
        off = off.at[..., ERROR].divide(ERROR_UNIT)
        return PREDICTION_WEIGHT * 2.0 * jnp.mean(optax.huber_loss(off))


class TQCState(NamedTuple):
    """Networks, temperature and optimiser states: all that an update changes."""

    actor_params: Params
    mean_actor_params: Params  # Polyak average of actor_params: the policy that is evaluated
    critic_params: Params
    target_params: Params  # shaped as critic_params
    log_alpha: Array  # () log temperature
    actor_opt_state: optax.OptState
    critic_opt_state: optax.OptState
    alpha_opt_state: optax.OptState


# Fields of the state by the names of the parts that another run may begin with, beside the policy.
_PARTS = {
    "actor": "actor_params",
    "critics": "critic_params",
    "targets": "target_params",
    "log_alpha": "log_alpha",
}


class TQC:
    """Networks and optimisers of fixed structure, and pure functions of a `TQCState`."""

    def __init__(self, obs_size: int, action_size: int, config: TQCConfig = TQCConfig()) -> None:
        self.obs_size, self.action_size, self.config = obs_size, action_size, config
        self.actor: Any = networks.Actor(action_size, config.hidden, config.activation)
        self.critics: Any = Critics(
            config.n_critics, config.n_quantiles, config.hidden_critic, config.layer_norm
        )
        if config.n_ahead:
            self.critics = PredictiveCritics(self.critics, Predictor(config.hidden_critic), config.n_ahead)
        rate, end = config.learning_rate, config.learning_rate_end
        if end != 1.0:  # a half cosine over the run
            rate = optax.cosine_decay_schedule(rate, config.n_decay_updates, end)
        self.optimizer = optax.adam(rate)
        self.alpha_optimizer = optax.adam(config.learning_rate_alpha)
        self.target_entropy = -float(action_size) if config.target_entropy is None else config.target_entropy

    def init(self, key: Array) -> TQCState:
        """Return fresh parameters; target critics and mean actor start as copies."""
        key_actor, key_critic = jax.random.split(key)
        obs = jnp.zeros((1, self.obs_size))
        actor_params = self.actor.init(key_actor, obs)
        critic_params = self.critics.init(key_critic, obs, jnp.zeros((1, self.action_size)))
        log_alpha = jnp.log(jnp.asarray(self.config.initial_alpha, obs.dtype))
        return TQCState(
            actor_params=actor_params,
            mean_actor_params=networks.own_buffers(actor_params),
            critic_params=critic_params,
            target_params=networks.own_buffers(critic_params),
            log_alpha=log_alpha,
            actor_opt_state=self.optimizer.init(actor_params),
            critic_opt_state=self.optimizer.init(critic_params),
            alpha_opt_state=self.alpha_optimizer.init(log_alpha),
        )

    def parts(self, state: TQCState) -> dict[str, Params]:
        """Return the networks and the temperature."""
        return {"policy": state.mean_actor_params} | {name: getattr(state, f) for name, f in _PARTS.items()}

    def adopt(self, state: TQCState, parts: Mapping[str, Params]) -> TQCState:
        """Return the state with another run's networks and temperature; the optimisers begin anew."""
        if "critics" not in parts:
            raise ValueError("got a policy without critics, expected a run of TQC")
        given = {"mean_actor_params": parts["policy"], **{f: parts[n] for n, f in _PARTS.items()}}
        networks.check_same_shapes("networks", given, {name: getattr(state, name) for name in given})
        return state._replace(**given)

    def act(self, state: TQCState, obs: Array, key: Array) -> Array:
        """Sample an action (..., A) in (-1, 1) at obs (..., O)."""
        mean, log_std = self.actor.apply(state.actor_params, obs)
        return networks.squash(mean, log_std, draws.normal(key, mean.shape))[0]

    def policy(self, state: TQCState) -> Params:
        """Return the parameters of the mean actor."""
        return state.mean_actor_params

    def mode(self, policy: Params, obs: Array) -> Array:
        """Return the deterministic action (..., A) in (-1, 1) at obs (..., O)."""
        return networks.mode(self.actor.apply(policy, obs)[0])

    def update(self, state: TQCState, batch: Transition, key: Array) -> tuple[TQCState, dict[str, Array]]:
        """Take one gradient step of critics, actor and temperature, then average critics and actor.

        All three gradients are taken at the incoming state, so none waits for another's optimiser. Metrics
        are named `tqc/...`; the entropy is in nat. Raises ValueError for a field of the wrong shape.
        """
        batch.check(self.obs_size, self.action_size)
        # Targets of the critics, constants of the step.
        noise, next_noise = draws.normal(key, (2, *batch.action.shape))  # (B, A) each
        targets = self._targets(state, batch, next_noise)  # (B, K)

        # Losses and gradients.
        critic_grad = jax.value_and_grad(self._critic_loss, has_aux=True)
        actor_grad = jax.value_and_grad(self._actor_loss, has_aux=True)
        (_, critic_metrics), d_critic = critic_grad(state.critic_params, batch, targets)
        (loss_actor, log_prob), d_actor = actor_grad(state.actor_params, state, batch.obs, noise)
        loss_alpha, d_alpha = jax.value_and_grad(alpha_loss)(state.log_alpha, log_prob, self.target_entropy)

        # Optimiser steps, and Polyak averages of their results.
        critic = networks.descend(self.optimizer, d_critic, state.critic_opt_state, state.critic_params)
        actor = networks.descend(self.optimizer, d_actor, state.actor_opt_state, state.actor_params)
        temperature = networks.descend(self.alpha_optimizer, d_alpha, state.alpha_opt_state, state.log_alpha)
        next_state = state._replace(
            actor_params=actor[0],
            mean_actor_params=optax.incremental_update(actor[0], state.mean_actor_params, self.config.tau),
            critic_params=critic[0],
            target_params=optax.incremental_update(critic[0], state.target_params, self.config.tau),
            log_alpha=temperature[0],
            actor_opt_state=actor[1],
            critic_opt_state=critic[1],
            alpha_opt_state=temperature[1],
        )
        metrics = {"actor_loss": loss_actor, "alpha_loss": loss_alpha, **critic_metrics}
        metrics |= {"entropy": -jnp.mean(log_prob), "target_mean": jnp.mean(targets)}
        metrics["alpha"] = jnp.exp(state.log_alpha)
        return next_state, {f"tqc/{name}": x for name, x in metrics.items()}

    def _targets(self, state: TQCState, batch: Transition, noise: Array) -> Array:
        next_actor = self.actor.apply(state.actor_params, batch.next_obs)
        next_action, next_log_prob = networks.squash(*next_actor, noise=noise)  # (B, A), (B,)
        return truncated_targets(
            self.critics.apply(state.target_params, batch.next_obs, next_action),  # (B, C, M)
            next_log_prob,
            self.config.reward_scale * batch.reward,
            batch.terminated,
            jnp.exp(state.log_alpha),
            gamma=self.config.gamma,
            n_drop_per_critic=self.config.n_drop_per_critic,
        )

    def _critic_loss(self, params: Params, batch: Transition, targets: Array) -> tuple[Array, Any]:
        quantiles = self.critics.apply(params, batch.obs, batch.action)  # (B, C, M)
        loss = quantile_huber_loss(quantiles, targets)
        metrics = {"critic_loss": loss, "q_mean": jnp.mean(quantiles)}
        if self.config.n_ahead:
            metrics["prediction_loss"] = self.critics.loss(params, batch.obs, batch.action, batch.next_obs)
            loss += metrics["prediction_loss"]
        return loss, metrics

    def _actor_loss(self, params: Params, state: TQCState, obs: Array, noise: Array) -> tuple[Array, Array]:
        action, log_prob = networks.squash(*self.actor.apply(params, obs), noise=noise)  # (B, A), (B,)
        quantiles = self.critics.apply(state.critic_params, obs, action)  # (B, C, M)
        return actor_loss(log_prob, quantiles, jnp.exp(state.log_alpha)), log_prob
