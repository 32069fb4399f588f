"""Safety: the faults of an arm, how each is detected, and the control loop's response.

    fault            detected by                                                       response
    LOST_READING     a spring without a length this tick, or no readings in time       go on with the last
    SENSOR_LOST      a spring lost in LOST_TICKS ticks in a row                        vent
    SENSOR_STUCK     a spring that stands still, without its noise even, while its     vent
                     chamber is driven or a spring of its section moves
    CHAMBER_LOST     a chamber at its limit, its spring off the reference, and the     vent
                     arm in the shape of one without that pressure: for a second, or
                     for three while it moves; all at their limits, without air
    GOAL_OUTSIDE     a goal that no pressures bring the tip to, by the policy's        skip the goal
                     models and its threshold; a goal at run time further from all
                     reachable poses than they are from each other
    MISSED_DEADLINE  a tick longer than the period, or pressures not taken in time     go on
    ARM_LATE         LATE_TICKS of these in a row                                      vent
    ARM_LOST         the driver cannot reach sensors or pumps, or refuses pressures    vent
    NOT_SETTLED      springs neither on their references nor at rest at a limit        go on and act
                     within SETTLE_TIMEOUT_S
    SATURATED        a chamber at its limit with its spring off the reference          go on
    EXTRAPOLATION    the sim-to-real network asked far from its training rows          go on
    LOAD_LOST        a new average of the payload begins lower: an object dropped      go on
    OVERLOADED       a payload whose whole interval is above OVERLOAD times the        go on
                     largest
    LOAD_UNKNOWN     springs and pressures that no payload explains: the               go on
                     specification's payload is taken; or an interval wider than the
                     calibration's limit: the payload believed before stays

Names in capitals are constants, here and where they are imported from. To vent is to end the run and
bring all pressures to zero along a ramp, as at every end of a run (`mjx_softarm.deploy.ending`). `check`
watches each tick. It may only vent: it neither plans nor drives.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import Enum
from typing import NamedTuple

import numpy as np

from mjx_softarm.control import allocated_error
from mjx_softarm.deploy.belief import STUCK_RANGE_M, Belief
from mjx_softarm.deploy.link import LATE_TICKS, LOST_TICKS
from mjx_softarm.policy.lag import SETTLE_TIMEOUT_S
from mjx_softarm.sensing.load import KNOWN, holds_payload

OVERLOAD = 1.2  # least lower end of a payload's interval that is an overload, in largest payloads; by hand
# Windows in a row after which a suspected chamber counts as lost; by hand. Springs and pressures of an arm
# that moves come after their references.
REST_WINDOWS = 2
MOVING_WINDOWS = 6


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
        fault._value_ = text
        fault.response = response
        return fault


PAYLOAD_FAULTS = {Fault.OVERLOADED, Fault.LOAD_UNKNOWN}  # they last from one estimate of it to the next


class Event(NamedTuple):
    """A fault that has occurred."""

    fault: Fault
    message: str

    def __str__(self) -> str:
        return f"{self.fault.value}: {self.message} -> {self.fault.response.value}"


def check(last: Belief, belief: Belief) -> tuple[Event, ...]:
    """Return the faults of a tick, by its belief and that of the last tick."""
    events = [*_timing_faults(belief), *_sensor_faults(belief)]
    if stop_of(events) is None:
        events += [*_chamber_faults(belief), *_payload_faults(last, belief)]
    return tuple(events)


def stop_of(events: Iterable[Event]) -> Event | None:
    """Return the first event that ends a run, if there is one."""
    return next((event for event in events if event.fault.response is Response.VENT), None)


def _timing_faults(belief: Belief) -> Iterator[Event]:
    late = f"took too long, expected at most {1e3 * belief.controller.dt_s:g} ms"
    if belief.n_late:
        yield Event(Fault.MISSED_DEADLINE, f"the last tick {late}")
    if belief.n_late >= LATE_TICKS:
        yield Event(Fault.ARM_LATE, f"{belief.n_late} ticks in a row {late}")


def _sensor_faults(belief: Belief) -> Iterator[Event]:
    gone = belief.n_lost >= LOST_TICKS
    if belief.lost.any():
        yield Event(Fault.LOST_READING, belief.why_lost)
    if gone.any():
        yield Event(Fault.SENSOR_LOST, f"{names('spring', gone)}: no length in {LOST_TICKS} ticks in a row")
    elif belief.stuck.any():
        window_s = belief.controller.window * belief.controller.dt_s
        moved = f"moved less than {1e3 * STUCK_RANGE_M:g} mm in {window_s:g} s, noise included"
        why = "while the chamber was driven or the section moved"
        yield Event(Fault.SENSOR_STUCK, f"{names('spring', belief.stuck)}: {moved}, {why}")


def _chamber_faults(belief: Belief) -> Iterator[Event]:
    n_windows = REST_WINDOWS if belief.at_rest else MOVING_WINDOWS
    lost = belief.n_suspect >= n_windows * belief.controller.window
    if lost.any():
        kpa = ", ".join(f"{value:.1f}" for value in belief.command.pressure_kpa[lost])
        shape = "but the arm has the shape it would have without that pressure"
        supply = ": is the supply of air on?" if np.count_nonzero(lost) > 1 else ""
        yield Event(Fault.CHAMBER_LOST, f"{names('chamber', lost)}: at {kpa} kPa, {shape}{supply}")


def _payload_faults(last: Belief, belief: Belief) -> Iterator[Event]:
    """Yield the faults of a payload that was estimated in this tick."""
    if belief.estimate_kg is None:
        return
    load = belief.load
    most_kg = float(belief.controller.policy.load_estimator.load_scale_kg)
    believed = f"the pose is estimated with {1e3 * load.believed_kg:.0f} g"
    if not holds_payload(belief.estimate_kg, belief.width_kg, most_kg):
        text = f"springs and pressures give {1e3 * belief.estimate_kg:.0f} g, {believed}"
        yield Event(Fault.LOAD_UNKNOWN, text)
    elif belief.width_kg > KNOWN * most_kg:
        text = f"payload not known better than {1e3 * belief.width_kg:.0f} g, expected "
        text += f"{1e3 * KNOWN * most_kg:.0f} g: record more random poses; "
        yield Event(Fault.LOAD_UNKNOWN, text + believed)
    if load.began and load.kg < last.load.kg:
        text = f"{1e3 * load.believed_kg:.0f} g, from {1e3 * last.load.kg:.0f} g before"
        yield Event(Fault.LOAD_LOST, text)
    if load.kg - load.half_width_kg > OVERLOAD * most_kg:
        estimate = f"{1e3 * load.kg:.0f} +- {1e3 * load.half_width_kg:.0f} g"
        yield Event(Fault.OVERLOADED, f"{estimate}, expected at most {1e3 * most_kg:.0f} g")


def extrapolated(belief: Belief) -> tuple[Event, ...]:
    """Return the fault of a pose far from the training rows of the sim-to-real network, before an action."""
    if not belief.away > 1.0:
        return ()
    text = f"{belief.away:.1f} times as far from the training rows as the network is believed"
    return (Event(Fault.EXTRAPOLATION, text),)


def unsettled(belief: Belief) -> tuple[Event, ...]:
    """Return the faults of the springs as they stand before the next action."""
    # Not all springs can be on any references where chambers are redundant: errors at the chambers count
    allocation = belief.controller.policy.gains.allocation
    error_m = belief.command.reference_m - belief.mean_m
    off_m = -allocated_error(error_m, belief.command.pressure_kpa, allocation)
    kind = "spring" if allocation is None else "chamber"
    events = []
    mask = belief.saturated
    if not belief.settled:
        worst = int(np.argmax(np.where(mask, 0.0, np.abs(off_m))))
        off = f"{kind}{worst} is {1e3 * off_m[worst]:+.1f} mm off its reference"
        events.append(Event(Fault.NOT_SETTLED, f"after {SETTLE_TIMEOUT_S:g} s, {off}"))
    if mask.any():
        off = ", ".join(f"{1e3 * value:+.1f}" for value in off_m[mask])
        text = f"{names('chamber', mask)}: at the limit, spring {off} mm off its reference"
        events.append(Event(Fault.SATURATED, text))
    return tuple(events)


def names(kind: str, mask: np.ndarray) -> str:
    """Return the names of springs or chambers of a mask (n,)."""
    return ", ".join(f"{kind}{k}" for k in np.flatnonzero(mask))
