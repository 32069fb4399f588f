"""Faults of an arm: how each is detected, and the control loop's response.

    fault              detected by                                                      response
    LOST_READING       a spring without a length this tick, or no readings in time      go on with the last
    SENSOR_LOST        a spring lost in LOST_TICKS ticks in a row                       vent
    SENSOR_STUCK       a spring that stands still, without its noise even, while its    vent
                       chamber is driven or a spring of its section moves
    CHAMBER_LOST       a chamber at its limit, its spring off the reference, and the    vent
                       arm in the shape of one without that pressure: for a second, or
                       for three while it moves
    GOAL_OUTSIDE       a goal that no pressures bring the tip to, by the policy's       skip the goal
                       models and its threshold of a goal; a pilot's goal further
                       from all reachable poses than they are from each other
    MISSED_DEADLINE    a tick longer than the period, or pressures not taken in time    go on
    ARM_LATE           LATE_TICKS of these in a row                                     vent
    ARM_LOST           the driver cannot reach sensors or pumps, or refuses pressures   vent
    NOT_SETTLED        springs neither on their references nor at rest at a limit       go on and act
                       within SETTLE_TIMEOUT_S
    SATURATED          a chamber at its limit with its spring off the reference         go on
    EXTRAPOLATION      the sim-to-real network asked far from its training rows         go on
    LOAD_LOST          a new average of the payload begins lower: an object dropped     go on
    OVERLOADED         a payload of more than `loop.OVERLOAD` times the largest         go on
    LOAD_UNKNOWN       springs and pressures that no payload explains: the pose is      go on
                       estimated from the springs alone, with the specified payload

To vent is to end the run and bring all pressures to zero along a ramp, as at every end of a run
(`mjx_softarm.deploy.ending`). Every fault is counted; `Event.message` says what was seen and what was
expected.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.control import Gains, saturated
from mjx_softarm.sensing.estimator import SpringModel, expected_springs
from mjx_softarm.sensing.sensors import Sensor, SensorFault
from mjx_softarm.spec import N_CHAMBERS_PER_SECTION

LOST_TICKS = 3
LATE_TICKS = 5
SETTLE_TIMEOUT_S = 15.0  # a twin is within 2 mm of its rest after 4 s, and still after some more
STILL_M = 2e-4  # greatest difference between the means of a window's halves at rest; far above the noise

# A spring is stuck if its readings range over less than the noise of a live one, some 0.01 mm, while in the
# same window its own chamber is driven by this much, or a spring of its section moves by this much.
STUCK_RANGE_M = 1e-5
STUCK_PRESSURE_KPA = 2.0
STUCK_NEIGHBOUR_M = 2e-3

# A chamber is lost if the shape lacks more than this share of its pressure, if that explains more than this
# share of the springs' squared deviations, and if its own spring would move by more than this length: less
# cannot be told from tolerances and payload.
LOST_SHARE = 0.5
EXPLAINED_SHARE = 0.7
LOST_EFFECT_M = 0.01


class Response(Enum):
    """Response of the control loop to a fault."""

    GO_ON = "go on"
    SKIP = "skip the goal"
    VENT = "vent"


class Fault(Enum):
    """Kinds of faults and the response to each; the table stands in the module's docstring."""

    response: Response

    LOST_READING = "lost reading", Response.GO_ON
    SENSOR_LOST = "sensor lost", Response.VENT
    SENSOR_STUCK = "sensor stuck", Response.VENT
    CHAMBER_LOST = "chamber lost its pressure", Response.VENT
    GOAL_OUTSIDE = "goal outside the workspace", Response.SKIP
    MISSED_DEADLINE = "missed deadline", Response.GO_ON
    ARM_LATE = "arm late", Response.VENT
    ARM_LOST = "arm lost", Response.VENT
    NOT_SETTLED = "not settled", Response.GO_ON
    SATURATED = "saturated", Response.GO_ON
    EXTRAPOLATION = "extrapolation", Response.GO_ON
    LOAD_LOST = "load lost", Response.GO_ON
    OVERLOADED = "overloaded", Response.GO_ON
    LOAD_UNKNOWN = "load unknown", Response.GO_ON

    def __new__(cls, text: str, response: Response) -> Fault:
        fault = object.__new__(cls)
        fault._value_, fault.response = text, response
        return fault


class Event(NamedTuple):
    """A fault that was found."""

    fault: Fault
    message: str

    @property
    def response(self) -> Response:
        return self.fault.response

    def __str__(self) -> str:
        return f"{self.fault.value}: {self.message} -> {self.response.value}"


