"""Lags of an arm's springs behind their references, and the rule by which they are at rest.

NumPy only; `still` takes the symbols of `mjx_softarm.export`, too.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.control import Gains
from mjx_softarm.policy.file import Policy
from mjx_softarm.sensing.estimator import expected_springs
from mjx_softarm.spec import ArmSpec

# Change of a pressure from which the springs' response is taken, in ranges of pressure. The slope of a
# network differs by a third from place to place. Circle in 20 s, mean errors on a twin and two rods: 1.7, 1.9
# and 3.4 mm with 0.05; 1.5, 1.4 and 1.8 mm with this; 1.5, 1.3 and 2.4 mm with one response for all places.
_STEP = 0.4
_LEAST_MODE = 1e-3  # response of a mode, in that of the largest, below which chambers do not move it

# Rest. A twin is within 2 mm of its rest 4 s after an action, and creeps for some seconds more.
WINDOW_S = 0.5  # least time over which springs are watched; by hand
# Window of an arm with a slow law, in the largest lag of its springs. With 0.9, `sopra` takes 16 s for a goal
# instead of 4 without both this and `STILL_M` in proportion, and underestimates its errors by 1.7 mm.
WINDOW_SHARE = 0.5
SETTLE_TIMEOUT_S = 15.0  # longest wait for rest; by hand, well above the 4 s of a twin
# Largest difference of the two half windows' means, of springs 67 mm from the axis; in proportion for others,
# whose change bends a section more. 10 times such a mean's noise.
STILL_M = 2e-4
# Largest error of a spring, in the mean of the window, that counts as on its reference; in proportion. With
# 1 mm, at which chambers count as saturated, 0.3 mm were left on the way, and stops of policies of motion
# were 2.5 mm off instead of 1.5.
ARRIVED_M = 2.5e-4
_RADIUS_M = 0.067  # distance of springs from the axis for which `STILL_M` and `ARRIVED_M` were chosen


def spring_lag_s(policy: Policy, pressure_kpa: np.ndarray) -> np.ndarray:
    """Return `law_lag_s` by a policy's own model of the springs."""
    return law_lag_s(policy.gains, partial(expected_springs, policy.spring_model), pressure_kpa)


def law_lag_s(
    gains: Gains, springs: Callable[[np.ndarray], np.ndarray], pressure_kpa: np.ndarray
) -> np.ndarray:
    """Return the matrix (n_springs, n_springs) [s] A of lags of the springs under the law.

    The law's integral changes by i' = ki C e, and moves the springs by G i', with G the change of lengths
    with pressures, and C the law's allocation. So springs that move steadily with a rate x' are A x' behind
    the law's reference, A = pinv(ki G C). Dead time and lag of the actuators do not matter: the integral has
    moved on by them. Modes that chambers do not move have no lag.

    Args:
        springs: from pressures (2, n_chambers, n_chambers) [kPa] to lengths (2, n_chambers, n_springs) [m].
        pressure_kpa (n_chambers,) [kPa]: pressures, around which G is taken, also beyond the limits.
    """
    range_kpa = np.asarray(gains.pressure_max_kpa, float) - np.asarray(gains.pressure_min_kpa, float)
    step_kpa = np.broadcast_to(_STEP * range_kpa, len(pressure_kpa))
    either = pressure_kpa + np.stack([1.0, -1.0])[:, None, None] * np.diag(step_kpa)
    longer_m, shorter_m = springs(either)
    change = (longer_m - shorter_m).T / (2.0 * step_kpa)  # (n_springs, n_chambers) [m/kPa]
    if gains.allocation is not None:
        change = change @ gains.allocation.chamber_error
    return np.linalg.pinv(change * gains.ki_kpa_per_ms, rcond=_LEAST_MODE)


class RestRule(NamedTuple):
    """Numbers by which the springs of an arm are judged to be at rest."""

    window: int  # ticks over which springs are watched
    still_m: float  # `STILL_M` of this arm
    arrived_m: float  # `ARRIVED_M` of this arm


def rest_rule(spec: ArmSpec, lag_s: np.ndarray) -> RestRule:
    """Return the rule of rest of an arm whose springs have lags (n_springs, n_springs) [s]."""
    slowest_s = float(np.abs(np.linalg.eigvals(lag_s)).max())
    window_s = max(WINDOW_S, WINDOW_SHARE * slowest_s)
    radius_m = float(np.mean(spec.per_section(spec.geometry.spring_radius_m)))
    share = radius_m / _RADIUS_M
    return RestRule(max(2, round(window_s * spec.control.rate_hz)), share * STILL_M, share * ARRIVED_M)


def middle_kpa(gains: Gains, n_chambers: int) -> np.ndarray:
    """Return the pressures (n_chambers,) [kPa] in the middle of their range."""
    return np.broadcast_to(0.5 * (gains.pressure_min_kpa + gains.pressure_max_kpa), n_chambers)


def still(spring_m: Array, still_m: float = STILL_M) -> Array:
    """Return whether springs came to rest over a window (ticks, n) [m]: its halves have the same mean."""
    xp = array_namespace(spring_m)
    half = len(spring_m) // 2
    moved_m = xp.mean(spring_m[-half:], axis=0) - xp.mean(spring_m[:half], axis=0)  # (n,)
    return xp.all(xp.abs(moved_m) < still_m)
