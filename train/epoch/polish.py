"""Polishing: after TQC, its policy goes on learning through the equilibrium."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh

from train.agent.analytic import Analytic, AnalyticState
from train.agent.learner import Sample
from train.agent.tqc import TQCState
from train.epoch.job import Job, TrainState

T = TypeVar("T")


class PolishState(NamedTuple):
    """All that an update changes, and what TQC left."""

    analytic: AnalyticState
    tqc: TQCState

    @property
    def agent(self) -> TQCState:
        """TQC's networks with the polished policy, for another run to begin with."""
        policy = self.analytic.mean_actor_params
        return self.tqc._replace(actor_params=policy, mean_actor_params=policy)


class Polish:
    """`Learner` that polishes what TQC left, and keeps its critics.

    Args:
        analytic: the learner that polishes.
        tqc: shapes of TQC's state.
    """

    def __init__(self, analytic: Analytic, tqc: TQCState):
        self.analytic, self.tqc = analytic, tqc
        self.own_arms, self.mode = analytic.own_arms, analytic.mode

    def init(self, key: Array) -> PolishState:
        """Return a fresh policy, to be replaced by TQC's."""
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self.tqc)
        return PolishState(self.analytic.init(key), nothing)

    def begin_with(self, state: PolishState, tqc: TQCState, policy: Any) -> PolishState:
        """Return the state with TQC's networks and a policy of it."""
        one, other = (jax.tree.map(jnp.copy, policy) for _ in range(2))  # so that the state can be donated
        analytic = state.analytic._replace(actor_params=one, mean_actor_params=other)
        return PolishState(analytic, tqc)

    def act(self, state: PolishState, obs: Array, key: Array) -> Array:
        """Return the policy's actions (..., A) at obs (..., O)."""
        return self.analytic.act(state.analytic, obs, key)

    def policy(self, state: PolishState) -> Any:
        """Return the parameters of the mean policy."""
        return self.analytic.policy(state.analytic)

    def update(self, state: PolishState, sample: Sample, key: Array) -> tuple[PolishState, dict[str, Array]]:
        """Take one gradient step through the equilibrium."""
        analytic, metrics = self.analytic.update(state.analytic, sample, key)
        return state._replace(analytic=analytic), metrics


class PolishedJob:
    """A `Job` of TQC, then one of the analytic learner that begins with its policy: one run, two states.

    The last epoch of the first job hands over, so that a checkpoint after it holds the second one's state.
    The second epoch is compiled while the first one runs.
    """

    def __init__(self, tqc: Job, analytic: Analytic, mesh: Mesh | None = None):
        shapes = jax.eval_shape(tqc.learner.init, jax.random.PRNGKey(0))
        self._learner = Polish(analytic, shapes)
        self.tqc, self.polish = tqc, Job(tqc.config.polish, analytic.env, self._learner, mesh=mesh)
        self.config, self.env, self.learner = tqc.config, tqc.env, tqc.learner
        self._n_epochs = tqc.config.n_own_epochs
        self._compiled: Future | None = None

    def init(self, key: Array) -> TrainState:
        """Return the state that the run begins with."""
        return self.tqc.init(key)

    def like(self, epoch: int) -> TrainState:
        """Return a state structured as the run's after some epochs."""
        return (self.polish if epoch >= self._n_epochs else self.tqc).like(epoch)

    def shapes(self, epoch: int) -> TrainState:
        """Return the shapes of what `like` returns."""
        return (self.polish if epoch >= self._n_epochs else self.tqc).shapes(epoch)

    def start(self, first: Callable[[], T], epoch: int = 0) -> T:
        """Return the result of `first`, with the epochs compiled in other threads; see `Job.start`."""
        if epoch >= self._n_epochs:
            return self.polish.start(first)
        beside = ThreadPoolExecutor(1)
        self._compiled = beside.submit(self.polish.start, lambda: None)
        beside.shutdown(wait=False)
        return self.tqc.start(first)

    def epoch(self, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
        """Run an epoch of the stage that the state is of; the state given is used up."""
        stage = self._stage(state)
        state, metrics = stage.epoch(state)
        per_epoch = self.config.n_arms * self.config.vector_steps_per_epoch
        if stage is self.tqc and int(state.n_env_steps) == self._n_epochs * per_epoch:
            state = self._hand_over(state)
        return state, metrics

    def policy(self, state: TrainState) -> Any:
        """Return the parameters of the policy that is evaluated and exported."""
        return self._stage(state).policy(state)

    def place(self, state: TrainState) -> TrainState:
        """Return the state on the devices where its epoch expects it."""
        return self._stage(state).place(state)

    def _stage(self, state: TrainState) -> Job:
        return self.polish if isinstance(state.learner, PolishState) else self.tqc

    def _hand_over(self, state: TrainState) -> TrainState:
        if self._compiled is not None:
            self._compiled.result()
        key, key_init = jax.random.split(state.key)
        begun = self.polish.init(key_init)
        return self.polish.place(
            begun._replace(
                learner=self._learner.begin_with(begun.learner, state.learner, self.tqc.policy(state)),
                key=key,
                n_env_steps=state.n_env_steps,
                n_updates=state.n_updates,
                n_unsettled=state.n_unsettled,
            )
        )
