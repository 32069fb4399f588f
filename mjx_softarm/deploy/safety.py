"""Safety: the faults of an arm, how each is detected, and the control loop's response.

    fault              detected by                                                      response
    LOST_READING       a spring without a length this tick, or no readings in time      go on with the last
    SENSOR_LOST        a spring lost in `lost_ticks` ticks in a row                     vent
    SENSOR_STUCK       a spring that stands still, without its noise even, while its    vent
                       chamber is driven or a spring of its section moves
    CHAMBER_LOST       a chamber at its limit, its spring off the reference, and the    vent
                       arm in the shape of one without that pressure: for a second, or
                       for three while it moves; a run that may go on without one
                       chamber keeps it without pressure (`mjx_softarm.deploy.lost`)
    GOAL_OUTSIDE       a goal that no pressures bring the tip to, by the policy's       skip the goal
                       models and its threshold of a goal; a pilot's goal further
                       from all reachable poses than they are from each other
    MISSED_DEADLINE    a tick longer than the period, or pressures not taken in time    go on
    ARM_LATE           `late_ticks` of these in a row                                   vent
    ARM_LOST           the driver cannot reach sensors or pumps, or refuses pressures   vent
    NOT_SETTLED        springs neither on their references nor at rest at a limit       go on and act
                       within `settle_timeout_s`
    SATURATED          a chamber at its limit with its spring off the reference         go on
    EXTRAPOLATION      the sim-to-real network asked far from its training rows         go on
    LOAD_LOST          a new average of the payload begins lower: an object dropped     go on
    OVERLOADED         a payload whose whole interval is above `overload` times the     go on
                       largest
    LOAD_UNKNOWN       springs and pressures that no payload explains, or a calibration go on
                       that tells none better than `load_known`: the pose is estimated
                       from the springs alone, with the payload believed before

Names in backquotes are fields of `mjx_softarm.deploy.controller.LoopConfig`. To vent is to end the run and
bring all pressures to zero along a ramp, as at every end of a run (`mjx_softarm.deploy.ending`). Every fault
is counted; `Event.message` says what was seen and what was expected.

`check` watches each tick. It may only vent: it neither plans nor drives.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import Enum
from typing import NamedTuple

import numpy as np

from mjx_softarm.control import allocated_error
from mjx_softarm.deploy.belief import Belief
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.sensing.load import holds_payload


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


PAYLOAD_FAULTS = {Fault.OVERLOADED, Fault.LOAD_UNKNOWN}  # they last from one estimate of it to the next


class Event(NamedTuple):
    """A fault that was found."""

    fault: Fault
    message: str

    @property
    def response(self) -> Response:
        return self.fault.response

    def __str__(self) -> str:
        return f"{self.fault.value}: {self.message} -> {self.response.value}"


class Watch(NamedTuple):
    """Memory of the safety checks."""

    n_late: int  # missed deadlines in a row
    n_lost: np.ndarray  # (n_springs,) lost readings in a row
    n_suspect: np.ndarray  # (n_chambers,) ticks in a row in which a chamber seemed to have lost its pressure
    load_kg: float  # payload of the last tick


def check(
    controller: Controller, watch: Watch, belief: Belief, late: bool
) -> tuple[Watch, tuple[Event, ...]]:
    """Return the memory and the faults of a tick; `late` where the last one missed its deadline."""
    next_watch = Watch(
        n_late=watch.n_late + 1 if late else 0,
        n_lost=np.where(belief.lost, watch.n_lost + 1, 0),
        n_suspect=np.where(belief.suspect, watch.n_suspect + 1, 0),
        load_kg=belief.load.kg,
    )
    events = [*_of_time(controller, next_watch), *_of_sensors(controller, next_watch, belief)]
    if stop_of(events) is None:
        events += [*_of_chambers(controller, next_watch, belief), *_of_payload(controller, watch, belief)]
    return next_watch, tuple(events)


def stop_of(events: Iterable[Event]) -> Event | None:
    """Return the first event that ends a run, if there is one."""
    return next((event for event in events if event.response is Response.VENT), None)


def _of_time(controller: Controller, watch: Watch) -> Iterator[Event]:
    late = f"took too long, expected at most {1e3 * controller.dt_s:g} ms"
    if watch.n_late:
        yield Event(Fault.MISSED_DEADLINE, f"the last tick {late}")
    if watch.n_late >= controller.config.late_ticks:
        yield Event(Fault.ARM_LATE, f"{watch.n_late} ticks in a row {late}")


def _of_sensors(controller: Controller, watch: Watch, belief: Belief) -> Iterator[Event]:
    config, gone = controller.config, watch.n_lost >= controller.config.lost_ticks
    if belief.lost.any():
        yield Event(Fault.LOST_READING, belief.why_lost)
    if gone.any():
        text = f"{names('spring', gone)}: no length in {config.lost_ticks} ticks in a row"
        yield Event(Fault.SENSOR_LOST, text)
    elif belief.stuck.any():
        text = f"{names('spring', belief.stuck)}: moved less than {1e3 * config.stuck_range_m:g} mm in "
        text += f"{controller.window * controller.dt_s:g} s, noise included, while the chamber was driven or "
        yield Event(Fault.SENSOR_STUCK, f"{text}the section moved")


def lost_chambers(controller: Controller, watch: Watch, belief: Belief) -> np.ndarray:
    """Return which chambers (n_chambers,) have been suspected for so long that they count as lost."""
    config = controller.config
    n_windows = config.rest_windows if belief.at_rest else config.moving_windows
    return watch.n_suspect >= n_windows * controller.window


def _of_chambers(controller: Controller, watch: Watch, belief: Belief) -> Iterator[Event]:
    lost = lost_chambers(controller, watch, belief)
    if lost.any():
        kpa = ", ".join(f"{value:.1f}" for value in belief.command.pressure_kpa[lost])
        text = f"{names('chamber', lost)}: at {kpa} kPa, but the springs lie as they would without that"
        yield Event(Fault.CHAMBER_LOST, text)


def _of_payload(controller: Controller, watch: Watch, belief: Belief) -> Iterator[Event]:
    """Yield the faults of a payload that was estimated in this tick; `watch` is the last tick's."""
    if belief.estimate_kg is None:
        return
    load, most_kg = belief.load, float(controller.policy.load_estimator.load_scale_kg)
    config, believed = controller.config, f"the pose is estimated with {1e3 * load.believed_kg:.0f} g"
    if not holds_payload(belief.estimate_kg, belief.width_kg, most_kg):
        text = f"springs and pressures give {1e3 * belief.estimate_kg:.0f} g, {believed}"
        yield Event(Fault.LOAD_UNKNOWN, text)
    elif belief.width_kg > config.load_known * most_kg:
        text = f"payload not known better than {1e3 * belief.width_kg:.0f} g, expected "
        text += f"{1e3 * config.load_known * most_kg:.0f} g: record more random poses; "
        yield Event(Fault.LOAD_UNKNOWN, text + believed)
    if load.began and load.kg < watch.load_kg:
        text = f"{1e3 * load.believed_kg:.0f} g, from {1e3 * watch.load_kg:.0f} g before"
        yield Event(Fault.LOAD_LOST, text)
    if load.kg - load.half_width_kg > config.overload * most_kg:
        told = f"{1e3 * load.kg:.0f} +- {1e3 * load.half_width_kg:.0f} g"
        yield Event(Fault.OVERLOADED, f"{told}, expected at most {1e3 * most_kg:.0f} g")


