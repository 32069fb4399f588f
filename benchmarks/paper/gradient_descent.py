"""Gradient descent on the springs, by the estimated pose: the solver that the policy is compared with.

A degree weighs as much as a millimetre: with the reward's weights, the search takes far longer to turn the
tip. It knows no pressures, so it may ask for shapes that the pump cannot make.

Source: the solver of Meng et al. 2023 as the paper describes it where it states the problem of saturation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from mjx_softarm.policy.file import Policy
from mjx_softarm.sensing.estimator import estimate
from mjx_softarm.sensing.pose import pose_error
from mjx_softarm.sensing.s2r import correct

MAX_STEPS = 200
FIRST_STEP = 1e-8  # [(m / mm)^2]; each accepted step is followed by one of twice its size
LEAST_STEP = 1e-15
SUFFICIENT = 1e-4  # share of the decrease that the gradient promises; Armijo's condition
CLOSE = 0.05  # [mm, deg] error that counts as none
DIFFERENCE_M = 1e-5

Residual = Callable[[np.ndarray], np.ndarray]  # springs (..., n) [m] -> error (..., 6) [mm, deg]


def gradient_descent(policy: Policy) -> Callable[..., np.ndarray]:
    """Return a plan for `Controller.of` that replaces the policy's actor."""
    low_m, high_m = policy.sensor.lengths(np.stack(policy.actions[1:])).length_m  # (n,) each
    pose_of = forward_kinematics(policy)

    def plan(_pose: Any, goal: np.ndarray, spring_m: np.ndarray, _sensed: Any) -> np.ndarray:
        return descend(lambda x: pose_error(pose_of(x), goal), spring_m, low_m, high_m)

    return plan


def forward_kinematics(policy: Policy) -> Callable[[np.ndarray], np.ndarray]:
    """Return the map of springs (..., n) [m] to poses (..., 6) [mm, deg] of the specified arm, in float64."""
    networks = policy.estimator, policy.s2r
    estimator, s2r = jax.tree.map(lambda x: np.asarray(x, np.float64), networks)

    def pose_of(spring_m: np.ndarray) -> np.ndarray:
        pose = estimate(estimator, spring_m, policy.spec.mass.payload_kg)
        return pose if s2r is None else correct(s2r, pose, spring_m)

    return pose_of


def descend(residual: Residual, spring_m: np.ndarray, low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
    """Return springs (n,) [m] within limits (n,) [m] that locally minimise the squared residual."""
    x = np.clip(np.asarray(spring_m, float), low_m, high_m)
    cost, step = _cost(residual, x), FIRST_STEP
    for _ in range(MAX_STEPS):
        if cost < 0.5 * CLOSE**2:
            break
        slope = gradient(residual, x)
        trial, trial_cost = x, np.inf
        while step > LEAST_STEP:
            trial = np.clip(x - step * slope, low_m, high_m)
            trial_cost = _cost(residual, trial)
            if trial_cost <= cost - SUFFICIENT * slope @ (x - trial):
                break
            step *= 0.5
        if step <= LEAST_STEP or np.array_equal(trial, x):
            break
        x, cost, step = trial, trial_cost, 2.0 * step
    return x


def gradient(residual: Residual, spring_m: np.ndarray) -> np.ndarray:
    """Return the gradient (n,) [1/m] of half the squared residual, by central differences."""
    offset_m = DIFFERENCE_M * np.eye(len(spring_m))
    ahead, behind = residual(spring_m + offset_m), residual(spring_m - offset_m)  # (n, 6) each
    return (ahead - behind) @ residual(spring_m) / (2.0 * DIFFERENCE_M)


def _cost(residual: Residual, x: np.ndarray) -> float:
    return 0.5 * float(np.sum(residual(x) ** 2))
