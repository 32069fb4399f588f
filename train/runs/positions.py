"""Evaluation of a policy on demonstrated positions, with the body inside the pipe, in motion all the way.

At rest, an action leads to the same pose from every start, and one arm is enough. In motion the way counts.
Several arms, each with damping, payload and the like of its own, begin at different positions. They have to
stay where they have arrived.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm.env import ReachEnv
from mjx_softarm.env.state import State
from mjx_softarm.sensing.pose import pose_error
from train.agent.learner import Learner
from train.demos.demonstrations import Demonstrations
from train.epoch.goals import static_poses
from train.runs.evaluate import (
    N_ACTIONS,
    UNCORRECTED,
    Figures,
    Reached,
    figure,
    follower,
    nominal,
    reach,
    start_keys,
)

N_STARTS = 7  # arms in motion; each begins at another position
HOLD_S = 1.0  # time that an arm in motion has to stay, after its last action towards a position


class AtPositions(NamedTuple):
    """Results of k arms at m demonstrated positions: n = k m rows, arm by arm, positions in their order."""

    reached: Reached
    position: np.ndarray  # (n,) which position
    success: (
        np.ndarray
    )  # (n,) bool: close enough, no chamber saturated, the body inside the pipe, held in motion


@dataclass(frozen=True)
class PositionSummary(Figures):
    """Figures at demonstrated positions; in motion from several starts."""

    error_mm: tuple[float, ...]  # tip error at each position, mean over the starts
    success: tuple[tuple[bool, ...], ...]  # of each start at each position
    success_share: float = figure("positions with success", "%", 1)
    success_first_share: float = figure("positions of the first stage with success", "%", 1)
    reached_share: float = figure("positions reached", "%", 1)  # with or without saturation and contact
    median_mm: float = figure("tip error, median", "mm", 2)
    max_mm: float = figure("tip error, largest", "mm", 2)
    x_mm: float = figure("mean absolute error in x", "mm", 2)
    y_mm: float = figure("mean absolute error in y", "mm", 2)
    z_mm: float = figure("mean absolute error in z", "mm", 2)
    # A position counts if this happens from any start.
    saturated_positions: int = figure("positions with a saturated chamber", "")
    outside_positions: int = figure("positions with the body outside the pipe", "")  # also on the way there
    unsettled: int = figure("arms that did not settle", "")
    # In motion only.
    held_share: float | None = figure(f"positions held for {HOLD_S:g} s", "%", 1, default=None)


class PositionEvaluator:
    """Evaluate policies on m demonstrated positions, one after another; compiled once.

    At rest, a single arm without randomisation goes from position to position. Its second pass counts.
    In motion, `N_STARTS` arms with the environment's randomisation begin without velocity at different
    positions, each in the equilibrium of the nominal arm, and go around once. After `n_actions` towards a
    position, each has to stay there for `HOLD_S`. `first` (m,) bool tells the positions that are goals
    from the start. At rest, goals are corrected as in `Evaluator`.

    Raises:
        ConfigError: in motion, the arm does not come to rest at a position.
    """

    def __init__(
        self,
        env: ReachEnv,
        learner: Learner,
        demonstrations: Demonstrations,
        first: np.ndarray,
        n_actions: int = N_ACTIONS,
        shift_limit: np.ndarray = UNCORRECTED,
    ):
        self.learner, self.demonstrations, self.first = learner, demonstrations, first
        self.positions = np.asarray(demonstrations.positions, np.float32)  # (m, 6)
        self.moves = env.config.moves
        self.env = env if self.moves else nominal(env)
        at_rest = follower(self.env, learner, n_actions, shift_limit)
        self._go = xla.jit(self._around(n_actions) if self.moves else at_rest)

    def on(
        self, env: ReachEnv, n_actions: int = N_ACTIONS, shift_limit: np.ndarray = UNCORRECTED
    ) -> PositionEvaluator:
        """Return the same evaluation on another environment."""
        return PositionEvaluator(env, self.learner, self.demonstrations, self.first, n_actions, shift_limit)

    def __call__(self, policy: Any) -> tuple[PositionSummary, AtPositions]:
        """Return figures, and results as NumPy arrays."""
        policy, m = jax.device_get(policy), len(self.positions)  # it may be on many devices
        if self.moves:
            begin = np.arange(N_STARTS) * m // N_STARTS
            found, held = jax.device_get(self._go(policy, begin, start_keys(N_STARTS)))
        else:
            passes = jax.device_get(self._go(policy, np.tile(self.positions, (2, 1)), start_keys(1)[0]))
            found, held = jax.tree.map(lambda x: x[None, m:], passes), None
        return summarise(found, held, self.env.config.reward.threshold, self.first)

    def _around(self, n_actions: int) -> Callable[[Any, Array, Array], tuple[Reached, Array]]:
        """Return a function that takes k arms around all positions.

        Its arguments are the policy, first positions (k,) and keys (k,). It returns results (k, m), and
        whether the arms stayed (k, m).
        """
        env, learner, goals = self.env, self.learner, jnp.asarray(self.positions)
        at_rest = static_poses(env, np.asarray(self.demonstrations.actions))
        n_hold = math.ceil(HOLD_S / env.config.dynamic_step_s)

        def visit(policy: Any, state: State, goal: Array) -> tuple[State, tuple[Reached, Array]]:
            # Act one action after the other: arrive, then stay.
            act = lambda state, _: reach(env, learner, policy, state, goal, n_actions=1)  # noqa: E731
            state, way = jax.lax.scan(act, state, None, length=n_actions + n_hold)
            # The state after arriving counts, the body's clearance until the end.
            there = jax.tree.map(lambda x: x[n_actions - 1], way)
            there = there._replace(clearance_mm=jnp.min(way.clearance_mm), settled=jnp.all(way.settled))
            near = (way.near_s == 0.0) & (way.scaled_error < env.config.reward.threshold) & way.settled
            return state, (there, jnp.all((near & (way.saturated_chambers == 0))[n_actions:]))

        def around(policy: Any, begin: Array, key: Array) -> tuple[Reached, Array]:
            # Begin in the nominal arm's equilibrium at the position before the first.
            state, order = env.reset(key), (begin + jnp.arange(len(goals))) % len(goals)
            arm = env.put(state.pipeline_state, jax.tree.map(lambda x: x[order[-1]], at_rest))
            state = state.replace(pipeline_state=arm)
            _, found = jax.lax.scan(lambda state, goal: visit(policy, state, goal), state, goals[order])
            # Bring the results into the order of the positions.
            return jax.tree.map(lambda x: jnp.roll(x, begin, axis=0), found)

        return jax.vmap(around, in_axes=(None, 0, 0))


def summarise(
    found: Reached, held: np.ndarray | None, threshold: float, first: np.ndarray
) -> tuple[PositionSummary, AtPositions]:
    """Return the figures of results.

    Args:
        found: results (k, m) of k arms at m positions.
        held (k, m) bool: in motion, whether the arms stayed; None at rest.
        threshold: a tip is close enough with its scaled error below this.
        first (m,) bool: positions that are goals from the start.
    """
    # Success at each visit of a position.
    close = found.scaled_error < threshold  # (k, m)
    saturated, outside = found.saturated_chambers > 0, found.clearance_mm <= 0.0
    success = close & ~saturated & ~outside & found.settled & (True if held is None else held)
    # Figures over all visits.
    error_mm = found.tip_error_mm
    x, y, z = np.abs(pose_error(found.pose, found.goal))[..., :3].mean(axis=(0, 1))
    figures = PositionSummary(
        success_share=float(success.mean()),
        success_first_share=float(success[:, first].mean()),
        reached_share=float(close.mean()),
        median_mm=float(np.median(error_mm)),
        max_mm=float(error_mm.max()),
        x_mm=float(x),
        y_mm=float(y),
        z_mm=float(z),
        saturated_positions=int(np.count_nonzero(saturated.any(axis=0))),
        outside_positions=int(np.count_nonzero(outside.any(axis=0))),
        unsettled=int(np.count_nonzero(~found.settled)),
        held_share=None if held is None else float(held.mean()),
        error_mm=tuple(float(value) for value in error_mm.mean(axis=0)),
        success=tuple(tuple(bool(value) for value in row) for row in success),
    )
    rows = jax.tree.map(lambda x: np.reshape(x, (-1, *x.shape[2:])), found)
    position = np.tile(np.arange(success.shape[1]), len(success))
    return figures, AtPositions(rows, position, np.asarray(success).reshape(-1))
