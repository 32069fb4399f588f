"""Learning through the simulation: its own gradient teaches the policy.

The pose at rest is a differentiable function of the spring references (`mjx_softarm.mechanics.settle`), and
so is the pose in motion, through all time steps. So the policy a = pi(s) descends the pose's own error:

    loss = E[ ||e(a)|| / theta + c sum_t d_t(a) ]

with the scaled pose error e(a) after the action a, the goal's tolerance theta, and the distance d_t(a) of
spring t from its reference [mm]. There is no critic, no replay and no exploration. A chamber at a pressure
limit does not follow its reference, so the first term has no gradient there; the second pulls the reference
back to a length that the chamber can reach.

The learner has arms of its own that go on from where its actions led them. So it sees the states that the
policy leads to. Some of the arms begin anew at each step.

Source of the average policy: Shamir, Zhang, "Stochastic Gradient Descent for Non-smooth Optimization", ICML
2013.

Shapes: B arms, O observation, A action.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from mjx_softarm import control
from mjx_softarm._support import draws, xla
from mjx_softarm._support.errors import check_settings
from mjx_softarm._support.fields import Amount, Count, Positive, Share
from mjx_softarm._support.mlp import Activation
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.state import State
from mjx_softarm.env.vector import VectorEnv, choose_arms
from mjx_softarm.mdp import rewards
from train.agent.learner import LearnerConfig
from train.agent.networks import Actor, check_same_shapes, descend, mode, own_buffers, widened
from train.demos.demonstrations import Demonstrations

Params = Any  # a flax parameter tree
MAX_GRADIENT_NORM = 1.0  # a longer gradient is shortened to this
NEW_SHARE = 0.33  # share of the arms that get a new start and goal after each step
EARLY = 0.2  # weight of the mean cost of all actions beside that of the last: the tip shall arrive soon


@dataclass(frozen=True)
class AnalyticConfig(LearnerConfig):
    """Hyperparameters of learning through the simulation."""

    VARIABLE = ("learning_rate", "learning_rate_half", "mean_share", "saturation_cost_per_mm")

    hidden: tuple[int, ...] = (256, 256, 256, 256)  # widths of the policy's hidden layers
    activation: Activation = "swish"  # function after each of them
    n_arms: Count = 64  # arms of a gradient step
    total_env_steps: Count = 64 * 49_152  # actions of all arms together; each arm takes one per gradient step
    vector_steps_per_epoch: Count = 256  # gradient steps between two reports
    learning_rate: Amount = 2e-3  # learning rate at first (Adam)
    learning_rate_half: Positive = 3_000.0  # gradient steps t_half of the rate's decay, 1 / (1 + t / t_half)
    mean_share: Share = 0.1  # share of the gradient steps so far over which the mean policy averages
    saturation_cost_per_mm: Amount = 0.1  # c of the loss
    horizon: Count = 1  # actions that a gradient step looks ahead; more than one for arms in motion

    def check(self, env: EnvConfig) -> None:
        """Raise InputError for an engine whose gradient this learner does not take."""
        engine = "mjx" if env.in_motion else "chain"
        usable = env.engine == engine
        check_settings("env", env, {"engine": (usable, f"{engine!r}, whose gradient this learner takes")})

    def make_epoch(self, env: ReachEnv, shown: Demonstrations | None = None) -> GradientEpoch:
        """Return the epoch of gradient steps."""
        return GradientEpoch(self, env)


class AnalyticState(NamedTuple):
    """Policy and optimiser: all that a gradient step changes."""

    actor_params: Params
    mean_actor_params: Params  # average of the newest actor_params: the policy that is evaluated
    opt_state: optax.OptState
    n_steps: Array  # () int32 gradient steps taken


class Analytic:
    """Policy and optimiser of fixed structure, and pure functions of an `AnalyticState`.

    Neither learning rate nor average depends on the length of the run, so every policy on the way is as
    good as that of a shorter run.
    """

    def __init__(self, obs_size: int, action_size: int, config: AnalyticConfig):
        self.obs_size, self.config = obs_size, config
        self.actor: Any = Actor(action_size, config.hidden, config.activation)
        self.optimizer = optax.chain(
            optax.clip_by_global_norm(MAX_GRADIENT_NORM),
            optax.adam(lambda n_steps: config.learning_rate / (1.0 + n_steps / config.learning_rate_half)),
        )

    def init(self, key: Array) -> AnalyticState:
        """Return a fresh policy."""
        params = self.actor.init(key, jnp.zeros((1, self.obs_size)))
        n_steps = jnp.zeros((), jnp.int32)
        return AnalyticState(params, own_buffers(params), self.optimizer.init(params), n_steps)

    def policy(self, state: AnalyticState) -> Params:
        """Return the parameters of the mean policy."""
        return state.mean_actor_params

    def mode(self, policy: Params, obs: Array) -> Array:
        """Return the deterministic actions (..., A) in [-1, 1] at obs (..., O)."""
        return mode(self.actor.apply(policy, obs)[0])

    def parts(self, state: AnalyticState) -> dict[str, Params]:
        """Return the policy, which checkpoints keep for export and for other runs."""
        return {"policy": state.mean_actor_params}

    def adopt(self, state: AnalyticState, parts: Mapping[str, Params]) -> AnalyticState:
        """Return the state with another run's policy, of any learner; it may observe less."""
        params = widened(parts["policy"], self.obs_size)
        check_same_shapes("actor", params, state.actor_params)
        return state._replace(actor_params=params, mean_actor_params=own_buffers(params))

    def update(self, state: AnalyticState, obs: Array, d_action: Array) -> tuple[AnalyticState, Array]:
        """Take one gradient step; return the next state and the norm () of the gradient.

        `d_action` (..., A) are the derivatives of the loss by the policy's actions at `obs` (..., O).
        """
        _, pull_back = jax.vjp(lambda params: self.mode(params, obs), state.actor_params)
        (gradient,) = pull_back(d_action)
        actor_params, opt_state = descend(self.optimizer, gradient, state.opt_state, state.actor_params)
        newest = 1.0 / (1.0 + self.config.mean_share * state.n_steps)
        mean_params = optax.incremental_update(actor_params, state.mean_actor_params, newest)
        next_state = AnalyticState(actor_params, mean_params, opt_state, state.n_steps + 1)
        return next_state, optax.tree.norm(gradient)


