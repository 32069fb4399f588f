"""One epoch of training as one jitted, donated call: act, store, relabel, update."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh

from mjx_softarm._support import draws, xla
from mjx_softarm._support.mjx import State
from mjx_softarm.env import ReachEnv
from mjx_softarm.env.vector import VectorEnv
from train.agent.tqc import TQC, TQCState, Transition
from train.config import ConfigError, TrainConfig
from train.epoch import replay
from train.epoch.devices import everywhere, split, spread
from train.epoch.hindsight import Experience, relabel

T = TypeVar("T")


class TrainState(NamedTuple):
    """All that a run consists of; with it, a run continues bit for bit."""

    arms: State  # n_arms
    agent: TQCState
    memory: replay.Replay  # of Experience
    key: Array
    n_env_steps: Array  # () int32 actions taken, invalid ones included
    n_unsettled: Array  # () int32 arms that were masked and reset
    imitation: Any = None  # what learning from demonstrations has besides; see `train.epoch.imitation`


class Job:
    """A run's fixed parts, and the two functions that change its state.

    `n_traces` counts how often the epoch was traced: once in a run. With a mesh of devices, the state is
    spread over them; see `train.epoch.devices`. Raises ConfigError for what cannot be split evenly.
    """

    def __init__(self, config: TrainConfig, env: ReachEnv, mesh: Mesh | None = None):
        self.config = config
        self.env = env
        self.mesh = mesh
        self.arms = VectorEnv(env, config.n_arms, config.episode_length, mesh)
        self.agent = TQC(env.observation_size, env.action_size, config.tqc, config.n_updates)
        self.n_traces = 0
        self.sharding = None if mesh is None else _sharding(config, mesh)
        results = None if mesh is None else (self.sharding, everywhere(mesh))
        self.init = xla.jit(self._init, env.uses_mjx, out_shardings=self.sharding)
        self.epoch = xla.jit(self._epoch, env.uses_mjx, donate_argnums=0, out_shardings=results)

    def start(self, first: Callable[[], T]) -> T:
        """What `first` returns, such as a state, with the epoch compiled beside it: neither needs all cores.

        With a mesh of devices the epoch is compiled when it is called first.
        """
        if self.mesh is not None:
            return first()
        shapes = jax.eval_shape(self.init, jax.random.PRNGKey(0))
        with ThreadPoolExecutor(1) as beside:
            result = beside.submit(first)
            self.epoch = self.epoch.lower(shapes).compile()
            return result.result()

    def place(self, state: TrainState) -> TrainState:
        """The state where the epoch expects it, after something else has touched it."""
        return state if self.sharding is None else jax.device_put(state, self.sharding)

    def _init(self, key: Array) -> TrainState:
        key, key_arms, key_agent = jax.random.split(key, 3)
        arms = self.arms.reset(key_arms)
        experience = jax.eval_shape(
            lambda: self._experience(arms, jnp.zeros((self.arms.n, self.env.action_size)), arms)
        )
        one = jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), experience)
        return TrainState(
            arms=arms,
            agent=self.agent.init(key_agent),
            memory=replay.create(one, self.config.replay_capacity),
            key=key,
            n_env_steps=jnp.zeros((), jnp.int32),
            n_unsettled=jnp.zeros((), jnp.int32),
        )

    def _epoch(self, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
        """Advance every arm by `vector_steps_per_epoch` actions, with the updates that go with them.

        Returns:
            The next state; means over the epoch by name, and `unsettled`, the number of masked arms.
        """
        self.n_traces += 1
        with draws.on(self.mesh):
            state, metrics = jax.lax.scan(
                self._vector_step, state, None, length=self.config.vector_steps_per_epoch
            )
        unsettled = jnp.sum(metrics.pop("env/unsettled")) * self.config.n_arms
        return state, {**jax.tree.map(jnp.mean, metrics), "env/unsettled": unsettled}

    def _vector_step(self, state: TrainState, _) -> tuple[TrainState, dict[str, Array]]:
        key, key_act, key_random, key_reset, key_updates = jax.random.split(state.key, 5)
        warmed_up = state.n_env_steps >= self.config.warmup_env_steps
        explored = draws.uniform(key_random, (self.arms.n, self.env.action_size), minval=-1.0)
        action = self.agent.act(state.agent.actor_params, state.arms.obs, key_act)
        action = jnp.where(warmed_up, action, explored)
        arms, after, outcome = self.arms.step(state.arms, action, key_reset)
        experience = self._experience(state.arms, action, after)
        valid = outcome.valid & replay.finite_rows(experience)
        state = state._replace(
            arms=arms,
            memory=replay.add(state.memory, experience, valid),
            key=key,
            n_env_steps=state.n_env_steps + self.arms.n,
            n_unsettled=state.n_unsettled + jnp.sum(~valid, dtype=jnp.int32),
        )
        state, losses = self._updates(state, key_updates, warmed_up)
        env_metrics = {f"env/{name}": jnp.mean(value) for name, value in after.metrics.items()}
        return state, env_metrics | losses

    def _updates(
        self, state: TrainState, key: Array, warmed_up: Array
    ) -> tuple[TrainState, dict[str, Array]]:
        keys = jax.random.split(key, self.config.n_updates_per_vector_step)

        def update(learner: tuple[TQCState, Any], key: Array):
            return self._update(*learner, state.memory, key)

        def run(learner: tuple[TQCState, Any]):
            learner, metrics = jax.lax.scan(update, learner, keys)
            return learner, jax.tree.map(jnp.mean, metrics)

        learner = (state.agent, state.imitation)
        shapes = jax.eval_shape(run, learner)[1]
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        (agent, imitation), metrics = jax.lax.cond(
            warmed_up, run, lambda learner: (learner, nothing), learner
        )
        return state._replace(agent=agent, imitation=imitation), metrics

    def _update(
        self, agent: TQCState, imitation: Any, memory: replay.Replay, key: Array
    ) -> tuple[tuple[TQCState, Any], dict[str, Array]]:
        """One gradient step, and its metrics by name."""
        key_sample, key_relabel, key_update = jax.random.split(key, 3)
        stored = self._sample(memory, key_sample)
        agent, losses = self.agent.update(agent, self._relabel(stored, key_relabel), key_update)
        return (agent, imitation), {f"tqc/{name}": x for name, x in losses.items()}

    def _sample(self, memory: replay.Replay, key: Array) -> Experience:
        return spread(self.mesh, replay.sample(memory, key, self.config.batch_size))

    def _relabel(self, stored: Experience, key: Array) -> Transition:
        return relabel(
            stored,
            key,
            self.config.hindsight,
            self.env.scale,
            self.config.env.reward,
            exchange_actions=self.config.env.mode == "quasistatic",
        )

    def _experience(self, before: State, action: Array, after: State) -> Experience:
        start, end = before.pipeline_state, after.pipeline_state
        return Experience(
            pose=start.pose,
            goal=start.goal,
            action=action,
            next_pose=end.pose,
            sensed_action=self.env.action_of(end.spring_m + end.sensor_offset_m),
            saturated=after.info["saturated"],
            clearance_cost=self.env.clearance_cost(after.info["clearance_mm"]),
            n_steps=end.n_steps,
        )


def _sharding(config: TrainConfig, mesh: Mesh) -> TrainState:
    """Where the parts of a state are, as a prefix of its tree."""
    for name in ("n_arms", "replay_capacity", "batch_size"):
        if getattr(config, name) % mesh.size:
            raise ConfigError(
                f"{name}: got {getattr(config, name)}, expected a multiple of the {mesh.size} devices"
            )
    on_all, rows = cast(Any, everywhere(mesh)), split(mesh)  # in the places of arrays
    return TrainState(
        arms=rows,
        agent=on_all,
        memory=replay.Replay(data=rows, position=on_all, size=on_all),
        key=on_all,
        n_env_steps=on_all,
        n_unsettled=on_all,
        imitation=on_all,
    )
