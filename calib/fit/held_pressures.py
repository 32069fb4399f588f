"""Fit of the residual pressures that hold the unloaded arm, measured minus simulated.

Each section's process (`mjx_softarm.sensing.held_pressures`) takes the length and the noise of a grid that
make the poses most likely; the covariance between its chambers has a closed form. The chambers' hysteresis
(`mjx_softarm.sensing.hysteresis`) follows by generalised least squares from the order of the poses. Held-out
poses judge both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.fit.blocks import held_out_blocks
from calib.fit.leastsquares import rms_of
from calib.fit.likelihood import Hyperparameters, most_likely
from mjx_softarm.control import allocation, chambers_of_springs
from mjx_softarm.sensing.held_pressures import HeldPressures, kernel, residual, sections_of
from mjx_softarm.sensing.hysteresis import stops
from mjx_softarm.spec import ArmSpec

HELD_OUT_BLOCK = 5  # poses
LENGTHS = (1.5, 2.5, 4.0, 6.5, 10.0)  # distances of standardised states
NOISES = (1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0)  # variances over the variance of a section
STROKES = (0.02, 0.04, 0.06, 0.1)  # strokes of hysteresis, in lengths of a section
MAX_ROWS = 1_000  # poses of a process
LEAST_KPA = 0.01  # least standard deviation of a chamber's residual
TINY = 1e-12  # [1/kPa^2] information of chambers that never move
LEAST_SCALE = 1e-6  # [m, kPa] of a spring or a pressure that never changes


class PressureFit(NamedTuple):
    """Process of the residual pressures, and root mean squares at held-out poses."""

    held: HeldPressures  # given all poses
    before_kpa: float  # residual pressures
    after_kpa: float  # residual pressures less the mean of a process that does not know them
    expected_kpa: float  # standard deviation of that process

    @property
    def is_better(self) -> bool:
        """Whether the process makes the residuals of held-out poses smaller."""
        return self.after_kpa < self.before_kpa


def fit_held_pressures(
    spec: ArmSpec, spring_m: np.ndarray, measured_kpa: np.ndarray, simulated_kpa: np.ndarray, seed: int = 0
) -> PressureFit:
    """Fit the residual pressures of the unloaded arm.

    Args:
        spec: calibrated arm.
        spring_m (m, n_springs) [m]: lengths at rest, in the order of time. The arm went from each pose to the
            next one.
        measured_kpa (m, n_chambers) [kPa]: pressures that held the arm at these lengths.
        simulated_kpa (m, n_chambers) [kPa]: pressures that hold the simulated arm at these lengths.
        seed: seed that chooses the contiguous blocks of held-out poses.
    """
    # Fit to the poses that are not held out, and judge by the others.
    spring_m, simulated_kpa = np.asarray(spring_m, float), np.asarray(simulated_kpa, float)
    left_kpa = without_redundant_part(np.asarray(measured_kpa, float), spring_m, spec) - simulated_kpa
    stop = np.stack([_stops(spec, spring_m, stroke_m) for stroke_m in _strokes_m(spec)], axis=1)
    rows = spring_m, simulated_kpa, left_kpa, stop
    held_out = held_out_blocks(len(left_kpa), block=HELD_OUT_BLOCK, seed=seed)
    judged = _process(spec, *(x[~held_out] for x in rows))
    predicted = residual(judged, spring_m[held_out], simulated_kpa[held_out])
    before_kpa = left_kpa[held_out]
    known_kpa = hysteresis_kpa(spec, judged, spring_m)[held_out]
    known_kpa = known_kpa + predicted.mean_kpa.reshape(before_kpa.shape)
    variance = predicted.share[..., None] * np.diagonal(judged.covariance_kpa2, axis1=1, axis2=2)
    return PressureFit(
        held=_process(spec, *rows),
        before_kpa=rms_of(before_kpa),
        after_kpa=rms_of(before_kpa - known_kpa),
        expected_kpa=float(np.sqrt(variance.mean())),
    )


def hysteresis_kpa(spec: ArmSpec, held: HeldPressures, spring_m: np.ndarray) -> np.ndarray:
    """Return the chambers' hysteresis (m, n_chambers) [kPa] at springs (m, n_springs) [m] in their order."""
    return spec.at_chambers(tuple(held.hysteresis_kpa)) * _stops(spec, spring_m, held.stroke_m)


def _stops(spec: ArmSpec, spring_m: np.ndarray, stroke_m: np.ndarray) -> np.ndarray:
    """Return the states (m, n_chambers) of hysteresis with strokes (n_sections,) [m]."""
    return stops(spring_m @ chambers_of_springs(spec).T, spec.at_chambers(tuple(stroke_m)))