class GradientState(NamedTuple):
    """All that a run consists of; with it, a run continues bit for bit."""

    arms: State  # B
    learner: AnalyticState
    key: Array
    n_epochs: Array  # () int32 epochs done


class _Ahead(NamedTuple):
    """One arm that looks ahead for H actions."""

    after: State  # state after the first action
    obs: Array  # (H, O) observation before each action
    valid: Array  # () bool: the arm settled after each action


class GradientEpoch:
    """Epoch of gradient steps, each with one action of all arms."""

    kind: xla.Kind = "arm"

    def __init__(self, config: AnalyticConfig, env: ReachEnv):
        self.config, self.env = config, env
        self.learner = Analytic(env.observation_size, env.action_size, config)
        self.arms = VectorEnv(env, config.n_arms, episode_length=1)

    def first(self, key: Array) -> GradientState:
        """Return the state that a run begins with: a fresh policy, and arms at random poses."""
        key, _, key_learner, _ = jax.random.split(key, 4)
        key_actor, key_arms = jax.random.split(key_learner)
        n_epochs = jnp.zeros((), jnp.int32)
        return GradientState(self.arms.reset(key_arms), self.learner.init(key_actor), key, n_epochs)

    def advance(self, state: GradientState) -> tuple[GradientState, dict[str, Array]]:
        """Take `vector_steps_per_epoch` gradient steps; return the state, and means over the epoch by name.

        `env/unsettled` is the number of arms that did not settle.
        """
        state, metrics = jax.lax.scan(self._step, state, None, length=self.config.vector_steps_per_epoch)
        unsettled = jnp.sum(metrics.pop("env/unsettled")) * self.config.n_arms
        state = state._replace(n_epochs=state.n_epochs + 1)
        return state, jax.tree.map(jnp.mean, metrics) | {"env/unsettled": unsettled}

    def _step(self, state: GradientState, _) -> tuple[GradientState, dict[str, Array]]:
        """Take one gradient step, and one action of all arms."""
        key, key_arms = jax.random.split(state.key)
        # Act H times, and differentiate each arm's loss by each of its actions.
        look_ahead = jax.vmap(jax.value_and_grad(self._loss, has_aux=True), in_axes=(0, 0, None))
        changes = jnp.zeros((self.arms.n, self.config.horizon, self.env.action_size))
        (loss, ahead), d_action = look_ahead(changes, state.arms, state.learner.actor_params)  # _, (B, H, A)

        # Leave out arms that did not settle, and gradients that are not finite, as at a pitch of 90 degrees.
        valid = ahead.valid & jnp.all(jnp.isfinite(d_action), axis=(1, 2))  # (B,)
        d_action = jnp.where(valid[:, None, None], d_action, jnp.zeros_like(d_action)) / self.arms.n

        # Descend, and let the arms go on; some of them begin anew.
        learner, gradient_norm = self.learner.update(state.learner, ahead.obs, d_action)
        key_new, key_reset = jax.random.split(key_arms)
        new = draws.uniform(key_new, (self.arms.n,)) < NEW_SHARE
        new |= ~ahead.after.info["valid"]
        arms = choose_arms(new, self.arms.reset(key_reset), ahead.after)
        metrics = {
            "loss": jnp.sum(loss, where=valid) / jnp.maximum(jnp.sum(valid), 1),
            "gradient_norm": gradient_norm,
            "left_out": jnp.mean(~valid),
        }
        env_metrics = {f"env/{name}": jnp.mean(x) for name, x in ahead.after.metrics.items()}
        state = state._replace(arms=arms, learner=learner, key=key)
        return state, env_metrics | {f"analytic/{name}": x for name, x in metrics.items()}

    def _loss(self, changes: Array, arm: State, params: Params) -> tuple[Array, _Ahead]:
        """Return the loss of one arm over H actions of the policy plus small changes (H, A)."""

        def act(arm: State, change: Array) -> tuple[State, tuple[Array, State, Array]]:
            action = self.learner.mode(params, arm.obs) + change
            after = self.env.step(arm, action)
            return after, (self._cost(action, after), after, arm.obs)

        horizon = self.config.horizon
        _, (cost, after, obs) = jax.lax.scan(act, arm, changes, length=horizon, unroll=horizon == 1)
        first = jax.tree.map(lambda x: x[0], after)
        loss = cost[0] if horizon == 1 else cost[-1] + EARLY * jnp.mean(cost)
        return loss, _Ahead(first, obs, jnp.all(after.info["valid"]))

    def _cost(self, action: Array, after: State) -> Array:
        """Return the cost of an action (A,) of one arm, and of the state that it leads to."""
        end, config = after.pipeline_state, self.env.config
        error = rewards.scaled_error(end.pose, end.goal, config.reward)  # (6,)
        off = jnp.sqrt(jnp.sum(error**2) + 1e-12) / config.reward.threshold
        off_m = self.env.reference_m(action) - end.spring_m  # (A,)
        if config.in_motion:  # springs on their way are off their references, too: only blocked ones count
            off_m = control.blocked_springs(after.info["blocked"], self.env.gains) * off_m
        cost = self.config.saturation_cost_per_mm * 1e3 * jnp.sum(jnp.abs(off_m))
        return off + cost + self.env.clearance_cost(after.info["clearance_mm"])
