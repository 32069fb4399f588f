"""The sensor-space law: spring lengths and their references -> chamber pressures.

One law for training, twin and deployed arm. Each chamber has a PI law on its own spring. A spring shorter
than its reference asks for more pressure:

    e   = reference - length
    i'  = clip(i + ki e dt, p_min, p_max)        integral, in kPa
    p   = clip(i' + kp e, p_min, p_max)

The integral is clamped to the pressures there are, so it never winds up: however long a chamber has
been at its limit, it leaves it in the very tick in which the error changes sign.

At rest (i' = i, constant e) each chamber is in one of three states, in each of which p = i:

    p_min <= p <= p_max and e = 0    it tracks its reference
    p = p_max           and e > 0    it can push no further
    p = p_min           and e < 0    it can pull no further

Neither kp nor ki nor dt is in there: they say how the arm comes to rest, not where.
`mjx_softarm.mechanics.settle` solves for exactly this rest.

There is no derivative term: a rate from readings at 50 Hz is mostly noise, and the arm's own damping
already slows it.
"""

from __future__ import annotations

from typing import NamedTuple

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.spec import ArmSpec

AT_LIMIT_KPA = 0.2  # distance to a limit at which a measured, noisy pressure counts as at it
TOLERANCE_M = 1e-3  # greatest error of a spring that counts as on its reference, unless a run says otherwise


class Gains(NamedTuple):
    """Numbers of the law; each is () or (n,)."""

    kp_kpa_per_m: Array
    ki_kpa_per_ms: Array  # kPa per metre and second
    pressure_min_kpa: Array
    pressure_max_kpa: Array

    @classmethod
    def from_spec(cls, spec: ArmSpec) -> Gains:
        limits_kpa = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
        return cls(spec.control.kp_kpa_per_m, spec.control.ki_kpa_per_ms, *limits_kpa)

    def measured(self) -> Gains:
        """Return the gains with limits AT_LIMIT_KPA within their own, for pressures that were measured."""
        low, high = self.pressure_min_kpa + AT_LIMIT_KPA, self.pressure_max_kpa - AT_LIMIT_KPA
        return self._replace(pressure_min_kpa=low, pressure_max_kpa=high)


def pressures(
    reference_m: Array, length_m: Array, integral_kpa: Array, gains: Gains, dt_s: float
) -> tuple[Array, Array]:
    """Compute one tick of the law.

    Args:
        reference_m (..., n) [m]: spring lengths to reach.
        length_m (..., n) [m]: spring lengths read, finite.
        integral_kpa (..., n) [kPa]: the law's state; the pressures at which it starts, or zeros.
        gains: numbers of the law.
        dt_s: time since the last tick.

    Returns:
        Pressures (..., n) [kPa] within the limits, and the next integral (..., n) [kPa].
    """
    xp = array_namespace(reference_m, length_m, integral_kpa, *gains)
    low, high = gains.pressure_min_kpa, gains.pressure_max_kpa
    error_m = reference_m - length_m
    next_integral_kpa = xp.clip(integral_kpa + gains.ki_kpa_per_ms * dt_s * error_m, low, high)
    return xp.clip(next_integral_kpa + gains.kp_kpa_per_m * error_m, low, high), next_integral_kpa


def saturated(
    pressure_kpa: Array, reference_m: Array, length_m: Array, gains: Gains, tolerance_m: float
) -> Array:
    """Return which chambers (..., n) cannot reach their reference: bool.

    A chamber is saturated at its greatest pressure with its spring too short, or at its least pressure with
    its spring too long, by more than the tolerance. At a limit but on its reference, it is not.

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
