"""The control loop on an arm: input, output and time around the pure `mjx_softarm.deploy.loop`.

An arm that offers `pressures()`, what its regulators measure, or `motion_capture()` has both logged;
motion capture is not used for control, pressures only to estimate the payload.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjx_softarm.deploy.acting import believed
from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.controller import LEAD_ACTIONS, Controller, State, Tick, start
from mjx_softarm.deploy.ending import Arrival, Run, vent_at_end
from mjx_softarm.deploy.faults import Event, Fault, Response
from mjx_softarm.deploy.link import ArmFault, Link, Recorder
from mjx_softarm.deploy.loop import hold, release, step, with_goal, with_moving_goal
from mjx_softarm.deploy.reachability import refusals
from mjx_softarm.deploy.way import Way
from mjx_softarm.logs.schema import Log
from mjx_softarm.mdp.rewards import scaled_error
from mjx_softarm.sensing.pose import pose_error, seen_error

_ROUNDING_S = 1e-6  # by which a simulated tick may be longer than the period
LEAD_S = 0.85  # of a moving goal before the tip, by policies of rest: they lag so on twins
_KEPT = 1000  # rows, arrivals and faults of a run without a log


class Orders(NamedTuple):
    """Orders for the next tick; where there are several, the safest one counts."""

    vent: bool = False  # let the pressures go to zero; a later goal brings the arm up again
    hold: bool = False  # give up the goals and hold the springs where they are
    goals: Sequence[np.ndarray] | None = None  # poses (6,) [mm, deg] in place of all others; None: as before


class Pilot(Protocol):
    """Someone who steers an arm while the loop runs. Neither method may wait: both run within a tick."""

    def orders(self) -> Orders:
        """Return the orders since the last tick."""
        ...

    def look(self, state: State, tick: Tick, row: dict[str, Any]) -> None:
        """Take a tick: the state after it, its results, and the row that it logged."""
        ...


def follow(
    arm: ArmIO,
    controller: Controller,
    goals: Iterable[np.ndarray],
    duration_s: float | None = None,
    tell: Callable[[str], None] = lambda text: None,
    arrived: Callable[[int], None] = lambda goal: None,
    save: Callable[[Log], None] = lambda log: None,
    stay: bool = False,
) -> Run:
    """Bring the tip to goals, one after the other, then vent; `vent_at_end` says what else ends a run.

    Args:
        arm: without pressure, as its driver gives it.
        controller: the policy.
        goals: poses (6,) [mm, deg].
        duration_s: vent after so long, wherever the arm is.
        tell: takes a line for each arrival and each fault.
        arrived: takes the index of each goal arrived at, as the arm rests there; a gripper may act.
        save: writes the log, once the arm is vented.
        stay: hold the last goal, for as long as `duration_s` or until something else ends the run.
    """
    return _Session(arm, controller, goals, duration_s, tell, arrived, stay).to_end(save)


def trace(
    arm: ArmIO,
    controller: Controller,
    goals: np.ndarray,
    pace_s: float,
    stops: np.ndarray | bool = False,
    tell: Callable[[str], None] = lambda text: None,
    arrived: Callable[[int], None] = lambda goal: None,
    save: Callable[[Log], None] = lambda log: None,
) -> Run:
    """Bring the tip from stop to stop, past the goals in between, then vent.

    Args:
        arm: without pressure, as its driver gives it.
        controller: the policy.
        goals (p, 6) [mm, deg]: poses; between two of them the goal moves on a straight line.
        pace_s: time from a goal to the next.
        stops (p,): bool; the first and the last goal are stops in any case.
        tell: takes a line for each arrival and each fault.
        arrived: takes the index of each stop arrived at, as the arm rests there; a gripper may act.
        save: writes the log, once the arm is vented.
    """
    lead_s = LEAD_ACTIONS * controller.policy.action_s or LEAD_S
    way = Way(goals, np.broadcast_to(stops, len(goals)), pace_s, lead_s)
    return _Session(arm, controller, goals, None, tell, arrived, way=way).to_end(save)


def steer(
    arm: Any,
    controller: Controller,
    pilot: Pilot,
    tell: Callable[[str], None] = lambda text: None,
    save: Callable[[Log], None] | None = None,
) -> Run:
    """Steer an `ArmIO` by a pilot's orders until something ends the run, then vent; arguments as of `follow`.

    Without `save` the run may last for days: only the newest rows, arrivals and faults are kept.
    """
    session = _Session(arm, controller, (), None, tell, pilot=pilot, kept=None if save else _KEPT)
    return session.to_end(save or (lambda log: None))


class _Session:
    """Mutable state of `follow` and `steer`."""

    def __init__(
        self,
        arm: ArmIO,
        controller: Controller,
        goals: Iterable[np.ndarray],
        duration_s: float | None,
        tell: Callable[[str], None],
        arrived: Callable[[int], None] = lambda goal: None,
        stay: bool = False,
        pilot: Pilot | None = None,
        kept: int | None = None,
        way: Way | None = None,
    ):
        self.controller, self.tell, self.arrived = controller, tell, arrived
        self.pilot, self.way = pilot, way
        self.goals, self.duration_s, self.n_taken, self.stay = list(goals), duration_s, 0, stay
        # Before the arm moves: it takes longer than a tick.
        self.refusals = refusals(controller.policy, self.goals)
        self.state: State = start(controller)
        self.link, self.rows = Link(arm, len(self.state.pressure_kpa), controller.dt_s), Recorder(kept)
        self.began_s = self.link.now()
        self.arrivals: deque[Arrival] = deque(maxlen=kept)
        self.events: deque[Event] = deque(maxlen=kept)
        self.latency_s: deque[float] = deque(maxlen=kept)
        self.last: set[Fault] = set()
        self.late = False

    def to_end(self, save: Callable[[Log], None]) -> Run:
        """Run, vent and save the log; return the results."""
        ending = vent_at_end(self.run, self.link, self.tell, lambda: save(self.log()))
        events, latency_s = tuple(self.events), np.array(self.latency_s)
        n_goals = 0 if self.pilot else len(self.way.stops if self.way else self.goals)
        rows = tuple(self.way.rows) if self.way else ()
        return Run(self.log(), tuple(self.arrivals), events, latency_s, ending, n_goals, rows)

    def run(self) -> None:
        """Go through the goals.

        Raises:
            ArmFault: a fault whose response is to vent.
        """
        if not self.link.measures:
            self.tell("payload: estimated from the commanded pressures, since the arm measures none")
        try:
            while True:
                begin_s = self.link.now()
                if not self._next_goal(begin_s):
                    return
                in_time = self._tick(begin_s)
                self.late = not in_time or self.link.now() - begin_s > self.controller.dt_s + _ROUNDING_S
                self.link.wait_until(begin_s + self.controller.dt_s)
        except _Stopped:
            raise
        except ArmFault as error:
            self.events.append(Event(Fault.ARM_LOST, str(error)))
            raise

    def log(self) -> Log:
        """Return the log so far."""
        return self.rows.log("run", self.controller.policy.sensor)

    def _tick(self, begin_s: float) -> bool:
        """Return whether the arm took the pressures in time."""
        goal = self.way.goal(begin_s) if self.way and self.state.moves else self.state.goal
        readings = self.link.read()
        row = self.link.look(begin_s)
        began = time.perf_counter()
        try:
            self.state, tick = step(self.controller, self.state, readings, self.late, row["pressure_kpa"])
        except Exception:  # the row that explains it is kept
            self._log(row, readings, goal, self.state.spring_m)
            raise
        self.latency_s.append(time.perf_counter() - began)
        try:
            in_time = tick.stop is not None or self.link.write(self.state.pressure_kpa)
            self.state = self.state._replace(pressure_kpa=self.link.pressure_kpa)
        finally:  # the row is kept even if the pressures were refused; logging comes after them
            self._keep(row, readings, goal, tick)
        if tick.stop is not None:
            raise _Stopped(self._at(f"{tick.stop.fault.value}: {tick.stop.message}"))
        return in_time

    def _keep(self, row: dict[str, Any], readings: np.ndarray | None, goal: Any, tick: Tick) -> None:
        """Log a tick and tell of it."""
        self._log(row, readings, goal, tick.spring_m)
        self._note(tick.events)
        if tick.arrived:
            self._arrive(row["goal"], row["estimate"])
        if self.pilot:
            self.pilot.look(self.state, tick, row)

    def _log(self, row: dict[str, Any], readings: np.ndarray | None, goal: Any, spring_m: np.ndarray) -> None:
        nothing = np.full(len(self.state.pressure_kpa), np.nan)
        row["readings"] = nothing if readings is None else readings
        row["estimate"], _ = believed(self.controller, spring_m, self.state.load)
        row["load_kg"] = self.state.load.believed_kg
        row["reference_m"] = nothing if self.state.reference_m is None else self.state.reference_m
        row["goal"] = np.full(6, np.nan) if goal is None else goal
        self.rows.add(row)

    def _next_goal(self, now_s: float) -> bool:
        """Take the next accepted goal once the last is done; return False when goals or time are over."""
        if self.pilot:
            self._obey(self.pilot.orders())
        if self.way:
            self._go_along(self.way, now_s)
        while self.state.goal is None and self.n_taken < len(self.goals):
            goal, refusal = self.goals[self.n_taken], self.refusals.get(self.n_taken)
            self.n_taken += 1
            events = (refusal,) if refusal else ()
            if not refusal:
                self.state, events = with_goal(self.controller, self.state, goal)
            self._note(events)
        over = self.duration_s is not None and now_s - self.began_s >= self.duration_s
        stays = self.pilot is not None or (self.stay and len(self.arrivals) > 0)
        return not over and (self.state.goal is not None or stays)

    def _go_along(self, way: Way, now_s: float) -> None:
        """Move the goal along a way, from an arrival at a stop until the goal is at the next."""
        if self.refusals and not self.n_taken:  # no part of the way is gone
            self._note(tuple(self.refusals.values()))
            self.n_taken = len(self.goals)
        begins = self.state.goal is None and 0 < self.n_taken < len(self.goals)
        if begins:
            self.n_taken = 1 + way.begin(self.n_taken - 1, now_s, len(self.rows))
        if not (begins or self.state.moves):
            return
        if way.go_on(now_s, len(self.rows)):
            self.state = with_moving_goal(self.state, way.goal_ahead(now_s))
        else:
            self.state, events = with_goal(self.controller, self.state, self.goals[self.n_taken - 1])
            self._note(events)

    def _obey(self, orders: Orders) -> None:
        if orders.vent or orders.hold:
            self.goals, self.n_taken = [], 0
            self.state = release(self.state) if orders.vent else hold(self.state)
        elif orders.goals is not None:
            self.goals, self.n_taken = list(orders.goals), 0
            self.state = self.state._replace(goal=None)

    def _note(self, events: Sequence[Event]) -> None:
        """Count events; tell each but those that repeat the tick before, and those told at the end."""
        for event in events:
            if event.fault not in self.last and event.response is not Response.VENT:
                self.tell(self._at(event))
        self.last = {event.fault for event in events}
        self.events.extend(events)

    def _arrive(self, goal: np.ndarray, estimate: np.ndarray) -> None:
        error, how = self._seen_error(goal), "motion capture"
        if np.isnan(error).any():
            error, how = pose_error(np.asarray(estimate, float), goal), "the springs"
        reward = self.controller.policy.reward
        reached = bool(np.linalg.norm(scaled_error(goal + error, goal, reward)) < reward.threshold)
        self.arrivals.append(Arrival(goal, estimate, len(self.rows) - 1, self.n_taken - 1, reached))
        angles = ", ".join(f"{value:+.1f}" for value in error[3:])
        off = f"{np.linalg.norm(error[:3]):.1f} mm off by {how}; yaw, pitch, roll {angles} deg off"
        missed = "" if reached else "; NOT REACHED"
        self.tell(self._at(f"goal {len(self.arrivals)}: {off}{missed}"))
        self.arrived(self.n_taken - 1)

    def _seen_error(self, goal: np.ndarray) -> np.ndarray:
        """Return the error (6,) [mm, deg] by motion capture over the window of rest, NaN without."""
        rows = [row for row in self.rows.last(self.controller.window) if "tip_m" in row]
        if not rows:
            return np.full(6, np.nan)
        tip_m, quaternion = (np.array([row[name] for row in rows]) for name in ("tip_m", "tip_quaternion"))
        return seen_error(tip_m, quaternion, goal)

    def _at(self, text: object) -> str:
        return f"{len(self.rows) * self.controller.dt_s:.2f} s: {text}"


class _Stopped(ArmFault):
    """A fault that the loop found and counted, and that ends the run."""
