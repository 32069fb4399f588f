"""Sensor-space law: spring lengths and their references -> chamber pressures.

Training, twin and deployed arm share it. Each chamber regulates its own spring; a spring shorter than its
reference gets more pressure:

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
"""

from __future__ import annotations

from typing import NamedTuple

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.spec import ArmSpec

AT_LIMIT_KPA = 0.2  # distance to a limit at which a measured, noisy pressure counts as at it
TOLERANCE_M = 1e-3  # greatest error of a spring that counts as on its reference; a run may set another


class Gains(NamedTuple):
    """Gains and limits of the law; each is () or (n,)."""

    kp_kpa_per_m: Array
    ki_kpa_per_ms: Array  # kPa per metre and second
    kd_kpa_s_per_m: Array  # kPa per metre per second
    reference_s: Array  # time constant with which a new reference is approached
    pressure_min_kpa: Array
    pressure_max_kpa: Array

    @classmethod
    def from_spec(cls, spec: ArmSpec) -> Gains:
        limits_kpa = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
        law = spec.control
        return cls(law.kp_kpa_per_m, law.ki_kpa_per_ms, law.kd_kpa_s_per_m, law.reference_s, *limits_kpa)

    def measured(self) -> Gains:
        """Return the gains with limits tighter by AT_LIMIT_KPA, for measured pressures."""
        low, high = self.pressure_min_kpa + AT_LIMIT_KPA, self.pressure_max_kpa - AT_LIMIT_KPA
        return self._replace(pressure_min_kpa=low, pressure_max_kpa=high)


class LawState(NamedTuple):
    """Memory of the law between two ticks."""

    integral_kpa: Array  # (..., n) at rest, the pressures
    reference_m: Array  # (..., n) on its way to the reference
    length_m: Array  # (..., n) smoothed

    @classmethod
    def at_rest(cls, pressure_kpa: Array, length_m: Array) -> LawState:
        """Return the memory of a law that holds spring lengths (..., n) [m] at pressures (..., n) [kPa]."""
        return cls(pressure_kpa, length_m, length_m)


def pressures(
    reference_m: Array, length_m: Array, state: LawState, gains: Gains, dt_s: float
) -> tuple[Array, LawState]:
    """Compute one tick of the law.

    Args:
        reference_m (..., n) [m]: spring lengths to reach.
        length_m (..., n) [m]: spring lengths read, finite.
        state: after the last tick.
        gains: numbers of the law.
        dt_s: time since the last tick.

    Returns:
        Pressures (..., n) [kPa] within the limits, and the next state.
    """
    # Reference on its way, smoothed length
    xp = array_namespace(reference_m, length_m, *state, *gains)
    low, high = gains.pressure_min_kpa, gains.pressure_max_kpa
    on_its_way_m = state.reference_m + (reference_m - state.reference_m) * (dt_s / (gains.reference_s + dt_s))
    smooth_m = 0.5 * (state.length_m + length_m)

    # Integral and pressure, within the limits
    error_m = on_its_way_m - length_m
    integral_kpa = xp.clip(state.integral_kpa + gains.ki_kpa_per_ms * dt_s * error_m, low, high)
    damping_kpa = gains.kd_kpa_s_per_m / dt_s * (smooth_m - state.length_m)
    pressure_kpa = xp.clip(integral_kpa + gains.kp_kpa_per_m * error_m - damping_kpa, low, high)
    return pressure_kpa, LawState(integral_kpa, on_its_way_m, smooth_m)


def saturated(
    pressure_kpa: Array, reference_m: Array, length_m: Array, gains: Gains, tolerance_m: float
) -> Array:
    """Return which chambers (..., n) cannot reach their reference: bool.

    A chamber is saturated if it is at its greatest pressure with its spring too short, or at its least
    pressure with its spring too long, by more than the tolerance.

    Args:
        pressure_kpa (..., n) [kPa]: as `pressures` gives them.
        reference_m (..., n) [m]: spring lengths to reach.
        length_m (..., n) [m]: spring lengths read.
        gains: numbers of the law.
        tolerance_m: greatest error of a spring that counts as on its reference.
    """
    error_m = reference_m - length_m
    short = (pressure_kpa >= gains.pressure_max_kpa) & (error_m > tolerance_m)
    long = (pressure_kpa <= gains.pressure_min_kpa) & (error_m < -tolerance_m)
    return short | long
