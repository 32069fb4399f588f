"""Errors that the sensor-space law closes, with many arms last in every shape.

Without an allocation, each chamber closes the error of its spring, e = reference - s. Redundant chambers
close e = C (reference - s) - YIELD_M_PER_KPA N p, with the matrices C and N of `mjx_softarm.control`.
"""

from __future__ import annotations

from jax import Array

from mjx_softarm._support.small_matrices import product
from mjx_softarm.control import YIELD_M_PER_KPA, Allocation


def law_errors(spring_error_m: Array, pressure_kpa: Array, allocation: Allocation | None) -> Array:
    """Return the error e of each chamber (n_chambers, *arms) [m].

    Args:
        spring_error_m (n_springs, *arms) [m]: references less lengths of the springs.
        pressure_kpa (n_chambers, *arms) [kPa]: pressures.
        allocation: matrices (..., *arms) of an arm with redundant chambers.
    """
    if allocation is None:
        return spring_error_m
    of_springs = product(allocation.chamber_error, spring_error_m[:, None])[:, 0]
    return of_springs - YIELD_M_PER_KPA * product(allocation.redundant, pressure_kpa[:, None])[:, 0]


def closed_errors(
    newton_spring_m: Array, spring_per_kpa: Array, allocation: Allocation | None
) -> tuple[Array, Array]:
    """Return by how much a Newton step, and each pressure, lessens the error of each chamber.

    Args:
        newton_spring_m (n_springs, *arms) [m]: lengthening of the springs by the step at constant pressures.
        spring_per_kpa (n_springs, n_chambers, *arms) [m/kPa]: response of the springs to the pressures.
        allocation: matrices (..., *arms) of an arm with redundant chambers.

    Returns:
        (n_chambers, *arms) [m] and (n_chambers, n_chambers, *arms) [m/kPa].
    """
    if allocation is None:
        return newton_spring_m, spring_per_kpa
    newton = product(allocation.chamber_error, newton_spring_m[:, None])[:, 0]
    per_kpa = product(allocation.chamber_error, spring_per_kpa)
    return newton, per_kpa + YIELD_M_PER_KPA * allocation.redundant
