"""Evaluation of a policy on demonstrated positions, with the body inside the pipe, in motion all the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm.env import ReachEnv
from mjx_softarm.sensing.pose import pose_error
from train.agent.learner import Learner
from train.runs.evaluate import N_ACTIONS, Figures, Reached, figure, follower, nominal, start_keys


class AtPositions(NamedTuple):
    """Results of an arm at each of m demonstrated positions, in their order."""

    reached: Reached
    success: Array  # (m,) bool: close enough, no chamber saturated, the body inside the pipe


@dataclass(frozen=True)
class PositionSummary(Figures):
    """Figures at demonstrated positions."""

    error_mm: tuple[float, ...]  # tip error at each position
    success_share: float = figure("positions with success", "%", 1)
    success_first_share: float = figure("positions of the first stage with success", "%", 1)
    reached_share: float = figure("positions reached", "%", 1)  # with or without saturation and contact
    median_mm: float = figure("tip error, median", "mm", 2)
    max_mm: float = figure("tip error, largest", "mm", 2)
    x_mm: float = figure("mean absolute error in x", "mm", 2)
    y_mm: float = figure("mean absolute error in y", "mm", 2)
    z_mm: float = figure("mean absolute error in z", "mm", 2)
    saturated_positions: int = figure("positions with a saturated chamber", "")
    outside_positions: int = figure("positions with the body outside the pipe", "")  # also on the way there
    unsettled: int = figure("arms that did not settle", "")


class PositionEvaluator:
    """Evaluate policies on one path of positions (m, 6) [mm, deg]; compiled once.

    A single arm without randomisation goes from position to position. It is evaluated in its second pass.
    `first` (m,) bool tells the positions that are goals from the start.
    """

    def __init__(
        self,
        env: ReachEnv,
        learner: Learner,
        positions: np.ndarray,
        first: np.ndarray,
        n_actions: int = N_ACTIONS,
    ):
        self.env, self.learner, self.first = nominal(env), learner, first
        self.positions = np.asarray(positions, np.float32)
        self._follow = xla.jit(follower(self.env, learner, n_actions), env.uses_mjx)

    def on(self, env: ReachEnv, n_actions: int = N_ACTIONS) -> PositionEvaluator:
        """Return the same evaluation on another environment."""
        return PositionEvaluator(env, self.learner, self.positions, self.first, n_actions)

    def __call__(self, policy: Any) -> tuple[PositionSummary, AtPositions]:
        """Return figures, and results as NumPy arrays."""
        policy = jax.device_get(policy)  # it may be on many devices
        passes = jax.device_get(self._follow(policy, np.tile(self.positions, (2, 1)), start_keys(1)[0]))
        reached = jax.tree.map(lambda x: x[len(self.positions) :], passes)
        return summarise(reached, self.env.config.reward.threshold, self.first)


def summarise(reached: Reached, threshold: float, first: np.ndarray) -> tuple[PositionSummary, AtPositions]:
    """Return the figures of results; a tip is close enough with its scaled error below the threshold."""
    error_mm = reached.tip_error_mm
    close = reached.scaled_error < threshold
    success = close & (reached.saturated_chambers == 0) & (reached.clearance_mm > 0.0) & reached.settled
    x, y, z = np.abs(pose_error(reached.pose, reached.goal))[:, :3].mean(axis=0)
    figures = PositionSummary(
        success_share=float(success.mean()),
        success_first_share=float(success[first].mean()),
        reached_share=float(close.mean()),
        median_mm=float(np.median(error_mm)),
        max_mm=float(error_mm.max()),
        x_mm=float(x),
        y_mm=float(y),
        z_mm=float(z),
        saturated_positions=int(np.count_nonzero(reached.saturated_chambers)),
        outside_positions=int(np.count_nonzero(reached.clearance_mm <= 0.0)),
        unsettled=int(np.count_nonzero(~reached.settled)),
        error_mm=tuple(float(value) for value in error_mm),
    )
    return figures, AtPositions(reached, success)
