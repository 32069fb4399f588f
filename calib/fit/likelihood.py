"""Length and noise of a Gaussian process that make its rows most likely, searched on a grid.

The rows y (n, c) have the covariance (K + noise I) x V between rows and columns. V has a closed form.

Source: Rasmussen, Williams, "Gaussian Processes for Machine Learning", MIT Press 2006, section 5.4.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky


class Hyperparameters(NamedTuple):
    """Numbers of a process that make its rows most likely."""

    length: float  # distance of states over which the process changes
    noise: float  # variance of the noise, as a multiple of V
    covariance: np.ndarray  # (c, c) V


def most_likely(
    y: np.ndarray,
    kernel: Callable[[float], np.ndarray],
    lengths: Sequence[float],
    noises: Sequence[float],
    least: float,
) -> Hyperparameters:
    """Return the hyperparameters of a grid that make rows y (n, c) most likely.

    Args:
        y (n, c): rows.
        kernel: K (n, n) by length.
        lengths: lengths to try.
        noises: noises to try.
        least: least variance of a column.
    """
    n, c = y.shape
    best = (np.inf, Hyperparameters(0.0, 0.0, np.eye(c)))
    for length in lengths:
        likeness = kernel(length)
        for noise in noises:
            weight, half_log_determinant = solve(likeness, noise, y)
            covariance = y.T @ weight / n + least * np.eye(c)
            unlikely = c * half_log_determinant + 0.5 * n * np.linalg.slogdet(covariance)[1]
            best = min(
                best, (float(unlikely), Hyperparameters(length, noise, covariance)), key=lambda x: x[0]
            )
    return best[1]


def solve(kernel: np.ndarray, noise: float, y: np.ndarray) -> tuple[np.ndarray, float]:
    """Solve K + noise I for y; return also half the logarithm of its determinant."""
    factor = cholesky(kernel + noise * np.eye(len(y)), lower=True, check_finite=False)
    weight = cho_solve((factor, True), y, check_finite=False)
    return weight, float(np.log(np.diag(factor)).sum())
