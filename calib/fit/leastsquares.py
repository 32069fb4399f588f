"""Robust least squares with intervals, on `scipy.optimize.least_squares` with Huber's loss.

The model returns errors and their Jacobian. Each group of errors has a scale, estimated between rounds of the
fit, so that a group that fits worse weighs less. A weak prior keeps parameters that the data do not determine
at the start. The covariance is a sandwich whose clusters are the rows of errors: it adds up the changes of
the parameters when one row is left out (jackknife, one Newton step).

Source: Huber, "Robust Estimation of a Location Parameter", Ann. Math. Statist. 35 (1964), and "Robust
Statistics" (1981), section 7; clusters: Bell and McCaffrey, Survey Methodology 28 (2002).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.sensing.load import QUANTILE

NOT_CONVERGED = "the fit did not converge: start from a specification closer to the arm (--spec)"
ROUNDS = ("linear", "huber", "huber")  # losses; the first round has the given scales
# End of a round. Single precision allows no smaller changes; SciPy's third test depends on the units of x.
TOLERANCES: dict[str, Any] = {"max_nfev": 15, "ftol": 1e-6, "xtol": 1e-4, "gtol": None}
NEWTON_STEPS = 5  # at most, after the rounds, as each round has the scales of the round before
SMALL_STEP = 0.1  # greatest distance of a converged fit from its minimum, in standard deviations
NO_ANSWER = 30.0  # error, in scales, of a row for which the model has no answer
SIGMA_PER_MEDIAN = 1.4826  # standard deviation of a normal variable over its median absolute value

# x (p,) -> errors (n, m), NaN where not measured, inf in rows without an answer; Jacobian (n, m, p)
Model = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Problem:
    """Scales and prior of a fit that starts at x = 0."""

    prior: np.ndarray  # (p,) standard deviations about the start
    group: np.ndarray  # (m,) or (n, m) group of each column, or of each of the errors, counted from 0
    scale: np.ndarray  # (n_groups,) first guess of the errors' standard deviations
    min_scale: np.ndarray  # (n_groups,)
    huber: float = 2.0  # scales at which Huber's loss becomes linear


class Solution(NamedTuple):
    """Parameters at the end of a fit."""

    x: np.ndarray  # (p,)
    covariance: np.ndarray  # (p, p)
    scale: np.ndarray  # (n_groups,) standard deviations of the errors
    newton_step: np.ndarray  # (p,) from x to the minimum
    decrement: float  # reduction of the loss by the Newton step

    @property
    def converged(self) -> bool:
        """Whether x is as good as at the minimum."""
        return self.decrement < 0.5 * SMALL_STEP**2

    @property
    def half_width(self) -> np.ndarray:
        """Half-widths (p,) of the 95 % intervals."""
        return QUANTILE * np.sqrt(np.diag(self.covariance))


def fit(model: Model, problem: Problem) -> Solution:
    """Minimise Huber's loss of the errors over their scales, started from x = 0."""
    model = _remembering(model)
    x, scale = np.zeros(len(problem.prior)), problem.scale
    for loss in ROUNDS:
        x = descend(model, x, scale, problem, loss, TOLERANCES)
        scale = _scales(model(x)[0], problem)
    return refine(model, x, problem)


def descend(
    model: Model, x: np.ndarray, scale: np.ndarray, problem: Problem, loss: str, end: Mapping[str, Any]
) -> np.ndarray:
    """Minimise a loss of the errors from x (p,), with scales (n_groups,) that stay; `end` is SciPy's."""
    from scipy.optimize import least_squares  # takes 0.3 s to import, and training imports this module

    model, prior = _remembering(model), np.diag(1.0 / problem.prior)

    def errors(x: np.ndarray) -> np.ndarray:
        return np.append(_scaled(*model(x), scale, problem)[0], x @ prior)

    def jacobian(x: np.ndarray) -> np.ndarray:
        return np.concatenate([_scaled(*model(x), scale, problem)[1].reshape(-1, len(x)), prior])

    options: dict[str, Any] = {"jac": jacobian, "f_scale": problem.huber, "x_scale": problem.prior, **end}
    return least_squares(errors, x, loss=loss, **options).x


