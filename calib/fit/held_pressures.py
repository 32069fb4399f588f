"""Pressures that hold the unloaded arm, measured less simulated: what the model of the chambers leaves.

Holes, rings and bellows are not where the specification has them, so a chamber's pressure depends a little on
the springs beside it. A straight line in all springs' lengths, fitted by least squares, takes that up. It
matters to the payload, which is estimated from pressures: a kilogram is some 3 kPa in each chamber.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.fit.blocks import held_out_blocks
from mjx_softarm.spec import ArmSpec, Unmodelled

HELD_OUT_SHARE, HELD_OUT_BLOCK = 0.2, 5  # poses
RIDGE = 1.0  # as many poses say that there is no slope


class HeldPressures(NamedTuple):
    """The fit, and root-mean-square pressures of the rows held out."""

    unmodelled: Unmodelled
    before_kpa: float  # measured less simulated
    after_kpa: float  # what the fit leaves of it

    @property
    def is_better(self) -> bool:
        """Whether less is left at the rows held out than there was."""
        return self.after_kpa < self.before_kpa


def fit_held_pressures(
    spec: ArmSpec, spring_m: np.ndarray, measured_kpa: np.ndarray, simulated_kpa: np.ndarray, seed: int = 0
) -> HeldPressures:
    """Fit the pressures that hold the unloaded arm.

    Args:
        spec: calibrated arm.
        spring_m (m, n) [m]: lengths at rest, in the order of time.
        measured_kpa (m, n) [kPa]: pressures that held the arm there.
        simulated_kpa (m, n) [kPa]: pressures that hold the simulated arm there.
        seed: of the contiguous blocks of rows that are held out.
    """
    left_kpa = np.asarray(measured_kpa, float) - simulated_kpa
    stretched_m = np.asarray(spring_m, float) - spec.geometry.section_length_m
    held_out = held_out_blocks(len(left_kpa), HELD_OUT_SHARE, HELD_OUT_BLOCK, seed)
    scale_m = np.maximum(stretched_m.std(axis=0), 1e-6)
    design = np.column_stack([np.ones(len(left_kpa)), stretched_m / scale_m])
    known = design[~held_out]
    ridge = RIDGE * np.diag([0.0, *np.ones(len(scale_m))])
    weights = np.linalg.solve(known.T @ known + ridge, known.T @ left_kpa[~held_out])  # (1 + n, n)
    found = Unmodelled(
        tuple(map(float, weights[0])), tuple(map(float, (weights[1:] / scale_m[:, None]).T.ravel()))
    )
    after_kpa = left_kpa - design @ weights
    return HeldPressures(found, _rms(left_kpa[held_out]), _rms(after_kpa[held_out]))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
