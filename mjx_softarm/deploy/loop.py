"""One tick of the control loop: readings in, pressures and faults out. Pure; NumPy only.

    readings -> spring lengths; at rest: spring lengths, pressures -> payload
    spring lengths, payload -> pose of the tip (estimator, then sim-to-real network)
    at rest: pose, goal -> policy -> references;    every tick: references -> sensor-space law -> pressures

A policy that was trained on arms at rest acts on arms at rest: at once when a goal is new, and again
whenever the springs have settled, at most `Policy.n_actions` times for a goal. Springs have settled when,
for a window of half a second, each one is on its reference or its chamber at a limit, and none moves. Where
that takes longer than `faults.SETTLE_TIMEOUT_S`, it is counted and the policy acts all the same. What stands
when the springs have settled for the last time is the arrival. A policy that was trained in motion acts
every `Policy.action_s` seconds, as often, and arrives when the springs have settled after that.

A goal may also move, from tick to tick. Towards it, a policy that was trained on arms at rest takes all its
actions at once, in the mind: each leads on from the pose that the references of the one before make. One that
was trained in motion acts as ever. Where the goal stops moving, it becomes an ordinary one.

The policy takes an arm as specified to a goal; one that observes the payload, an arm with the estimated
payload. What is left of the way shows, when the springs have settled, in the pose that its references make:
the goal is shifted by as much from then on. A policy that learned few goals may answer a shifted one wrongly.
So where its references would leave more than the last ones, and more than a goal allows, the goal is shifted
by less; if a quarter is no better, the arm has arrived. A policy of motion seldom settles between its
actions, so its next goals are shifted too, at most by `acting.MAX_KEPT`; a moving one with each action by a
small share of how far the tip is beside the goal's way.

Gains, limits, calibration, rate, tolerance and number of actions are the policy file's.
`mjx_softarm.deploy.faults` says what can go wrong.
"""

from __future__ import annotations

import numpy as np

from mjx_softarm.control import LawState, pressures
from mjx_softarm.deploy import faults
from mjx_softarm.deploy.acting import chase, go, names
from mjx_softarm.deploy.controller import NONE_DUE, Controller, State, Tick
from mjx_softarm.deploy.faults import Event, Fault, Response
from mjx_softarm.deploy.link import vented
from mjx_softarm.deploy.reachability import nearest
from mjx_softarm.sensing.load import HIGHEST, LOWEST, Load, averaged, estimate_load

# A chamber counts as lost after so many windows in a row: of an arm at rest, and of one that moves, whose
# springs and pressures come after their references.
REST_WINDOWS, MOVING_WINDOWS = 2, 6
OVERLOAD = 1.4  # times the largest payload; estimates of exactly that exceeded it in 4 of 36 runs on twins


def with_goal(controller: Controller, state: State, goal: np.ndarray) -> tuple[State, tuple[Event, ...]]:
    """Return the state with a goal (6,) [mm, deg]; unchanged, with an event, if the goal is refused."""
    goal = np.asarray(goal, float)
    text = ", ".join(f"{value:g}" for value in goal)
    if goal.shape != (6,) or not np.isfinite(goal).all():
        return state, (Event(Fault.GOAL_OUTSIDE, f"got {text}, expected six finite numbers"),)
    pose, away = nearest(controller.reachable, goal, controller.policy.reward)
    if away > 1.0:
        near = ", ".join(f"{value:.0f}" for value in pose)
        far = f"{text} is {away:.1f} times as far from the nearest reachable pose as a goal may be"
        return state, (Event(Fault.GOAL_OUTSIDE, f"{far}; that pose is {near} [mm, deg]"),)
    return state._replace(goal=goal, moves=False, n_actions=0, n_ticks=0, due=NONE_DUE), ()


def with_moving_goal(state: State, goal: np.ndarray) -> State:
    """Return the state with where a moving goal (6,) [mm, deg], all of whose way is reachable, is now."""
    return state._replace(goal=goal, moves=True)


