"""One source for NumPy, JAX and recorded symbols: the functions of an array's own library, and a solver."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

Array = Any  # a NumPy or a JAX array; this module never imports JAX


def array_namespace(*arrays: Array) -> ModuleType:
    """Return `jax.numpy` if any argument is a JAX array or tracer, else `numpy`; numbers are allowed."""
    for array in arrays:
        if hasattr(array, "__array_namespace__") and not isinstance(array, (np.ndarray, np.generic)):
            return array.__array_namespace__()
    return np


def solve(matrix: Array, column: Array) -> Array:
    """Solve positive definite systems (..., n, n) for columns (..., n), by Gauss-Jordan elimination.

    It uses only operations that exports have. No rows change places.
    """
    xp, n = array_namespace(matrix, column), matrix.shape[-1]
    left = xp.concat([matrix, column[..., None]], axis=-1)  # (..., n, n + 1 - k)
    for k in range(n):
        row = left[..., k : k + 1, 1:] / left[..., k : k + 1, :1]
        cleared = left[..., 1:] - left[..., :1] * row
        left = xp.where(np.arange(n)[:, None] == k, row, cleared)
    return left[..., 0]
