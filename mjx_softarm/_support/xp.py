"""One source for NumPy and JAX: the functions of an array's own library."""

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