def hold(state: State) -> State:
    """Return the state without a goal, the springs held as they were read last.

    An arm without references, which has no pressure or is being vented, stays so.
    """
    if state.reference_m is None or np.isnan(state.spring_m).any():
        return state._replace(goal=None)
    return state._replace(goal=None, reference_m=state.spring_m, n_ticks=0)


def release(state: State) -> State:
    """Return the state without goal and references, in which the pressures go to zero along the ramp."""
    return state._replace(goal=None, reference_m=None)


def step(
    controller: Controller,
    state: State,
    readings: np.ndarray | None,
    late: bool,
    measured_kpa: np.ndarray | None = None,
) -> tuple[State, Tick]:
    """Take one tick.

    Args:
        controller: the policy.
        state: after the last tick; its pressures are in force.
        readings (n,): of the sensors, or None where none came in time.
        late: the last tick missed its deadline.
        measured_kpa (n,) [kPa]: of the chambers; NaN, or None for all, where only those in force are known.

    Returns:
        The next state, whose pressures are to be written unless the tick says stop, and the tick.
    """
    state = state._replace(n_late=state.n_late + 1 if late else 0)
    events = _deadline(controller, state.n_late)
    state, found = _sense(controller, state, readings, measured_kpa)
    events += found

    arrived = False
    known, at_rest = not np.isnan(state.spring_m).any(), _at_rest(controller, state)
    if known and not _stops(events):
        state, found = _check_chambers(controller, state, at_rest)
        events += found
        state, found = _weigh(controller, state, at_rest)
        events += found
    if known and not _stops(events) and state.goal is not None and not state.n_lost.any():
        if state.moves:
            state = chase(controller, state)
        else:
            state, found, arrived = go(controller, state, at_rest)
            events += found
    if not _stops(events):
        state = _with_pressures(controller, state)
    return state, Tick(state.spring_m, tuple(events), arrived)


def _with_pressures(controller: Controller, state: State) -> State:
    """Return the state with the next pressures: the law's; nearer to zero where there are no references."""
    if state.reference_m is None:
        lower_kpa = vented(state.pressure_kpa, controller.dt_s)
        return state._replace(pressure_kpa=lower_kpa, law=LawState.at_rest(lower_kpa, state.spring_m))
    law = state.law
    if np.isnan(law.length_m).any():  # these are the first lengths that were read
        law = LawState.at_rest(state.pressure_kpa, state.spring_m)
    pressure_kpa, law = pressures(
        state.reference_m, state.spring_m, law, controller.policy.gains, controller.dt_s
    )
    return state._replace(pressure_kpa=pressure_kpa, law=law, n_ticks=state.n_ticks + 1)


def _stops(events: list[Event]) -> bool:
    return any(event.response is Response.VENT for event in events)


def _deadline(controller: Controller, n_late: int) -> list[Event]:
    late = f"took too long, expected at most {1e3 * controller.dt_s:g} ms"
    missed = [Event(Fault.MISSED_DEADLINE, f"the last tick {late}")] if n_late else []
    if n_late >= faults.LATE_TICKS:
        missed.append(Event(Fault.ARM_LATE, f"{n_late} ticks in a row {late}"))
    return missed