def _strokes_m(spec: ArmSpec) -> np.ndarray:
    """Return the strokes (k, n_sections) [m] among which the fit chooses."""
    return np.outer(STROKES, spec.per_section(spec.geometry.section_length_m))


def _process(
    spec: ArmSpec, spring_m: np.ndarray, pressure_kpa: np.ndarray, left_kpa: np.ndarray, stop: np.ndarray
) -> HeldPressures:
    """Return the process given residuals (m, n_chambers) and states (m, k, n_chambers) of their hysteresis.

    At most `MAX_ROWS` poses take part, evenly spread.
    """
    # Rows of the sections
    chosen = np.linspace(0, len(spring_m) - 1, min(len(spring_m), MAX_ROWS)).round().astype(int)
    n_sections = spec.structure.n_sections
    state = sections_of(spring_m[chosen], pressure_kpa[chosen], n_sections)
    centre, scale = state.mean(axis=0), np.maximum(state.std(axis=0), LEAST_SCALE)
    state, left_kpa = (state - centre) / scale, left_kpa[chosen].reshape(len(chosen), n_sections, -1)
    stop = stop[chosen].reshape(len(chosen), len(STROKES), n_sections, -1)
    # Hysteresis, beside a process that is fitted without it: one stroke for all sections
    fits = [_hysteresis(state[:, s], left_kpa[:, s], stop[:, :, s]) for s in range(n_sections)]
    best = int(np.argmax(np.sum([likelier for _, likelier in fits], axis=0)))
    most_kpa = np.array([kpa[best] for kpa, _ in fits])
    left_kpa = left_kpa - most_kpa[:, None] * stop[:, best]
    # The process of what it leaves
    each = [_most_likely(state[:, s], left_kpa[:, s]) for s in range(n_sections)]
    length, noise, covariance = (np.array(x) for x in zip(*each, strict=True))
    fitted = length, noise, covariance, most_kpa, _strokes_m(spec)[best]
    return HeldPressures(state, centre, scale, left_kpa, *fitted)


def _hysteresis(state: np.ndarray, left_kpa: np.ndarray, stop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pressure (k,) [kPa] of a section's hysteresis, and by how much it is likelier (k,).

    Rows are standardised states (n, d), residual pressures (n, c), and states (n, k, c) with k strokes.
    """
    length, noise, covariance = _most_likely(state, left_kpa)
    inverse = np.linalg.inv(kernel(state, state, length) + noise * np.eye(len(state)))
    weighted = np.einsum("nm,mkj,ij->nki", inverse, stop, np.linalg.inv(covariance))
    information = np.einsum("nki,nki->k", weighted, stop)
    kpa = np.maximum(np.einsum("nki,ni->k", weighted, left_kpa) / np.maximum(information, TINY), 0.0)
    return kpa, 0.5 * information * kpa**2


def _most_likely(state: np.ndarray, left_kpa: np.ndarray) -> Hyperparameters:
    """Return the hyperparameters that make a section's residuals (n, c) most likely."""
    return most_likely(left_kpa, lambda length: kernel(state, state, length), LENGTHS, NOISES, LEAST_KPA**2)


def without_redundant_part(pressure_kpa: np.ndarray, spring_m: np.ndarray, spec: ArmSpec) -> np.ndarray:
    """Return the pressures (m, n_chambers) that push alike and that the sensor-space law would hold.

    The law holds no pressure that neither stretches nor bends a section, and poses of a log may.
    """
    matrices = allocation(spec)
    if matrices is None:
        return pressure_kpa
    # The same forces and moments by pressures in the planes
    plane, area = np.eye(spec.n_chambers) - matrices.redundant, effective_area_m2(spec, spring_m)
    push = plane @ (area * pressure_kpa)[..., None]
    return (np.linalg.pinv(plane @ (area[..., None] * plane)) @ push)[..., 0]


def effective_area_m2(spec: ArmSpec, spring_m: np.ndarray) -> np.ndarray:
    """Return the effective areas (m, n_chambers) [m^2] of chambers at spring lengths (m, n_springs) [m].

    The chambers' lengths lie in the plane through their section's springs.
    """
    stretched_m = spring_m @ chambers_of_springs(spec).T - spec.at_chambers(spec.geometry.section_length_m)
    chambers = spec.chambers
    return spec.per_chamber(chambers.area_m2) + stretched_m * spec.per_chamber(chambers.area_slope_m)
