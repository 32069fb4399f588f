"""Truncated quantile critics: an off-policy actor-critic with a learned temperature.

Kuznetsov et al. 2020, arXiv:2005.04269, on top of soft actor-critic, Haarnoja et al. 2018, arXiv:1812.05905.
`TQC` joins the losses to networks and optimisers; `HindsightTQC` updates them on relabelled batches of the
replay. Nothing here is jitted: wrap the outermost function, such as a scan of updates, and donate the state.

Shapes: B batch, O observation, A action, C critics, M quantiles per critic, K kept target quantiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from mjx_softarm._support import draws
from mjx_softarm.env import EnvConfig, ReachEnv
from train.agent import networks
from train.agent.hindsight import HindsightConfig, relabel
from train.agent.learner import (
    Experience,
    Learner,
    ReplayConfig,
    Sample,
    Transition,
    check_settings,
)
from train.agent.losses import actor_loss, alpha_loss, quantile_huber_loss, truncated_targets
from train.agent.prediction import PredictiveCritics, Predictor

Params = Any  # a flax parameter tree


@dataclass(frozen=True)
class TQCConfig(ReplayConfig):
    """Hyperparameters, by default stable-baselines3-contrib's. Raises ValueError naming a bad field."""

    VARIABLE = ("learning_rate", "learning_rate_alpha", "gamma", "tau", "initial_alpha", "target_entropy")
    VARIABLE += ("reward_scale", *(f"hindsight.{name}" for name in HindsightConfig.VARIABLE))

    hidden_critic: tuple[int, ...] = (256, 256)  # widths of each critic's hidden layers
    n_critics: int = 2  # number of critics
    n_quantiles: int = 25  # quantiles per critic
    n_drop_per_critic: int = 2  # largest pooled target quantiles dropped, per critic
    layer_norm: bool = False  # layer normalisation in the critics
    n_ahead: int = 0  # held actions whose predicted errors the critics observe, in motion; see `prediction`
    learning_rate: float = 3e-4  # learning rate of actor and critics (Adam)
    learning_rate_end: float = 1.0  # share of the learning rate left at the end of a half-cosine decay
    learning_rate_alpha: float = 3e-4  # learning rate of the temperature; 0 holds it at initial_alpha
    gamma: float = 0.99  # discount per step
    tau: float = 0.005  # Polyak rate of the target critics and of the mean actor, per update
    initial_alpha: float = 1.0  # initial temperature
    target_entropy: float | None = None  # target entropy [nat]; None is minus the number of actions
    reward_scale: float = 1.0  # factor on every reward in the critics' targets
    hindsight: HindsightConfig = field(default_factory=HindsightConfig)
    """relabelled goals, as shares of a batch; the rest keeps its own goals"""

    def __post_init__(self) -> None:
        super().__post_init__()
        required = {
            "hidden_critic": (len(self.hidden_critic) > 0, "at least one layer"),
            "n_critics": (self.n_critics > 0, "a positive number"),
            "n_ahead": (self.n_ahead >= 0, "at least 0"),
            "n_drop_per_critic": (0 <= self.n_drop_per_critic < self.n_quantiles, "0 to n_quantiles - 1"),
            "learning_rate": (self.learning_rate >= 0.0, "a number >= 0"),
            "learning_rate_end": (0.0 <= self.learning_rate_end <= 1.0, "a number in [0, 1]"),
            "gamma": (0.0 <= self.gamma <= 1.0, "a number in [0, 1]"),
            "tau": (0.0 < self.tau <= 1.0, "a number in (0, 1]"),
            "initial_alpha": (self.initial_alpha > 0.0, "a positive number"),
        }
        check_settings("learner", self, required)

    def check(self, env: EnvConfig) -> None:
        """Raise ValueError where the learner cannot learn in an environment."""
        super().check(env)
        seen = self.n_ahead == 0 or env.observation == "motion"
        check_settings("learner", self, {"n_ahead": (seen, "0 without env.observation 'motion'")})


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
_PARTS = {"actor": "actor_params", "critics": "critic_params", "targets": "target_params"}
_PARTS |= {"log_alpha": "log_alpha"}


class TQC:
    """Networks and optimisers of fixed structure, and pure functions of a `TQCState`."""

    def __init__(self, obs_size: int, action_size: int, config: TQCConfig = TQCConfig()) -> None:
        self.obs_size, self.action_size, self.config = obs_size, action_size, config
        self.actor: Any = networks.Actor(action_size, config.hidden, config.activation)
        self.critics: Any = networks.Critics(
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

        All three gradients are taken at the incoming state, so none waits for another's optimiser.

        Returns:
            The next state, and scalar metrics: the losses, alpha, entropy [nat], q_mean, target_mean.

        Raises:
            ValueError: a field of `batch` has the wrong shape.
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
        losses = {"actor_loss": loss_actor, "alpha_loss": loss_alpha, **critic_metrics}
        means = {"entropy": -jnp.mean(log_prob), "target_mean": jnp.mean(targets)}
        return next_state, {**losses, **means, "alpha": jnp.exp(state.log_alpha)}

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


class HindsightTQC(Learner):
    """`Learner` whose update has two parts, between which a wrapper can change the batch."""

    def __init__(self, config: TQCConfig, env: ReachEnv):
        self.config, self.env = config, env
        self.tqc = tqc = TQC(env.observation_size, env.action_size, config)
        self.init, self.act, self.policy, self.mode = tqc.init, tqc.act, tqc.policy, tqc.mode
        self.parts, self.adopt = tqc.parts, tqc.adopt

    def update(self, state: TQCState, sample: Sample, key: Array) -> tuple[TQCState, dict[str, Array]]:
        """Take one gradient step of all networks on one relabelled batch."""
        key_sample, key_relabel, key_update = jax.random.split(key, 3)
        batch, _ = self.transitions(sample(key_sample, self.config.hindsight.n_later), key_relabel)
        return self.learn(state, batch, key_update)

    def transitions(self, stored: Experience, key: Array) -> tuple[Transition, Array]:
        """Relabel a batch of B stored transitions; also return which of them (B,) have another goal."""
        return relabel(
            stored,
            key,
            self.config.hindsight,
            self.env.scale,
            self.env.config.reward,
            goal_ends=self.env.config.goal_ends,
            senses_action=self.env.config.observation == "motion",
        )

    def learn(self, state: TQCState, batch: Transition, key: Array) -> tuple[TQCState, dict[str, Array]]:
        """Take one gradient step on a batch; the metrics are those of `TQC.update`."""
        state, metrics = self.tqc.update(state, batch, key)
        return state, {f"tqc/{name}": x for name, x in metrics.items()}
