"""The control loop on an arm: input, output and time around the pure `mjx_softarm.deploy.loop`.

An arm that offers `pressures()`, what its regulators measure, or `motion_capture()` has both logged;
neither is used for control.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.controller import Controller, State, Tick, start
from mjx_softarm.deploy.ending import DONE, FAULT, Ending, vent_at_end
from mjx_softarm.deploy.faults import Event, Fault, Response
from mjx_softarm.deploy.link import ArmFault, Link, Recorder
from mjx_softarm.deploy.loop import believed, step, with_goal
from mjx_softarm.logs.schema import Log
from mjx_softarm.sensing.pose import pose_error

_ROUNDING_S = 1e-6  # by which a simulated tick may be longer than the period


class Arrival(NamedTuple):
    """A goal that had all its actions."""

    goal: np.ndarray  # (6,) [mm, deg]
    estimate: np.ndarray  # (6,) [mm, deg] pose believed in
    row: int  # index of the log's row


class Run(NamedTuple):
    """Results of a run."""

    log: Log
    arrivals: tuple[Arrival, ...]
    events: tuple[Event, ...]
    latency_s: np.ndarray  # (ticks,) from readings to pressures, without the arm's input and output
    ending: Ending

    def counts(self) -> dict[Fault, int]:
        """Return how often each fault came."""
        return dict(Counter(event.fault for event in self.events))

    @property
    def status(self) -> int:
        """Exit status: that of the ending, or of a fault if a goal was refused."""
        refused = any(event.response is not Response.GO_ON for event in self.events)
        return self.ending.status or (FAULT if refused else DONE)


def follow(
    arm: ArmIO,
    controller: Controller,
    goals: Iterable[np.ndarray],
    duration_s: float | None = None,
    tell: Callable[[str], None] = lambda text: None,
    arrived: Callable[[int], None] = lambda goal: None,
    save: Callable[[Log], None] = lambda log: None,
) -> Run:
    """Bring the tip to goals, one after the other, then vent; `vent_at_end` says what else ends a run.

    Args:
        arm: without pressure, as its driver gives it.
        controller: the policy.
        goals: poses (6,) [mm, deg].
        duration_s: vent after so long, wherever the arm is.
        tell: takes a line for each arrival and each fault.
        arrived: takes the index of each goal arrived at, as the arm rests there; for what a gripper does.
        save: writes the log, once the arm is vented.
    """
    session = _Session(arm, controller, goals, duration_s, tell, arrived)
    ending = vent_at_end(session.run, session.link, tell, lambda: save(session.log()))
    return Run(
        log=session.log(),
        arrivals=tuple(session.arrivals),
        events=tuple(session.events),
        latency_s=np.array(session.latency_s),
        ending=ending,
    )


class _Session:
    """Mutable state of `follow`."""

    def __init__(self, arm: ArmIO, controller: Controller, goals, duration_s: float | None, tell, arrived):
        self.controller, self.tell, self.arrived = controller, tell, arrived
        self.goals, self.duration_s, self.n_taken = list(goals), duration_s, 0
        self.state: State = start(controller)
        self.link, self.rows = Link(arm, len(self.state.pressure_kpa), controller.dt_s), Recorder()
        self.began_s = self.link.now()
        self.arrivals: list[Arrival] = []
        self.events: list[Event] = []
        self.latency_s: list[float] = []
        self.last: set[Fault] = set()
        self.late = False

    def run(self) -> None:
        """Go through the goals.

        Raises:
            ArmFault: a fault whose response is to vent.
        """
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
        goal = self.state.goal
        readings = self.link.read()
        row = self.link.look(begin_s)
        began = time.perf_counter()
        self.state, tick = step(self.controller, self.state, readings, self.late)
        self.latency_s.append(time.perf_counter() - began)
        try:
            in_time = tick.stop is not None or self.link.write(self.state.pressure_kpa)
            self.state = self.state._replace(pressure_kpa=self.link.pressure_kpa)
        finally:  # whatever became of the pressures, they did not wait for this
            self._keep(row, readings, goal, tick)
        if tick.stop is not None:
            raise _Stopped(self._at(f"{tick.stop.fault.value}: {tick.stop.message}"))
        return in_time

    def _keep(self, row: dict[str, Any], readings: np.ndarray | None, goal: Any, tick: Tick) -> None:
        """Log a tick and tell of it."""
        nothing = np.full(len(self.state.pressure_kpa), np.nan)
        row["readings"] = nothing if readings is None else readings
        row["estimate"], _ = believed(self.controller, tick.spring_m)
        row["reference_m"] = nothing if self.state.reference_m is None else self.state.reference_m
        row["goal"] = np.full(6, np.nan) if goal is None else goal
        self.rows.add(row)
        self._note(tick.events)
        if tick.arrived:
            self._arrive(row["goal"], row["estimate"])

    def _next_goal(self, now_s: float) -> bool:
        """Take the next accepted goal once the last is done; return False when goals or time are over."""
        while self.state.goal is None and self.n_taken < len(self.goals):
            self.state, events = with_goal(self.controller, self.state, self.goals[self.n_taken])
            self.n_taken += 1
            self._note(events)
        over = self.duration_s is not None and now_s - self.began_s >= self.duration_s
        return not over and self.state.goal is not None

    def _note(self, events: Sequence[Event]) -> None:
        """Count events; tell each but those that repeat the tick before, and those told at the end."""
        for event in events:
            if event.fault not in self.last and event.response is not Response.VENT:
                self.tell(self._at(event))
        self.last = {event.fault for event in events}
        self.events.extend(events)

    def _arrive(self, goal: np.ndarray, estimate: np.ndarray) -> None:
        error = pose_error(np.asarray(estimate, float), goal)
        self.arrivals.append(Arrival(goal, estimate, len(self.rows) - 1))
        angles = ", ".join(f"{value:+.1f}" for value in error[3:])
        off = f"estimated {np.linalg.norm(error[:3]):.1f} mm off; yaw, pitch, roll {angles} deg off"
        self.tell(self._at(f"goal {len(self.arrivals)}: {off}"))
        self.arrived(self.n_taken - 1)

    def _at(self, text: object) -> str:
        return f"{len(self.rows) * self.controller.dt_s:.2f} s: {text}"


class _Stopped(ArmFault):
    """A fault that the loop found and counted, and that ends the run."""
