"""The epoch of a learner from the replay: act, step the arms, store, relabel, update.

After each action of all arms, their transitions enter the replay. Then the learner takes some gradient steps
on batches that are drawn uniformly from it, with goals exchanged in hindsight.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm import control
from mjx_softarm._support import draws, xla
from mjx_softarm._support.errors import check_settings
from mjx_softarm._support.fields import Count, Number, Positive
from mjx_softarm.env import ReachEnv
from mjx_softarm.env.state import State
from mjx_softarm.env.vector import VectorEnv
from mjx_softarm.mdp.actions import N_ACTIONS
from train.agent.hindsight import HindsightConfig, later_pose, relabel
from train.agent.learner import Experience, LearnerConfig, Transition
from train.demos.demonstrations import Demonstrations
from train.epoch import replay

COUNTS = ("env/unsettled", "env/episodes", "env/successes")  # metrics summed over an epoch and its arms


@dataclass(frozen=True)
class ReplayConfig(LearnerConfig):
    """Settings of a learner from the replay. Raises InputError."""

    episode_length: Count = N_ACTIONS  # actions per episode at most
    updates_per_env_step: Positive = 1.0  # gradient steps per action of one arm
    warmup_env_steps: Number = 2_048  # actions drawn uniformly before the first gradient step
    batch_size: Count = 256  # transitions per gradient step
    replay_capacity: int = 400_000  # transitions kept
    hindsight: HindsightConfig = field(default_factory=HindsightConfig)
    """relabelled goals, as shares of a batch; the rest keeps its own goals"""

    def __post_init__(self) -> None:
        super().__post_init__()
        least = f"at least one update per step of all {self.n_arms} arms, {1 / self.n_arms:.4g}"
        required = {
            "updates_per_env_step": (self.n_updates_per_vector_step >= 1, least),
            "replay_capacity": (self.replay_capacity >= self.n_arms, f"at least n_arms = {self.n_arms}"),
        }
        check_settings("learner", self, required)

    def make_learner(self, env: ReachEnv) -> Learner:
        """Return the learner, for the observations and actions of an environment."""
        raise NotImplementedError

    def make_epoch(self, env: ReachEnv, shown: Demonstrations | None = None) -> ReplayEpoch:
        """Return the epoch of the learner, with starts and goals as the environment draws them."""
        return ReplayEpoch(self, env, self.make_learner(env))

    @property
    def n_updates_per_vector_step(self) -> int:
        """Number of gradient steps after each action of all arms."""
        return round(self.updates_per_env_step * self.n_arms)

    @property
    def n_warmup_vector_steps(self) -> int:
        """Number of actions of each arm before the first gradient step."""
        return -(-self.warmup_env_steps // self.n_arms)

    @property
    def n_decay_updates(self) -> int:
        """Length of a learning rate's decay: gradient steps of a run without warm-up."""
        return self.n_epochs * self.vector_steps_per_epoch * self.n_updates_per_vector_step

    def n_updates(self, epoch: int) -> int:
        """Return the number of gradient steps by the end of an epoch."""
        n_vector_steps = epoch * self.vector_steps_per_epoch - self.n_warmup_vector_steps
        return max(0, n_vector_steps) * self.n_updates_per_vector_step


class Learner(Protocol):
    """Pure functions of a state, which is any pytree of arrays and all that an update changes."""

    def init(self, key: Array) -> Any:
        """Return the first state; no two of its leaves share a buffer, since the state is donated."""
        ...

    def act(self, state: Any, obs: Array, key: Array) -> Array:
        """Return exploring actions (..., A) in [-1, 1] at observations (..., O)."""
        ...

    def update(self, state: Any, batch: Transition, key: Array) -> tuple[Any, dict[str, Array]]:
        """Take one gradient step; return the next state and scalar metrics by name, such as "tqc/entropy"."""
        ...

    def policy(self, state: Any) -> Any:
        """Return the parameters of the policy, for export named and shaped as those of `networks.Actor`."""
        ...

    def mode(self, policy: Any, obs: Array) -> Array:
        """Return the policy's deterministic actions (..., A) in [-1, 1] at observations (..., O)."""
        ...

    def parts(self, state: Any) -> dict[str, Any]:
        """Return trees of arrays that checkpoints keep for export and other runs: `policy`, `reward`, ..."""
        ...

    def adopt(self, state: Any, parts: dict[str, Any]) -> Any:
        """Return the state with parts of another run's learner; ValueError where one cannot be taken."""
        ...


class ReplayState(NamedTuple):
    """All that a run consists of; with it, a run continues bit for bit."""

    arms: Any  # State of n_arms
    learner: Any  # state of the learner
    memory: Any  # Ring of Experience
    goals: Any  # state of the goals' distribution
    key: Array
    n_epochs: Array  # () int32 epochs done; counts of env steps would overflow within hours


