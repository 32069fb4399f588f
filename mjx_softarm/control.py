"""Sensor-space law: spring lengths and their references -> chamber pressures.

Training, twin and deployed arm share it. With three chambers a section and a spring beside each, a chamber
regulates its own spring; a spring shorter than its reference gets more pressure:

    r'  = r + (reference - r) dt / (reference_s + dt)     reference on its way
    l'  = l + (length - l) / 2                            smoothed length
    e   = r' - length
    i'  = clip(i + ki e dt, p_min, p_max)                 integral, in kPa
    p   = clip(i' + kp e - kd (l' - l) / dt, p_min, p_max)

A new reference is approached about as fast as the pump can fill the chambers: a jump would wind up the
integral. The length's rate damps the arm's swing; it is smoothed over about two ticks of 50 Hz. The integral
is clamped to the pressure limits, so a chamber leaves its limit in the tick in which the error changes sign.

At rest (r' = reference, l' = length, i' = i) p = i, and each chamber is in one of three states:

    p_min <= p <= p_max and e = 0    it tracks its reference
    p = p_max           and e > 0    it can push no further
    p = p_min           and e < 0    it can pull no further

This rest depends on neither gains nor times. `mjx_softarm.mechanics.settle` solves for it.

**More chambers.** A section lengthens and bends in two directions. More than three chambers are redundant.
A plane through the errors of a section's springs gives each chamber its error, C (r' - length). The part N i
of the integral neither lengthens nor bends a section. With C and N from `Allocation`,

    e   = C (r' - length) - YIELD_M_PER_KPA N i,    and C (l' - l) in place of l' - l.

C and N have orthogonal ranges. Where no chamber is at a limit, both parts of e are zero at rest: the springs
follow a plane through their references, and no pressure is spent on what neither lengthens nor bends the
section. Where a chamber is at a limit, the others follow the references with redundant pressure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.spec import LEAST_CHAMBERS, ArmSpec

AT_LIMIT_KPA = 0.2  # distance to a limit at which a measured, noisy pressure counts as at it
TOLERANCE_M = 1e-3  # greatest error of a spring that counts as on its reference
YIELD_M_PER_KPA = 1e-4  # length error that a chamber accepts for 1 kPa of redundant pressure less


class Allocation(NamedTuple):
    """Matrices between springs and chambers of an arm with more than three chambers a section."""

    chamber_error: Array  # (n_chambers, n_springs) C, plane through the springs of a section, at its chambers
    redundant: Array  # (n_chambers, n_chambers) N, projection to pressures that neither lengthen nor bend


def allocation(spec: ArmSpec) -> Allocation | None:
    """Return the matrices of an arm in float64; None where each section has three chambers.

    With A of `planes`, C = A_chambers pinv(A_springs) and N = 1 - A_chambers pinv(A_chambers).
    """
    n = spec.structure.chambers_per_section
    if n == LEAST_CHAMBERS:
        return None
    chambers, springs = planes(n), planes(spec.springs_per_section)
    section = chambers @ np.linalg.pinv(springs), np.eye(n) - chambers @ np.linalg.pinv(chambers)
    return Allocation(*(np.kron(np.eye(spec.structure.n_sections), matrix) for matrix in section))


def planes(n: int, radius: float = 1.0) -> np.ndarray:
    """Return a section's matrix A (n, 3): [1, x, y] for the place of each chamber, or of each spring.

    The places are those of a section whose first chamber is on x; turning it changes neither C nor N.
    """
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([np.ones(n), radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def chambers_of_springs(spec: ArmSpec) -> np.ndarray:
    """Return the matrix (n_chambers, n_springs) from lengths of springs to lengths of chambers.

    A chamber's length is that of the plane through its section's springs, at the chamber's own radius.
    """
    c, s = spec.structure.chambers_per_section, spec.springs_per_section
    matrix = np.zeros((spec.structure.n_sections, c, spec.structure.n_sections, s))
    radii = map(spec.per_section, (spec.geometry.chamber_radius_m, spec.geometry.spring_radius_m))
    for section, (chamber, spring) in enumerate(zip(*radii, strict=True)):
        matrix[section, :, section] = planes(c, chamber) @ np.linalg.pinv(planes(s, spring))
    return matrix.reshape(spec.n_chambers, spec.n_springs)


class Gains(NamedTuple):
    """Gains and limits of the law; each is () or (n_chambers,)."""

    kp_kpa_per_m: Array
    ki_kpa_per_ms: Array  # kPa per metre and second
    kd_kpa_s_per_m: Array  # kPa per metre per second
    reference_s: Array  # time constant with which a new reference is approached
    pressure_min_kpa: Array
    pressure_max_kpa: Array
    allocation: Allocation | None = None  # None: each chamber regulates its own spring

    @classmethod
    def from_spec(cls, spec: ArmSpec) -> Gains:
        limits_kpa = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
        law = spec.control
        gains = law.kp_kpa_per_m, law.ki_kpa_per_ms, law.kd_kpa_s_per_m, law.reference_s
        return cls(*gains, *limits_kpa, allocation(spec))

    def measured(self) -> Gains:
        """Return the gains with limits tighter by AT_LIMIT_KPA, for measured pressures."""
        low, high = self.pressure_min_kpa + AT_LIMIT_KPA, self.pressure_max_kpa - AT_LIMIT_KPA
        return self._replace(pressure_min_kpa=low, pressure_max_kpa=high)


class LawState(NamedTuple):
    """Memory of the law between two ticks."""

    integral_kpa: Array  # (..., n_chambers) at rest, the pressures
    reference_m: Array  # (..., n_springs) on its way to the reference
    length_m: Array  # (..., n_springs) smoothed

    @classmethod
    def at_rest(cls, pressure_kpa: Array, length_m: Array) -> LawState:
        """Return the memory of a law that holds an arm at these pressures and lengths."""
        return cls(pressure_kpa, length_m, length_m)


def pressures(
    reference_m: Array, length_m: Array, state: LawState, gains: Gains, dt_s: float
) -> tuple[Array, LawState]:
    """Compute one tick of the law: pressures (..., n_chambers) [kPa] within the limits, and the next state.

    Args:
        reference_m (..., n_springs) [m]: spring lengths to reach.
        length_m (..., n_springs) [m]: spring lengths read, finite.
        state: after the last tick.
        gains: numbers of the law.
        dt_s: time since the last tick.
    """
    # Reference on its way, smoothed length
    xp = array_namespace(reference_m, length_m, *state, *gains[:-1])
    low, high = gains.pressure_min_kpa, gains.pressure_max_kpa
    on_its_way_m = state.reference_m + (reference_m - state.reference_m) * (dt_s / (gains.reference_s + dt_s))
    smooth_m = 0.5 * (state.length_m + length_m)

    # Error and rate at each chamber
    error_m = allocated_error(on_its_way_m - length_m, state.integral_kpa, gains.allocation)
    change_m = at_chambers(smooth_m - state.length_m, gains.allocation)

    # Integral and pressure, within the limits
    integral_kpa = xp.clip(state.integral_kpa + gains.ki_kpa_per_ms * dt_s * error_m, low, high)
    damping_kpa = gains.kd_kpa_s_per_m / dt_s * change_m
    pressure_kpa = xp.clip(integral_kpa + gains.kp_kpa_per_m * error_m - damping_kpa, low, high)
    return pressure_kpa, LawState(integral_kpa, on_its_way_m, smooth_m)


def at_chambers(error_m: Array, allocation: Allocation | None) -> Array:
    """Return errors (..., n_chambers) [m] at the chambers from those of the springs (..., n_springs)."""
    return error_m if allocation is None else _times(allocation.chamber_error, error_m)


def allocated_error(error_m: Array, pressure_kpa: Array, allocation: Allocation | None) -> Array:
    """Return the error (..., n_chambers) [m] that each chamber closes.

    Without an allocation it is that of its spring. Errors of the springs (..., n_springs) [m] are references
    less lengths. The redundant part of the pressures (..., n_chambers) [kPa] is an error as well.
    """
    if allocation is None:
        return error_m
    redundant_kpa = _times(allocation.redundant, pressure_kpa)
    return at_chambers(error_m, allocation) - YIELD_M_PER_KPA * redundant_kpa


def _times(matrix: Array, vector: Array) -> Array:
    """Multiply a matrix (n, m) by vectors (..., m), in their precision."""
    xp = array_namespace(matrix, vector)
    return xp.sum(xp.asarray(matrix, dtype=vector.dtype) * vector[..., None, :], axis=-1)


def saturated(
    pressure_kpa: Array, reference_m: Array, length_m: Array, gains: Gains, tolerance_m: float
) -> Array:
    """Return which chambers (..., n_chambers) cannot reach their reference: bool.

    A chamber is saturated if it is at its greatest pressure with its spring too short, or at its least
    pressure with its spring too long, by more than the tolerance.

    Args:
        pressure_kpa (..., n_chambers): pressures of the law.
        reference_m, length_m (..., n_springs): references and lengths of the springs.
        gains: limits, and how redundant chambers share the springs' errors.
        tolerance_m: error of a spring that does not count.
    """
    error_m = allocated_error(reference_m - length_m, pressure_kpa, gains.allocation)
    short = (pressure_kpa >= gains.pressure_max_kpa) & (error_m > tolerance_m)
    long = (pressure_kpa <= gains.pressure_min_kpa) & (error_m < -tolerance_m)
    return short | long


def blocked_springs(saturated: Array, gains: Gains) -> Array:
    """Return which springs (..., n_springs) are kept off by saturated chambers (..., n_chambers): bool.

    They are the chambers' own springs, or those whose errors redundant chambers share.
    """
    if gains.allocation is None:
        return saturated
    shared = abs(gains.allocation.chamber_error.T) > 1e-9  # (n_springs, n_chambers)
    return (shared & saturated[..., None, :]).any(axis=-1)
