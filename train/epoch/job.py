"""One epoch of training as one jitted, donated call: act, store, update.

An epoch is composed of arms, a distribution of their goals, a replay and a learner; see
`train.agent.learner`. It knows no learner by name. Where the learner has arms of its own, the epoch has none,
and no replay.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh

from mjx_softarm import control
from mjx_softarm._support import draws, xla
from mjx_softarm.env import ReachEnv
from mjx_softarm.env.state import State
from mjx_softarm.env.vector import VectorEnv
from mjx_softarm.mechanics.workspace import Pool
from train.agent.hindsight import later_pose
from train.agent.learner import Experience, Learner, LearnerConfig
from train.epoch import replay
from train.epoch.devices import everywhere, spread
from train.epoch.state import TrainState, sharding_of

T = TypeVar("T")
COUNTS = ("env/unsettled", "env/episodes", "env/successes")  # metrics summed over an epoch and its arms


class Goals(Protocol):
    """Distribution of the starts and goals of new episodes."""

    def init(self) -> Any:
        """Return the first state of the distribution, a pytree of arrays."""
        ...

    def begin(self, state: Any, arms: State, key: Array) -> State:
        """Return the states of n arms; those whose episode is new have the start and goal drawn here."""
        ...


class WorkspaceGoals:
    """`Goals` as the environment's reset draws them."""

    def init(self) -> Any:
        """Return an empty state."""
        return ()

    def begin(self, state: Any, arms: State, key: Array) -> State:
        """Return the arms as they are."""
        return arms


def kind_of(env: ReachEnv, learner: Learner) -> xla.Kind:
    """Return the kind of program that an epoch is: what most of its time goes to."""
    return "arm" if env.uses_mjx or learner.own_arms else "networks"