def _remembering(model: Model) -> Model:
    """Return a model that keeps its last answers: SciPy asks for errors and Jacobian one after the other."""
    answers = functools.lru_cache(maxsize=2)(lambda x: model(np.frombuffer(x)))
    return lambda x: answers(x.tobytes())


def refine(model: Model, x: np.ndarray, problem: Problem) -> Solution:
    """Take Newton steps to the minimum from an x (p,) close to it, such as the fit to a part of the rows."""
    solution = solution_at(x, *model(x), problem)
    for _ in range(NEWTON_STEPS):
        if solution.converged:
            break
        x = solution.x + solution.newton_step
        linearised = model(x)
        # Close to the minimum single precision hides changes of the loss, so the gradient decides.
        if not solution_at(x, *linearised, problem, solution.scale).decrement < solution.decrement:
            break
        solution = solution_at(x, *linearised, problem)
    return solution


def solution_at(
    x: np.ndarray, error: np.ndarray, jacobian: np.ndarray, problem: Problem, scale: np.ndarray | None = None
) -> Solution:
    """Return the solution of a fit that ended at x (p,), with errors (n, m) and their Jacobian (n, m, p).

    Scales (n_groups,) are by default those of the errors.
    """
    scale = _scales(error, problem) if scale is None else scale
    error, slope = _scaled(error, jacobian, scale, problem)
    precision = np.diag(problem.prior**-2.0)
    inside = np.where(np.abs(error)[..., None] <= problem.huber, slope, 0.0)
    curvature = np.swapaxes(inside, 1, 2) @ inside  # (n, p, p) of each row's loss
    score = np.einsum("nmp,nm->np", slope, np.clip(error, -problem.huber, problem.huber))
    hessian = curvature.sum(axis=0) + precision
    change = np.linalg.solve(hessian - curvature, score[..., None])[..., 0]  # (n, p) without each row
    inverse = np.linalg.inv(hessian)
    covariance = change.T @ change + inverse @ precision @ inverse
    gradient = score.sum(axis=0) + precision @ x
    newton_step = -inverse @ gradient
    return Solution(x, covariance, scale, newton_step, -0.5 * float(gradient @ newton_step))


def rms_of(values: np.ndarray) -> float:
    """Return the root mean square of the finite values."""
    return float(np.sqrt(np.mean(values[np.isfinite(values)] ** 2)))


def principal(solution: Solution, tolerance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return directions of x from the least known to the best known, in units of a tolerance (p,).

    Returns:
        Half-widths (p,) of the 95 % intervals; directions (p, p) in its columns.
    """
    values, vectors = np.linalg.eigh(solution.covariance / np.outer(tolerance, tolerance))
    return QUANTILE * np.sqrt(np.maximum(values[::-1], 0.0)), vectors[:, ::-1]


def _scaled(
    error: np.ndarray, jacobian: np.ndarray, scale: np.ndarray, problem: Problem
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (n, m) and Jacobian (n, m, p) over the scales; constant where nothing is known."""
    sigma = scale[problem.group]
    answered = ~np.any(np.isinf(error), axis=1, keepdims=True)
    known = np.isfinite(error) & answered
    scaled = np.where(answered, np.where(known, error, 0.0) / sigma, NO_ANSWER)
    return scaled, np.where(known[..., None], jacobian, 0.0) / sigma[..., None]


def _scales(error: np.ndarray, problem: Problem) -> np.ndarray:
    """Return the robust standard deviation of each group (n_groups,)."""
    scale = problem.scale.copy()
    for k in range(len(scale)):
        of_group = error[np.broadcast_to(problem.group == k, error.shape)]
        of_group = of_group[np.isfinite(of_group)]
        if len(of_group):
            scale[k] = max(SIGMA_PER_MEDIAN * np.median(np.abs(of_group)), problem.min_scale[k])
    return scale
