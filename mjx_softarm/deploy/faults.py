"""Faults of an arm: how each is detected, and the control loop's response.

    fault              detected by                                                      response
    LOST_READING       a spring without a length this tick, or no readings in time      go on with the last
    SENSOR_LOST        a spring lost in LOST_TICKS ticks in a row                       vent
    SENSOR_STUCK       a spring that stands still, without its noise even, while its    vent
                       chamber is driven or a spring of its section moves
    CHAMBER_LOST       a chamber at its limit, its spring off the reference, and the    vent
                       arm at rest in the shape of an arm without that pressure
    GOAL_OUTSIDE       a goal further from all reachable poses than they are from       skip the goal
                       each other, or not finite
    MISSED_DEADLINE    a tick longer than the period, or pressures not taken in time    go on
    ARM_LATE           LATE_TICKS of these in a row                                     vent
    ARM_LOST           the driver cannot reach sensors or pumps, or refuses pressures   vent
    NOT_SETTLED        springs neither on their references nor at rest at a limit       go on and act
                       within SETTLE_TIMEOUT_S
    SATURATED          a chamber at its limit with its spring off the reference         go on
    EXTRAPOLATION      the sim-to-real network asked far from its training rows         go on

To vent is to end the run and bring all pressures to zero along a ramp, as at every end of a run
(`mjx_softarm.deploy.ending`). Every fault is counted; `Event.message` says what was seen and what was
expected.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from mjx_softarm.control import Gains, saturated
from mjx_softarm.sensing.estimator import SpringModel, expected_springs
from mjx_softarm.sensing.sensors import Sensor, SensorFault
from mjx_softarm.spec import N_CHAMBERS_PER_SECTION

LOST_TICKS = 3
LATE_TICKS = 5
SETTLE_TIMEOUT_S = 15.0  # a pump of 12 L/min takes up to 10 s from one end of the workspace to the other
STILL_M = 2e-4  # greatest difference between the means of a window's halves at rest; far above the noise

# A live spring has noise of some 0.01 mm and more: over a window, this is none.
STUCK_RANGE_M = 1e-5
STUCK_PRESSURE_KPA = 2.0  # that its own chamber was driven by in the window,
STUCK_NEIGHBOUR_M = 2e-3  # or a spring of its section moved

LOST_SHARE = 0.5  # of a chamber's pressure, that the shape says is missing
EXPLAINED_SHARE = 0.7  # of the springs' squared deviations, by that missing pressure
LOST_EFFECT_M = 0.01  # on the chamber's own spring: less cannot be told from tolerances and payload


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


def still(spring_m: np.ndarray) -> bool:
    """Return whether springs came to rest over a window (ticks, n) [m]: its halves have the same mean."""
    half = len(spring_m) // 2
    return bool(np.all(np.abs(spring_m[-half:].mean(axis=0) - spring_m[:half].mean(axis=0)) < STILL_M))


def stuck_springs(spring_m: np.ndarray, pressure_kpa: np.ndarray) -> np.ndarray:
    """Return which springs (n,) stand stock-still where they should not.

    Args:
        spring_m (ticks, n) [m]: readings of the last ticks.
        pressure_kpa (ticks, n) [kPa]: pressures commanded in them.
    """
    moved_m = np.ptp(spring_m, axis=0)  # (n,)
    suspects = moved_m < STUCK_RANGE_M
    if not suspects.any():
        return suspects
    by_section = moved_m.reshape(-1, N_CHAMBERS_PER_SECTION)
    near_m = np.repeat(by_section.max(axis=1), N_CHAMBERS_PER_SECTION)
    asked = (np.ptp(pressure_kpa, axis=0) > STUCK_PRESSURE_KPA) | (near_m > STUCK_NEIGHBOUR_M)
    return suspects & asked


def lost_chambers(
    model: SpringModel,
    gains: Gains,
    pressure_kpa: np.ndarray,
    reference_m: np.ndarray,
    spring_m: np.ndarray,
    tolerance_m: float,
) -> np.ndarray:
    """Return which chambers (n,) of an arm at rest have lost their pressure.

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
    if not suspects.any():
        return suspects
    without = np.where(np.eye(len(pressure_kpa), dtype=bool), 0.0, pressure_kpa)  # (n, n)
    expected_m, *absent_m = expected_springs(model, np.vstack([pressure_kpa, without]))
    effect_m = np.array(absent_m) - expected_m  # (n chambers, n springs)
    deviation_m = spring_m - expected_m  # (n,)
    share = effect_m @ deviation_m / np.sum(effect_m**2, axis=1)  # (n,)
    left_m = deviation_m - share[:, None] * effect_m
    explained = 1.0 - np.sum(left_m**2, axis=1) / np.sum(deviation_m**2)
    own_m = np.abs(share * np.diagonal(effect_m))
    return suspects & (share > LOST_SHARE) & (explained > EXPLAINED_SHARE) & (own_m > LOST_EFFECT_M)
