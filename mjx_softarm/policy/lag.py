"""Lags of a moving arm: springs behind their references, the shape behind the springs. NumPy only."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from mjx_softarm.control import Gains
from mjx_softarm.policy.file import Policy
from mjx_softarm.sensing.estimator import Frame, estimate, even_pose, expected_springs
from mjx_softarm.sensing.pose import pose_error

# Change of a pressure from which the springs' response is taken, in ranges of pressure. The slope of a
# network differs by a third from place to place. Circle in 20 s, mean errors on a twin and two rods: 1.7, 1.9
# and 3.4 mm with 0.05; 1.5, 1.4 and 1.8 mm with this; 1.5, 1.3 and 2.4 mm with one response for all places.
_STEP = 0.4
_LEAST_MODE = 1e-3  # response of a mode, in that of the largest, below which chambers do not move it


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
        gains: numbers of the law.
        springs: from pressures (2, n_chambers, n_chambers) [kPa] to lengths (2, n_chambers, n_springs) [m].
        pressure_kpa (n_chambers,) [kPa]: pressures, around which G is taken, also beyond the limits.
    """
    low, high = (np.broadcast_to(np.asarray(x, float), len(pressure_kpa)) for x in gains[4:6])
    step_kpa = _STEP * (high - low)
    either = pressure_kpa + np.stack([1.0, -1.0])[:, None, None] * np.diag(step_kpa)
    longer_m, shorter_m = springs(either)
    change = (longer_m - shorter_m).T / (2.0 * step_kpa)  # (n_springs, n_chambers) [m/kPa]
    if gains.allocation is not None:
        change = change @ gains.allocation.chamber_error
    return np.linalg.pinv(change * gains.ki_kpa_per_ms, rcond=_LEAST_MODE)


class ShapeLag(NamedTuple):
    """Memory of how unevenly the sections of a moving arm bend.

    The pose at rest with some springs differs from that of sections that bend evenly. In motion this
    difference lags behind the springs, see `calib.fit.motion.shape`. Both poses are the simulation's: the
    sim-to-real network's correction does not lag.
    """

    uneven: np.ndarray | None = None  # (6,) [mm, deg] difference that lags; None before the first lengths

    def after(
        self, policy: Policy, spring_m: np.ndarray, load_kg: float, dt_s: float
    ) -> tuple[ShapeLag, np.ndarray]:
        """Return the memory a time dt_s later, and the pose (6,) [mm, deg] at rest minus that in motion.

        Args:
            policy: the arm.
            spring_m (n_springs,) [m]: spring lengths then.
            load_kg: payload.
            dt_s: time since the last lengths.
        """
        # Difference at rest
        own = policy.estimator
        base, pose = Frame(own.base_position_m, own.base_rotation), estimate(own, spring_m, load_kg)
        uneven = pose_error(np.asarray(pose, float), even_pose(base, own.spring_site_m, spring_m))
        # The arm begins at rest
        if self.uneven is None:
            return ShapeLag(uneven), np.zeros(6)
        lag_s = policy.spec.shape_lag_s
        now = self.uneven + dt_s / (lag_s + dt_s) * pose_error(uneven, self.uneven)
        return ShapeLag(now), pose_error(uneven, now)