def _sense(
    controller: Controller, state: State, readings: np.ndarray | None, measured_kpa: np.ndarray | None
) -> tuple[State, list[Event]]:
    """Return the state with new spring lengths, the last good one where there is none, and sensor faults."""
    spring_m, lost, text = faults.read_lengths(controller.policy.sensor, readings, state.spring_m)
    events = [Event(Fault.LOST_READING, text)] if lost.any() else []
    window, kpa = controller.window, state.pressure_kpa
    if measured_kpa is not None:
        kpa = np.where(np.isfinite(measured_kpa), measured_kpa, kpa)
    state = state._replace(
        spring_m=spring_m,
        n_lost=np.where(lost, state.n_lost + 1, 0),
        springs_m=np.concat([state.springs_m[1 - window :], spring_m[None]]),
        pressures_kpa=np.concat([state.pressures_kpa[1 - window :], state.pressure_kpa[None]]),
        chambers_kpa=np.concat([state.chambers_kpa[1 - window :], kpa[None]]),
    )
    gone = state.n_lost >= faults.LOST_TICKS
    if gone.any():
        message = f"{names('spring', gone)}: no length in {faults.LOST_TICKS} ticks in a row"
        events.append(Event(Fault.SENSOR_LOST, message))
    elif len(state.springs_m) == window:
        stuck = faults.stuck_springs(state.springs_m, state.pressures_kpa)
        if stuck.any():
            seconds = window * controller.dt_s
            message = (
                f"{names('spring', stuck)}: moved less than {1e3 * faults.STUCK_RANGE_M:g} mm in "
                f"{seconds:g} s, noise included, while the chamber was driven or the section moved"
            )
            events.append(Event(Fault.SENSOR_STUCK, message))
    return state, events


def _at_rest(controller: Controller, state: State) -> bool:
    """Return whether nothing has moved for a window; one after the last action, at the earliest."""
    full = len(state.springs_m) == controller.window and state.n_ticks >= controller.window
    return full and bool(faults.still(state.springs_m))


def _check_chambers(controller: Controller, state: State, at_rest: bool) -> tuple[State, list[Event]]:
    if state.reference_m is None:
        return state._replace(n_suspect=np.zeros_like(state.n_suspect)), []
    policy = controller.policy
    seen = state.pressure_kpa, state.reference_m, state.spring_m
    suspect = faults.lost_chambers(policy.spring_model, policy.gains, *seen, policy.tolerance_m)
    state = state._replace(n_suspect=np.where(suspect, state.n_suspect + 1, 0))
    lost = state.n_suspect >= (REST_WINDOWS if at_rest else MOVING_WINDOWS) * controller.window
    if not lost.any():
        return state, []
    kpa = ", ".join(f"{value:.1f}" for value in state.pressure_kpa[lost])
    message = f"{names('chamber', lost)}: at {kpa} kPa, but the springs lie as they would without that"
    return state, [Event(Fault.CHAMBER_LOST, message)]


def _weigh(controller: Controller, state: State, at_rest: bool) -> tuple[State, list[Event]]:
    """Return the state with the payload estimated from a window at rest; windows do not overlap."""
    state = state._replace(n_unweighed=state.n_unweighed + 1)
    unsure = state.n_suspect.any() or state.n_lost.any()
    if not at_rest or unsure or state.n_unweighed < controller.window:
        return state, []
    policy, before = controller.policy, state.load
    own_kg, most_kg = policy.spec.mass.payload_kg, float(policy.load_estimator.load_scale_kg)
    estimate_kg = float(
        estimate_load(policy.load_estimator, state.springs_m.mean(axis=0), state.chambers_kpa.mean(axis=0))
    )
    events = []
    if LOWEST * most_kg <= estimate_kg <= HIGHEST * most_kg:
        load = averaged(before, estimate_kg, most_kg)
    else:
        load, got = Load(own_kg), f"springs and pressures give {1e3 * estimate_kg:.0f} g"
        message = f"{got}, the pose is estimated from the springs alone, with {1e3 * own_kg:.0f} g"
        events.append(Event(Fault.LOAD_UNKNOWN, message))
    if load.began and load.kg < before.kg:
        message = f"{1e3 * load.believed_kg:.0f} g, from {1e3 * before.kg:.0f} g before"
        events.append(Event(Fault.LOAD_LOST, message))
    if load.kg > OVERLOAD * most_kg:
        message = f"{1e3 * load.kg:.0f} g, expected at most {1e3 * most_kg:.0f} g"
        events.append(Event(Fault.OVERLOADED, message))
    return state._replace(load=load, n_unweighed=0), events
