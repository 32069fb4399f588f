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
from mjx_softarm.control import allocation, chambers_of_springs
from mjx_softarm.spec import ArmSpec
from mjx_softarm.spec_tables import Unmodelled

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
        spring_m (m, n_springs) [m]: lengths at rest, in the order of time.
        measured_kpa (m, n_chambers) [kPa]: pressures that held the arm at these lengths.
        simulated_kpa (m, n_chambers) [kPa]: pressures that hold the simulated arm at these lengths.
        seed: seed that chooses the contiguous blocks of held-out rows.
    """
    spring_m = np.asarray(spring_m, float)
    left_kpa = without_redundant_part(np.asarray(measured_kpa, float), spring_m, spec) - simulated_kpa
    stretched_m = spring_m - spec.at_springs(spec.geometry.section_length_m)
    held_out = held_out_blocks(len(left_kpa), block=HELD_OUT_BLOCK, seed=seed)
    # Fit to the rows that are not held out, in standardised lengths, as the prior acts on these.
    scale_m = np.maximum(stretched_m.std(axis=0), 1e-6)
    slope, offset_kpa = ridge((stretched_m / scale_m)[~held_out], left_kpa[~held_out], RIDGE)
    slope = slope / scale_m[:, None]  # [kPa/m]
    # Judge the function by the held-out rows.
    after_kpa = left_kpa - stretched_m @ slope - offset_kpa
    found = Unmodelled(tuple(map(float, offset_kpa)), tuple(map(float, slope.T.ravel())))
    return HeldPressures(found, _rms(left_kpa[held_out]), _rms(after_kpa[held_out]))


def without_redundant_part(pressure_kpa: np.ndarray, spring_m: np.ndarray, spec: ArmSpec) -> np.ndarray:
    """Return the pressures (m, n_chambers) that push alike and that the sensor-space law would hold.

    The law holds no pressure that neither stretches nor bends a section, and poses of a log may.
    """
    matrices, chambers = allocation(spec), spec.chambers
    if matrices is None:
        return pressure_kpa
    # Effective areas at the lengths of the chambers, which lie in the plane through their section's springs
    stretched_m = spring_m @ chambers_of_springs(spec).T - spec.at_chambers(spec.geometry.section_length_m)
    area = spec.per_chamber(chambers.area_m2) + stretched_m * spec.per_chamber(chambers.area_slope_m)

    # The same forces and moments by pressures in the planes
    plane = np.eye(spec.n_chambers) - matrices.redundant
    push = plane @ (area * pressure_kpa)[..., None]
    return (np.linalg.pinv(plane @ (area[..., None] * plane)) @ push)[..., 0]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