def extrapolated(belief: Belief) -> tuple[Event, ...]:
    """Return the fault of a pose far from the training rows of the sim-to-real network, before an action."""
    if not belief.away > 1.0:
        return ()
    text = f"{belief.away:.1f} times as far from the training rows as the network is believed"
    return (Event(Fault.EXTRAPOLATION, text),)


def unsettled(belief: Belief) -> tuple[Event, ...]:
    """Return the faults of the springs as they stand before the next action."""
    # Errors at the chambers: springs of an arm with redundant chambers cannot all be on any references
    controller, command, mask, events = belief.controller, belief.command, belief.saturated, []
    off_m, allocation = belief.mean_m - command.reference_m, controller.policy.gains.allocation
    if allocation is not None:
        off_m = -allocated_error(-off_m, command.pressure_kpa, allocation)

    if not belief.settled:
        worst = int(np.argmax(np.where(mask, 0.0, np.abs(off_m))))
        where = f"{'spring' if allocation is None else 'chamber'}{worst}"
        text = f"after {controller.config.settle_timeout_s:g} s, {where} is {1e3 * off_m[worst]:+.1f} mm"
        events.append(Event(Fault.NOT_SETTLED, f"{text} off its reference"))
    if mask.any():
        off = ", ".join(f"{1e3 * value:+.1f}" for value in off_m[mask])
        text = f"{names('chamber', mask)}: at the limit, spring {off} mm off its reference"
        events.append(Event(Fault.SATURATED, text))
    return tuple(events)


def names(kind: str, mask: np.ndarray) -> str:
    """Return the names of springs or chambers of a mask (n,)."""
    return ", ".join(f"{kind}{k}" for k in np.flatnonzero(mask))
