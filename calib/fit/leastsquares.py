"""Robust least squares with intervals: a damped Gauss-Newton method with Huber's weights.

The model gives errors and their Jacobian, from wherever; the small dense algebra is done in double precision.
Scales of the errors are found along the way, one for each group of columns, so that what fits worse weighs
less. A weak prior keeps what the data do not tell at the start.

Source: Huber, "Robust Estimation of a Location Parameter", Ann. Math. Statist. 35 (1964); intervals: White,
"A Heteroskedasticity-Consistent Covariance Matrix Estimator", Econometrica 48 (1980), a row being a cluster.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

ROUNDS = 3  # the first with the scales that were given, the others with those of the errors left
MAX_ITERATIONS = 12  # of each round
SMALL_STEP = 1e-3  # of the prior's width
HUBER = 2.0  # scales
NO_ANSWER = 30.0  # scales of error that a row counts for which the model has no answer
SIGMA_PER_MEDIAN = 1.4826  # of the absolute value of a normal variable
QUANTILE = 1.96  # of 95 % intervals

# x (p,) -> errors (n, m), NaN where nothing was measured, inf in rows without an answer; Jacobian (n, m, p)
Model = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Problem:
    """What is known before the errors are looked at."""

    prior: np.ndarray  # (p,) standard deviations about the start, x = 0
    group: np.ndarray  # (m,) of each column of errors, counted from 0
    scale: np.ndarray  # (n_groups,) first guess of the errors' standard deviations
    min_scale: np.ndarray  # (n_groups,)


class Solution(NamedTuple):
    """Where the fit ended."""

    x: np.ndarray  # (p,)
    covariance: np.ndarray  # (p, p)
    scale: np.ndarray  # (n_groups,) of the errors
    n_evaluations: int
    converged: bool

    @property
    def half_width(self) -> np.ndarray:
        """Of the 95 % interval of each number (p,)."""
        return QUANTILE * np.sqrt(np.diag(self.covariance))


class _Weighted(NamedTuple):
    """Errors over their scales times the roots of Huber's weights, zero where not known; slopes alike."""

    cost: float
    error: np.ndarray  # (n, m)
    slope: np.ndarray  # (n, m, p)

    @property
    def information(self) -> np.ndarray:
        """Without the prior (p, p)."""
        flat = self.slope.reshape(-1, self.slope.shape[-1])
        return flat.T @ flat


def fit(model: Model, problem: Problem) -> Solution:
    """Minimise Huber's loss of the errors over their scales, started from x = 0."""
    x, scale = np.zeros(len(problem.prior)), problem.scale
    error, jacobian = model(x)
    n_evaluations, converged = 1, False
    for _ in range(ROUNDS):
        damping, converged = 1e-3, False
        for _ in range(MAX_ITERATIONS):
            now = _weigh(error, jacobian, scale, problem)
            hessian = now.information + np.diag(problem.prior**-2.0)
            slope = np.einsum("nmp,nm->p", now.slope, now.error) + x / problem.prior**2
            step = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), slope)
            tried = model(x + step)
            n_evaluations += 1
            cost = _weigh(*tried, scale, problem).cost + 0.5 * np.sum(((x + step) / problem.prior) ** 2)
            if cost <= now.cost + 0.5 * np.sum((x / problem.prior) ** 2):
                x, (error, jacobian), damping = x + step, tried, 0.1 * damping
            else:
                damping *= 10.0
            if np.abs(step / problem.prior).max() < SMALL_STEP:  # small by damping alone is no end
                converged = bool(np.abs(np.linalg.solve(hessian, slope) / problem.prior).max() < SMALL_STEP)
                break
        scale = _scales(error, problem)
    covariance = _covariance(_weigh(error, jacobian, scale, problem), problem)
    return Solution(x, covariance, scale, n_evaluations, converged)


def principal(solution: Solution, tolerance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions of x from the least known to the best known.

    Args:
        solution: of a fit.
        tolerance (p,): within which each number counts as known.

    Returns:
        Half-widths (p,) of the 95 % intervals in units of the tolerance; directions (p, p) in its columns.
    """
    values, vectors = np.linalg.eigh(solution.covariance / np.outer(tolerance, tolerance))
    return QUANTILE * np.sqrt(np.maximum(values[::-1], 0.0)), vectors[:, ::-1]


def _weigh(error: np.ndarray, jacobian: np.ndarray, scale: np.ndarray, problem: Problem) -> _Weighted:
    sigma = scale[problem.group]
    answered = ~np.any(np.isinf(error), axis=1)
    known = np.isfinite(error) & answered[:, None]
    e = np.where(known, error, 0.0) / sigma
    slope = np.where(known[..., None], jacobian, 0.0) / sigma[:, None]
    size = np.abs(e)
    weight = np.minimum(1.0, HUBER / np.maximum(size, HUBER))
    loss = np.where(size <= HUBER, 0.5 * e**2, HUBER * (size - 0.5 * HUBER))
    missing = np.count_nonzero(~answered) * len(sigma) * HUBER * (NO_ANSWER - 0.5 * HUBER)
    root = np.sqrt(weight)
    return _Weighted(float(loss.sum() + missing), root * e, root[..., None] * slope)


def _covariance(end: _Weighted, problem: Problem) -> np.ndarray:
    """Sandwich of the rows' scores; each row's errors as if the fit had been made without it."""
    precision = np.diag(problem.prior**-2.0)
    inverse = np.linalg.inv(end.information + precision)
    leverage = end.slope @ inverse @ np.swapaxes(end.slope, 1, 2)  # (n, m, m)
    left = np.linalg.solve(np.eye(leverage.shape[1]) - leverage, end.error[..., None])
    score = (np.swapaxes(end.slope, 1, 2) @ left)[..., 0]
    return inverse @ (score.T @ score + precision) @ inverse


def _scales(error: np.ndarray, problem: Problem) -> np.ndarray:
    found = problem.scale.copy()
    for k in range(len(found)):
        of_group = error[:, problem.group == k]
        of_group = of_group[np.isfinite(of_group)]
        if len(of_group):
            found[k] = max(SIGMA_PER_MEDIAN * np.median(np.abs(of_group)), problem.min_scale[k])
    return found