def read_lengths(
    sensor: Sensor, readings: np.ndarray | None, last_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return spring lengths (n,) [m], the last ones where a reading is lost; which are (n,); and why."""
    if readings is None:
        return last_m, np.ones(len(last_m), bool), "no readings within the tick"
    reading = sensor.lengths(readings)
    lost = reading.fault != SensorFault.OK.value
    text = sensor.describe_faults(readings, reading.fault).replace("\n", "; ")
    return np.where(lost, last_m, reading.length_m), lost, text


def still(spring_m: Array) -> Array:
    """Return whether springs came to rest over a window (ticks, n) [m]: its halves have the same mean."""
    xp, half = array_namespace(spring_m), len(spring_m) // 2
    moved_m = xp.mean(spring_m[-half:], axis=0) - xp.mean(spring_m[:half], axis=0)  # (n,)
    return xp.all(xp.abs(moved_m) < STILL_M)


def on_reference(
    springs_m: Array, reference_m: Array, pressure_kpa: Array, gains: Gains, tolerance_m: float
) -> Array:
    """Return whether each spring is on its reference, in the mean of a window, or its chamber at a limit.

    Args:
        springs_m (ticks, n) [m]: lengths over the window.
        reference_m (n,) [m]: asked of the springs.
        pressure_kpa (n,) [kPa]: commanded.
        gains: with the limits.
        tolerance_m: greatest error of a spring that counts as on its reference.
    """
    xp = array_namespace(springs_m, reference_m, pressure_kpa)
    off_m = xp.abs(xp.mean(springs_m, axis=0) - reference_m)
    at_limit = (pressure_kpa <= gains.pressure_min_kpa) | (pressure_kpa >= gains.pressure_max_kpa)
    return xp.all((off_m < tolerance_m) | at_limit)


def stuck_springs(spring_m: np.ndarray, pressure_kpa: np.ndarray) -> np.ndarray:
    """Return which springs (n,) stand stock-still where they should not.

    Args:
        spring_m (ticks, n) [m]: readings of the last ticks.
        pressure_kpa (ticks, n) [kPa]: pressures commanded in them.
    """
    suspects = stock_still(spring_m)
    return suspects & asked_to_move(spring_m, pressure_kpa) if suspects.any() else suspects


def stock_still(spring_m: Array) -> Array:
    """Return which springs (n,) did not move, nor show any noise, over a window (ticks, n) [m]."""
    return _range(spring_m) < STUCK_RANGE_M


def asked_to_move(spring_m: Array, pressure_kpa: Array) -> Array:
    """Return which springs (n,) should have moved: the chamber was driven or the section moved."""
    xp, moved_m = array_namespace(spring_m), _range(spring_m)
    section_m = xp.max(moved_m.reshape(-1, N_CHAMBERS_PER_SECTION), axis=1)[:, None]  # (n_sections, 1)
    near_m = (section_m + np.zeros(N_CHAMBERS_PER_SECTION)).reshape(-1)  # (n,)
    return (_range(pressure_kpa) > STUCK_PRESSURE_KPA) | (near_m > STUCK_NEIGHBOUR_M)


def _range(values: Array) -> Array:
    """Return how far values (ticks, n) went apart."""
    xp = array_namespace(values)
    return xp.max(values, axis=0) - xp.min(values, axis=0)


def lost_chambers(
    model: SpringModel,
    gains: Gains,
    pressure_kpa: np.ndarray,
    reference_m: np.ndarray,
    spring_m: np.ndarray,
    tolerance_m: float,
) -> np.ndarray:
    """Return which chambers (n,) of an arm at rest, or nearly so, have lost their pressure.

    A chamber at its limit with its spring off the reference is saturated, or it no longer holds pressure.
    Then the arm has the shape that it would have without that pressure: the springs' deviations from the
    model are, for the most part, a good share of what the pressure's absence makes of them.

    Args:
        model: lengths to expect at pressures.
        gains: with the limits.
        pressure_kpa (n,) [kPa]: commanded.
        reference_m (n,) [m]: asked of the springs.
        spring_m (n,) [m]: read.
        tolerance_m: greatest error of a spring that counts as on its reference.
    """
    suspects = saturated(pressure_kpa, reference_m, spring_m, gains, tolerance_m)
    return suspects & as_without(model, pressure_kpa, spring_m) if suspects.any() else suspects


def as_without(model: SpringModel, pressure_kpa: Array, spring_m: Array) -> Array:
    """Return for which chambers (n,) the springs lie as they would without that chamber's pressure."""
    xp, own = array_namespace(pressure_kpa, spring_m), np.eye(len(pressure_kpa), dtype=bool)
    pressures_kpa = xp.concat([pressure_kpa[None], xp.where(own, 0.0, pressure_kpa)])  # (1 + n, n)
    springs_m = expected_springs(model, pressures_kpa)
    effect_m = springs_m[1:] - springs_m[0]  # (n chambers, n springs)
    deviation_m = spring_m - springs_m[0]  # (n,)
    share = effect_m @ deviation_m / xp.sum(effect_m**2, axis=1)  # (n,)
    left_m = deviation_m - share[:, None] * effect_m
    explained = 1.0 - xp.sum(left_m**2, axis=1) / xp.sum(deviation_m**2)
    own_m = xp.abs(share * xp.sum(xp.where(own, effect_m, 0.0), axis=1))
    return (share > LOST_SHARE) & (explained > EXPLAINED_SHARE) & (own_m > LOST_EFFECT_M)