class Job:
    """Fixed parts of a run, and the two functions that change its state: `init` and `epoch`.

    `n_traces` counts how often the epoch was traced: once in a run. With a mesh of devices, the state is
    spread over them; see `train.epoch.devices`. Raises ConfigError for what cannot be split evenly. `pool_of`
    returns the poses of an epoch, by default always those of the environment.
    """

    def __init__(
        self,
        config: LearnerConfig,
        env: ReachEnv,
        learner: Learner,
        goals: Goals | None = None,
        mesh: Mesh | None = None,
        pool_of: Callable[[int], Pool] | None = None,
    ):
        self.config: Any = config  # a ReplayConfig where the learner has no arms of its own
        self.env, self.learner, self.mesh = env, learner, mesh
        self.goals, self._pool_of = goals or WorkspaceGoals(), pool_of or (lambda epoch: env.pool)
        if not learner.own_arms:
            self.arms = VectorEnv(env, config.n_arms, self.config.episode_length, mesh)
        self.n_traces = 0
        self.sharding = None if mesh is None else sharding_of(self.config, mesh, learner.own_arms)
        results = None if mesh is None else (self.sharding, everywhere(mesh))
        self._init = xla.jit(self._drawing(self.first), "once", out_shardings=self.sharding)
        self._epoch = xla.jit(
            self._drawing(self.advance), kind_of(env, learner), donate_argnums=0, out_shardings=results
        )
        self._thin = xla.jit(replay.thin, donate_argnums=0)

    def init(self, key: Array) -> TrainState:
        """Return the state that a run begins with."""
        return self._init(key, self._pool_of(0))

    def epoch(self, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
        """Return the state after an epoch, and its metrics; the state given is used up. See `advance`."""
        return self._epoch(state, self._pool_of(int(state.n_epochs)))

    def like(self) -> TrainState:
        """Return a state structured as the run's, or its shapes."""
        return self.init(jax.random.PRNGKey(0)) if self.mesh else self.shapes()

    def shapes(self) -> TrainState:
        """Return the shapes of a state."""
        return jax.eval_shape(self._init, jax.random.PRNGKey(0), self.env.poses.shapes)

    def compile_epoch(self) -> None:
        """Compile the epoch before it is called. This needs no pool of poses, whose settling may go on."""
        self._epoch = self._epoch.lower(self.shapes(), self.env.poses.shapes).compile()

    def start(self, first: Callable[[], T]) -> T:
        """Return the result of `first`, such as a state, with the epoch compiled meanwhile.

        Another thread calls `first`; the pool of poses, an argument of the epoch, settles there. With a mesh
        the epoch is compiled when it is called first; a second call compiles nothing.
        """
        if self.mesh is not None or self.n_traces:
            return first()
        with ThreadPoolExecutor(1) as beside:
            result = beside.submit(first)
            self.compile_epoch()
            return result.result()

    def place(self, state: TrainState) -> TrainState:
        """Return the state on the devices where the epoch expects it, after something else has touched it."""
        return state if self.sharding is None else jax.device_put(state, self.sharding)

    def member(self, state: TrainState, k: int) -> TrainState:
        """Return the state of the k-th run, of the only one; a sweep's job has several."""
        return state

    def policy(self, state: TrainState) -> Any:
        """Return the parameters of the policy that is evaluated and exported."""
        return self.learner.policy(state.learner)

    def parts(self, state: TrainState) -> dict[str, Any]:
        """Return what a checkpoint keeps for export and for other runs; see `Learner.parts`."""
        return self.learner.parts(state.learner)

    def thin(self, state: TrainState, share: float) -> TrainState:
        """Return the state with a random share of its replay; the state given is used up."""
        key, key_thin = jax.random.split(state.key)
        memory = self._thin(state.memory, key_thin, jnp.asarray(share, jnp.float32))
        return state._replace(memory=memory, key=key)

    def _drawing(self, function: Callable) -> Callable:
        """Return a function of an argument and of the pool of poses that its environment draws from."""

        def drawing(argument: Any, pool: Pool) -> Any:
            with self.env.poses.given(pool):
                return function(argument)

        return drawing

    def first(self, key: Array) -> TrainState:
        """Return the state that a run begins with; `init` is this, jitted."""
        key, key_arms, key_learner, key_goals = jax.random.split(key, 4)
        goals, arms, memory = self.goals.init(), None, None
        learner = self.learner.init(key_learner)
        if not self.learner.own_arms:
            # Arms at their first starts, and an empty replay of the transitions that they will make.
            arms = self.goals.begin(goals, self.arms.reset(key_arms), key_goals)
            action = jax.eval_shape(self.learner.act, learner, arms.obs, key)
            experience = jax.eval_shape(self._experience, arms, action, arms)
            one = jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), experience)
            memory = replay.create(one, self.config.replay_capacity)
        return TrainState(arms, learner, memory, goals, key, n_epochs=jnp.zeros((), jnp.int32))

    def advance(self, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
        """Move every arm by `vector_steps_per_epoch` actions, with their updates; `epoch` is this, jitted.

        Returns:
            The next state; means over the epoch by name. Counts are `env/unsettled`, the masked arms, and
            with a replay `env/episodes` that ended, `env/successes` that ended at their goals.
        """
        self.n_traces += 1
        with draws.on(self.mesh):
            step = self._own_step if self.learner.own_arms else self._vector_step
            n_steps = self.config.vector_steps_per_epoch
            state, metrics = jax.lax.scan(step, state, jnp.arange(n_steps), length=n_steps)
        counts = {name: jnp.sum(metrics.pop(name)) * self.config.n_arms for name in COUNTS if name in metrics}
        state = state._replace(n_epochs=state.n_epochs + 1)
        return state, jax.tree.map(jnp.mean, metrics) | counts

    def _own_step(self, state: TrainState, _) -> tuple[TrainState, dict[str, Array]]:
        """Take one update of a learner that steps arms of its own."""
        key, key_update = jax.random.split(state.key)
        learner, metrics = self.learner.update(state.learner, _no_replay, key_update)
        return state._replace(learner=learner, key=key), metrics

    def _vector_step(self, state: TrainState, step: Array) -> tuple[TrainState, dict[str, Array]]:
        """Take one action of every arm, and the updates that follow it; `step` () counts within the epoch."""
        key, key_act, key_random, key_reset, key_updates, key_goals = jax.random.split(state.key, 6)

        # Act: uniformly at random during warm-up, then as the learner explores.
        warmed_up = self._warmed_up(state.n_epochs, step)
        uniform = draws.uniform(key_random, (self.arms.n, self.env.action_size), minval=-1.0)
        explored = self.learner.act(state.learner, state.arms.obs, key_act)
        action = jnp.where(warmed_up, explored, uniform)  # (n_arms, n_springs)

        # Step the arms; where an episode ended, begin the next one.
        arms, after, outcome = self.arms.step(state.arms, action, key_reset)
        arms = self.goals.begin(state.goals, arms, key_goals)

        # Store what is valid and finite.
        experience = self._experience(state.arms, action, after)
        valid = outcome.valid & replay.finite_rows(experience)  # (n_arms,)
        memory = replay.add(state.memory, experience, valid)
        state = state._replace(arms=arms, memory=memory, key=key)

        # Learn.
        state, losses = self.learn(state, key_updates, warmed_up)
        ended = outcome.terminated | outcome.truncated
        of_arms = after.metrics | {"episodes": ended, "successes": ended & (after.metrics["reached"] > 0)}
        env_metrics = {f"env/{name}": jnp.mean(value) for name, value in of_arms.items()}
        return state, env_metrics | losses

    def _warmed_up(self, n_epochs: Array, step: Array) -> Array:
        """Return whether warm-up is over before an action of all arms: () bool."""
        epochs, steps = divmod(self.config.n_warmup_vector_steps, self.config.vector_steps_per_epoch)
        return (n_epochs > epochs) | ((n_epochs == epochs) & (step >= steps))

    def learn(self, state: TrainState, key: Array, warmed_up: Array) -> tuple[TrainState, dict[str, Array]]:
        """Take the updates of one vector step, none before the end of warm-up.

        Returns:
            The next state; means over the updates by name, zeros during warm-up.
        """
        keys = jax.random.split(key, self.config.n_updates_per_vector_step)

        def sample(key: Array, n_later: int = 0) -> Experience:
            size = self.config.batch_size
            if not n_later:
                return spread(self.mesh, replay.sample(state.memory, key, size))
            now, later, ahead = replay.sample_ahead(state.memory, key, size, self.arms.n, n_later)
            return spread(self.mesh, now._replace(later_pose=later_pose(now, later, ahead)))

        @jax.jit  # traced once for the branch and the shapes of its results
        def run(learner: Any) -> tuple[Any, dict[str, Array]]:
            learner, metrics = jax.lax.scan(
                lambda learner, key: self.learner.update(learner, sample, key), learner, keys
            )
            return learner, jax.tree.map(jnp.mean, metrics)

        # A branch has to return metrics of the same shapes, whether it learns or not.
        shapes = jax.eval_shape(run, state.learner)[1]
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        learner, metrics = jax.lax.cond(warmed_up, run, lambda learner: (learner, nothing), state.learner)
        return state._replace(learner=learner), metrics

    def _experience(self, before: State, action: Array, after: State) -> Experience:
        """Return the transitions of n arms as they are stored."""
        start, end = before.pipeline_state, after.pipeline_state
        sensed_action = self.env.action_of(end.spring_m + end.sensor_offset_m)
        if self.env.config.moves:  # the arm moves on: the other references still count
            blocked = control.blocked_springs(after.info["blocked"], self.env.gains)
            sensed_action = jnp.where(blocked, sensed_action, action)
        return Experience(
            pose=start.pose,
            goal=start.goal,
            action=action,
            next_pose=end.pose,
            sensed_action=sensed_action,
            saturated=after.info["saturated"],
            clearance_cost=self.env.clearance_cost(after.info["clearance_mm"]),
            n_steps=end.n_steps,
            sensed=start.sensed,
            next_sensed=end.sensed,
        )


def _no_replay(key: Array, n_later: int = 0) -> Experience:
    raise TypeError("sample: got a call, expected none by a learner that steps arms of its own")
