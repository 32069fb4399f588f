"""Hysteresis of chambers: a pressure that depends on the way on which a chamber came to its length.

A chamber that has grown holds its length with more pressure than one that has shrunk to the same length. The
difference is that of a stop operator, a spring in series with a slider: its state x in [-1, 1] follows the
chamber's length l,

    x' = clip(x + (l' - l) / stroke, -1, 1),

and the chamber's pressure is greater by h x. Noise of the lengths does not add up, since each change is taken
back by the next one.

Source: Brokate, Sprekels, "Hysteresis and Phase Transitions", Springer 1996, chapter 2.
"""

from __future__ import annotations

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace


def stop_after(stop: Array, moved_m: Array, stroke_m: Array) -> Array:
    """Return states (..., n) of stop operators after changes (..., n) [m] of the lengths; NaN changes none.

    A change of `stroke_m` (n,) [m] brings a state from 0 to 1.
    """
    xp = array_namespace(stop, moved_m, stroke_m)
    moved_m = xp.where(xp.isfinite(moved_m), moved_m, 0.0)
    return xp.clip(stop + moved_m / stroke_m, -1.0, 1.0)


def stops(length_m: np.ndarray, stroke_m: np.ndarray) -> np.ndarray:
    """Return the states (m, n) at lengths (m, n) [m] that follow each other; the first ones are 0."""
    states = np.zeros_like(length_m)
    for k in range(1, len(length_m)):
        states[k] = stop_after(states[k - 1], length_m[k] - length_m[k - 1], stroke_m)
    return states
