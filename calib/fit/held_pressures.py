"""Residual pressures of the unloaded arm: measured minus simulated, as a linear function of the springs.

Holes, rings and bellows are not where the specification has them, so a chamber's pressure depends a little on
the springs beside it. Least squares fit a linear function of all springs' lengths to the residual. It matters
to the payload, which is estimated from pressures: a kilogram is some 3 kPa in each chamber.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.fit.blocks import held_out_blocks
from calib.fit.leastsquares import ridge
from mjx_softarm.spec import ArmSpec, Unmodelled

HELD_OUT_BLOCK = 5  # poses
RIDGE = 1.0  # prior: as strong as this many poses without a slope


class HeldPressures(NamedTuple):
    """Fitted function, and root-mean-square residual pressures of the held-out rows."""

    unmodelled: Unmodelled
    before_kpa: float  # residual without the function
    after_kpa: float  # residual with the function

    @property
    def is_better(self) -> bool:
        """Whether the function makes the residual of the held-out rows smaller."""
        return self.after_kpa < self.before_kpa


def fit_held_pressures(
    spec: ArmSpec, spring_m: np.ndarray, measured_kpa: np.ndarray, simulated_kpa: np.ndarray, seed: int = 0
) -> HeldPressures:
    """Fit the residual pressures of the unloaded arm.

    Args:
        spec: calibrated arm.
        spring_m (m, n) [m]: lengths at rest, in the order of time.
        measured_kpa (m, n) [kPa]: pressures that held the arm at these lengths.
        simulated_kpa (m, n) [kPa]: pressures that hold the simulated arm at these lengths.
        seed: seed that chooses the contiguous blocks of held-out rows.
    """
    left_kpa = np.asarray(measured_kpa, float) - simulated_kpa
    stretched_m = np.asarray(spring_m, float) - spec.geometry.section_length_m
    held_out = held_out_blocks(len(left_kpa), block=HELD_OUT_BLOCK, seed=seed)
    # Fit to the rows that are not held out, in standardised lengths, as the prior acts on these.
    scale_m = np.maximum(stretched_m.std(axis=0), 1e-6)
    slope, offset_kpa = ridge((stretched_m / scale_m)[~held_out], left_kpa[~held_out], RIDGE)
    slope = slope / scale_m[:, None]  # [kPa/m]
    # Judge the function by the held-out rows.
    after_kpa = left_kpa - stretched_m @ slope - offset_kpa
    found = Unmodelled(tuple(map(float, offset_kpa)), tuple(map(float, slope.T.ravel())))
    return HeldPressures(found, _rms(left_kpa[held_out]), _rms(after_kpa[held_out]))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
