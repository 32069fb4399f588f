"""Compilation of a run's two functions, its first state and its epoch."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

import jax
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm.env import ReachEnv
from mjx_softarm.mechanics.workspace import Pool

T = TypeVar("T")
State = Any  # `ReplayState`, or `GradientState` of the learner `analytic`


class Epoch(Protocol):
    """One epoch of training as pure functions of a state with the fields `learner`, `key` and `n_epochs`.

    There are two: `train.epoch.replay_epoch.ReplayEpoch` and `train.agent.analytic.GradientEpoch`.
    """

    env: ReachEnv
    kind: Any  # kind of program, see `xla.jit`: what most of its time goes to
    learner: Any  # policy(state), mode(policy, obs), parts(state), adopt(state, parts)

    def first(self, key: Any) -> State:
        """Return the state that a run begins with; no two of its leaves share a buffer, for donation."""
        ...

    def advance(self, state: State) -> tuple[State, dict[str, Array]]:
        """Return the state after an epoch, and its metrics; `env/unsettled` counts failed simulations."""
        ...


class Job:
    """A compiled epoch: each of its two functions is traced once, and the state is donated.

    `n_traces` counts how often the epoch was traced: once in a run. `pool_of` returns the poses of an epoch,
    by default always those of the environment.
    """

    def __init__(self, epoch: Epoch, pool_of: Callable[[int], Pool] | None = None):
        self.env, self.learner = epoch.env, epoch.learner
        self._pool_of = pool_of or (lambda k: epoch.env.pool)
        self.n_traces = 0

        # The pool of poses is an argument of both functions: their compilation does not wait for it.
        def first(key: Array, pool: Pool) -> State:
            with epoch.env.poses.given(pool):
                return epoch.first(key)

        def advance(state: State, pool: Pool) -> tuple[State, dict[str, Array]]:
            self.n_traces += 1
            with epoch.env.poses.given(pool):
                return epoch.advance(state)

        self._init = xla.jit(first, "once")
        self._epoch = xla.jit(advance, epoch.kind, donate_argnums=0)

    def init(self, key: Any) -> State:
        """Return the state that a run begins with; `key` is what the epoch's `first` takes."""
        return self._init(key, self._pool_of(0))

    def epoch(self, state: State) -> tuple[State, dict[str, Array]]:
        """Return the state after an epoch, and its metrics; the state given is used up."""
        return self._epoch(state, self._pool_of(int(state.n_epochs)))

    def shapes(self, key: Any = None) -> State:
        """Return the shapes of a state."""
        key = jax.random.PRNGKey(0) if key is None else key
        return jax.eval_shape(self._init, key, self.env.poses.shapes)

    def compile_epoch(self) -> None:
        """Compile the epoch before it is called."""
        self._epoch = self._epoch.lower(self.shapes(), self.env.poses.shapes).compile()

    def start(self, first: Callable[[], T]) -> T:
        """Return the result of `first`, such as a state, with the epoch compiled meanwhile.

        Another thread calls `first`; the pool of poses settles there.
        """
        with ThreadPoolExecutor(1) as beside:
            result = beside.submit(first)
            self.compile_epoch()
            return result.result()
