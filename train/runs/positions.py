"""Evaluation of a policy on demonstrated positions, with the body inside the pipe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_softarm._support import xla
from mjx_softarm.env import ReachEnv
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.sensing.pose import pose_error
from train.demos.demonstrations import Demonstrations
from train.runs.evaluate import UNCORRECTED, Figures, Reached, figure, follower, nominal, start_keys


class AtPositions(NamedTuple):
    """Results at m demonstrated positions, in their order."""

    reached: Reached  # (m, ...)
    success: np.ndarray  # (m,) bool: close enough, no chamber saturated, the body inside the pipe


@dataclass(frozen=True)
class PositionSummary(Figures):
    """Figures at demonstrated positions."""

    error_mm: tuple[float, ...]  # tip error at each position
    success: tuple[bool, ...]  # of each position
    success_share: float = figure("positions with success", "%", 1)
    success_first_share: float = figure("positions of the first stage with success", "%", 1)
    reached_share: float = figure("positions reached", "%", 1)  # with or without saturation and contact
    median_mm: float = figure("tip error, median", "mm", 2)
    max_mm: float = figure("tip error, largest", "mm", 2)
    x_mm: float = figure("mean absolute error in x", "mm", 2)
    y_mm: float = figure("mean absolute error in y", "mm", 2)
    z_mm: float = figure("mean absolute error in z", "mm", 2)
    saturated_positions: int = figure("positions with a saturated chamber", "")
    outside_positions: int = figure("positions with the body outside the pipe", "")
    unsettled: int = figure("arms that did not settle", "")


class PositionEvaluator:
    """Evaluate policies on m demonstrated positions, one after another; compiled once.

    An action leads to the same pose from every start, so one arm without randomisation goes from position to
    position. Its second pass counts. `first` (m,) bool marks the positions that are goals of the first
    stage. Goals are corrected as in `Evaluator`.
    """

    def __init__(
        self,
        env: ReachEnv,
        learner: Any,
        demonstrations: Demonstrations,
        first: np.ndarray,
        n_actions: int = N_ACTIONS,
        shift_limit: np.ndarray = UNCORRECTED,
    ):
        self.learner, self.demonstrations, self.first = learner, demonstrations, first
        self.positions = np.asarray(demonstrations.positions, np.float32)  # (m, 6)
        self.env = nominal(env)
        self._go = xla.jit(follower(self.env, learner, n_actions, shift_limit))

    def on(
        self, env: ReachEnv, n_actions: int = N_ACTIONS, shift_limit: np.ndarray = UNCORRECTED
    ) -> PositionEvaluator:
        """Return the same evaluation on another environment."""
        return PositionEvaluator(env, self.learner, self.demonstrations, self.first, n_actions, shift_limit)

    @property
    def title(self) -> str:
        """Title of the table of figures."""
        return f"{len(self.positions)} demonstrated positions"

    def headline(self, row: dict[str, float]) -> str:
        """Return a short text for a row of metrics with an evaluation."""
        share, median_mm = row["evaluation/success_share"], row["evaluation/median_mm"]
        return f"success at {100 * share:.0f} % of the positions, median {median_mm:.1f} mm"

    def __call__(self, policy: Any) -> tuple[PositionSummary, AtPositions]:
        """Return figures, and results as NumPy arrays."""
        policy, m = jax.device_get(policy), len(self.positions)  # it may be on many devices
        passes = jax.device_get(self._go(policy, np.tile(self.positions, (2, 1)), start_keys(1)[0]))
        second = jax.tree.map(lambda x: x[m:], passes)
        return summarise(second, self.env.config.reward.threshold, self.first)


def summarise(reached: Reached, threshold: float, first: np.ndarray) -> tuple[PositionSummary, AtPositions]:
    """Return the figures of results.

    Args:
        reached: results at m positions.
        threshold: a tip is close enough with its scaled error below this.
        first (m,) bool: positions that are goals of the first stage.
    """
    close = reached.scaled_error < threshold  # (m,)
    saturated, outside = reached.saturated_chambers > 0, reached.clearance_mm <= 0.0
    success = close & ~saturated & ~outside & reached.settled
    error_mm = reached.tip_error_mm
    x, y, z = np.abs(pose_error(reached.pose, reached.goal))[..., :3].mean(axis=0)
    figures = PositionSummary(
        success_share=float(success.mean()),
        success_first_share=float(success[first].mean()),
        reached_share=float(close.mean()),
        median_mm=float(np.median(error_mm)),
        max_mm=float(error_mm.max()),
        x_mm=float(x),
        y_mm=float(y),
        z_mm=float(z),
        saturated_positions=int(np.count_nonzero(saturated)),
        outside_positions=int(np.count_nonzero(outside)),
        unsettled=int(np.count_nonzero(~reached.settled)),
        error_mm=tuple(float(value) for value in error_mm),
        success=tuple(bool(value) for value in success),
    )
    return figures, AtPositions(reached, np.asarray(success))
