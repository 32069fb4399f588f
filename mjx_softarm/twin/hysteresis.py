"""Rate-independent hysteresis: several stop operators in parallel, each a spring in series with a slider.

A stop operator follows the displacement x elastically until its force reaches its limit, then slides:

    f'  = clip(f + k (x' - x), -limit, limit)

The sum of the forces is the Prandtl-Ishlinskii model. It is passive: a slider only dissipates energy, and a
spring returns the energy that it stored. A single stop is Coulomb friction with an elastic start.

Source: Brokate, Sprekels, "Hysteresis and Phase Transitions", Springer 1996, chapter 2.
"""

from __future__ import annotations

import numpy as np


class StopOperators:
    """State of m stop operators on each of n displacements."""

    def __init__(self, stiffness: np.ndarray, limit: np.ndarray, x: np.ndarray):
        """Start without force, at displacements x (n,).

        Args:
            stiffness (n, m): stiffness of each spring, force per displacement.
            limit (n, m): largest force of each slider.
            x (n,): displacements.
        """
        self._stiffness, self._low, self._high = stiffness, -limit, limit
        self._x = np.array(x, float)
        self._force = np.zeros(np.shape(limit))

    def move(self, x: np.ndarray) -> np.ndarray:
        """Move to x (n,); return the resisting force (n,), positive where the displacement has grown."""
        trial = self._force + self._stiffness * (x - self._x)[:, None]
        self._force = np.minimum(np.maximum(trial, self._low), self._high)
        self._x = np.array(x, float)
        return self._force.sum(axis=1)