class ReplayEpoch:
    """Epoch of a learner from the replay; starts and goals are `goals`', or else the environment's."""

    def __init__(self, config: ReplayConfig, env: ReachEnv, learner: Learner, goals: Any = None):
        self.config, self.env, self.learner, self.goals = config, env, learner, goals
        self.kind: xla.Kind = "arm" if env.uses_mjx else "networks"
        self.arms = VectorEnv(env, config.n_arms, config.episode_length)

    def first(self, key: Array) -> ReplayState:
        """Return the state that a run begins with: arms at their first starts, and an empty replay."""
        key, key_arms, key_learner, key_goals = jax.random.split(key, 4)
        goals = self.goals.init() if self.goals else ()
        learner = self.learner.init(key_learner)
        arms = self._begin(goals, self.arms.reset(key_arms), key_goals)
        # The replay has the shapes of the transitions that the arms will make.
        action = jax.eval_shape(self.learner.act, learner, arms.obs, key)
        experience = jax.eval_shape(self._experience, arms, action, arms)
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), experience)
        memory = replay.create(one, self.config.replay_capacity)
        return ReplayState(arms, learner, memory, goals, key, n_epochs=jnp.zeros((), jnp.int32))

    def advance(self, state: ReplayState) -> tuple[ReplayState, dict[str, Array]]:
        """Move every arm by `vector_steps_per_epoch` actions, with their updates; return also the metrics.

        These are means over the epoch, and counts: `env/unsettled`, the masked arms, `env/episodes` that
        ended, and `env/successes` that ended at their goals.
        """
        n_steps = self.config.vector_steps_per_epoch
        state, metrics = jax.lax.scan(self._vector_step, state, jnp.arange(n_steps), length=n_steps)
        counts = {name: jnp.sum(metrics.pop(name)) * self.config.n_arms for name in COUNTS}
        state = state._replace(n_epochs=state.n_epochs + 1)
        return state, jax.tree.map(jnp.mean, metrics) | counts

    def _vector_step(self, state: ReplayState, step: Array) -> tuple[ReplayState, dict[str, Array]]:
        """Take one action of every arm, and the updates that follow it; `step` () counts within the epoch."""
        key, key_act, key_random, key_reset, key_updates, key_goals = jax.random.split(state.key, 6)

        # Act: uniformly at random during warm-up, then as the learner explores.
        warmed_up = self._warmed_up(state.n_epochs, step)
        uniform = draws.uniform(key_random, (self.arms.n, self.env.action_size), minval=-1.0)
        explored = self.learner.act(state.learner, state.arms.obs, key_act)
        action = jnp.where(warmed_up, explored, uniform)  # (n_arms, n_springs)

        # Step the arms; where an episode ended, begin the next one.
        arms, after, terminated, truncated = self.arms.step(state.arms, action, key_reset)
        arms = self._begin(state.goals, arms, key_goals)

        # Store what is valid and finite.
        experience = self._experience(state.arms, action, after)
        valid = after.info["valid"] & replay.finite_rows(experience)  # (n_arms,)
        memory = replay.add(state.memory, experience, valid)

        # Learn.
        learner, losses = self._learn(state.learner, memory, key_updates, warmed_up)
        ended = terminated | truncated
        of_arms = after.metrics | {"episodes": ended, "successes": ended & (after.metrics["reached"] > 0)}
        env_metrics = {f"env/{name}": jnp.mean(value) for name, value in of_arms.items()}
        state = state._replace(arms=arms, learner=learner, memory=memory, key=key)
        return state, env_metrics | losses

    def _begin(self, goals: Any, arms: State, key: Array) -> State:
        """Return the arms with starts and goals of new episodes, where these are not the environment's."""
        return self.goals.begin(goals, arms, key) if self.goals else arms

    def _warmed_up(self, n_epochs: Array, step: Array) -> Array:
        """Return whether warm-up is over before an action of all arms: () bool."""
        epochs, steps = divmod(self.config.n_warmup_vector_steps, self.config.vector_steps_per_epoch)
        return (n_epochs > epochs) | ((n_epochs == epochs) & (step >= steps))

    def _learn(
        self, learner: Any, memory: replay.Ring, key: Array, warmed_up: Array
    ) -> tuple[Any, dict[str, Array]]:
        """Take the updates of one vector step, none during warm-up; return the learner's state and means."""
        keys = jax.random.split(key, self.config.n_updates_per_vector_step)

        def update(learner: Any, key: Array) -> tuple[Any, dict[str, Array]]:
            key_sample, key_relabel, key_update = jax.random.split(key, 3)
            stored = self._sample(memory, key_sample)
            batch = relabel(stored, key_relabel, self.config.hindsight, self.env)
            return self.learner.update(learner, batch, key_update)

        @jax.jit  # traced once for the branch and the shapes of its results
        def run(learner: Any) -> tuple[Any, dict[str, Array]]:
            learner, metrics = jax.lax.scan(update, learner, keys)
            return learner, jax.tree.map(jnp.mean, metrics)

        # A branch has to return metrics of the same shapes, whether it learns or not.
        shapes = jax.eval_shape(run, learner)[1]
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return jax.lax.cond(warmed_up, run, lambda learner: (learner, nothing), learner)

    def _sample(self, memory: replay.Ring, key: Array) -> Experience:
        """Return a batch, with poses up to `hindsight.n_later` actions later in the same episode."""
        size, n_later = self.config.batch_size, self.config.hindsight.n_later
        if not n_later:
            return replay.sample(memory, key, size)
        now, later, ahead = replay.sample_ahead(memory, key, size, self.arms.n, n_later)
        return now._replace(later_pose=later_pose(now, later, ahead))

    def _experience(self, before: State, action: Array, after: State) -> Experience:
        """Return the transitions of n arms as they are stored."""
        start, end = before.pipeline_state, after.pipeline_state
        sensed_action = self.env.action_of(end.spring_m)
        if self.env.config.in_motion:  # the arm moves on: the other references still count
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
