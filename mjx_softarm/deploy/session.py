"""The control loop on an arm: the thin shell of input, output and time around `mjx_softarm.deploy.loop`.

A simulated arm has a clock of its own, `time_s`, that passes as pressures are written; a run on it is as
fast as the machine and late only if that clock says so. A real arm has none: there the loop waits for each
tick.

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
from mjx_softarm.deploy.controller import Controller, Phase, State, Tick, start
from mjx_softarm.deploy.faults import LATE_TICKS, Event, Fault
from mjx_softarm.deploy.loop import believed, step, with_goal
from mjx_softarm.logs.schema import Log
from mjx_softarm.sensing.pose import pose_error
from mjx_softarm.sensing.sensors import Sensor

_ROUNDING_S = 1e-6  # by which a simulated tick may be longer than the period


class ArmLost(Exception):
    """The driver cannot reach the arm, or refuses what it is told."""


def read(arm: ArmIO, n: int) -> np.ndarray | None:
    """Return the sensors' readings (n,), or None where they did not come in time.

    Raises:
        ArmLost: the sensors cannot be reached, or it is another number of them.
    """
    try:
        readings = np.asarray(arm.read_sensors(), float)
    except TimeoutError:
        return None
    except OSError as error:
        raise ArmLost(f"read_sensors: {error}") from error
    if readings.shape != (n,):
        raise ArmLost(f"read_sensors: got shape {readings.shape}, expected ({n},)")
    return readings


class Pumps:
    """Writes pressures and knows which are in force."""

    def __init__(self, arm: ArmIO, n: int):
        self._arm, self._n_late = arm, 0
        self.pressure_kpa = np.zeros(n)

    def write(self, pressure_kpa: np.ndarray) -> bool:
        """Command pressures (n,) [kPa]; returns whether they were taken in time.

        Raises:
            ArmLost: the pumps cannot be reached, or the driver refuses the pressures.
        """
        try:
            self._arm.write_pressures(pressure_kpa)
        except TimeoutError as error:
            self._n_late += 1
            if self._n_late > 2 * LATE_TICKS:
                raise ArmLost(f"write_pressures: not in time {self._n_late} times in a row") from error
            return False
        except (OSError, ValueError) as error:
            raise ArmLost(f"write_pressures: {error}") from error
        self._n_late, self.pressure_kpa = 0, pressure_kpa
        return True


class Clock:
    """Time on an arm: its own if it has one, else this machine's."""

    def __init__(self, arm: Any):
        self._arm = arm if hasattr(arm, "time_s") else None

    def now(self) -> float:
        return time.monotonic() if self._arm is None else float(self._arm.time_s)

    def wait_until(self, time_s: float) -> None:
        """Sleep; a simulated arm is never waited for."""
        if self._arm is None:
            time.sleep(max(0.0, time_s - time.monotonic()))


class Recorder:
    """Rows of a log in the making."""

    def __init__(self, arm: Any):
        self._measured = getattr(arm, "pressures", None)
        self._capture = getattr(arm, "motion_capture", None)
        self._rows: list[dict[str, Any]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def look(self, time_s: float, pressure_kpa: np.ndarray) -> dict[str, Any]:
        """What there is to log of now; the pressures (n,) are those commanded, if the arm measures none."""
        row: dict[str, Any] = {"time_s": time_s}
        row["pressure_kpa"] = pressure_kpa if self._measured is None else self._measured()
        if self._capture is not None:
            seen = self._capture()
            row |= {name: value for name, value in seen._asdict().items() if value is not None}
        return row

    def add(self, row: dict[str, Any]) -> None:
        """Keep a row; all rows have the same entries."""
        self._rows.append(row)

    def log(self, source: str, sensor: Sensor) -> Log:
        """Return the log so far of an arm with this sensor, with time counted from its first row."""
        names = self._rows[0] if self._rows else {"time_s": 0.0}
        arrays = {name: np.array([row[name] for row in self._rows], float) for name in names}
        arrays["time_s"] = arrays["time_s"] - arrays["time_s"][:1]
        row = np.arange(2, len(self) + 2)
        return Log(source=source, row=row, reading_name=sensor.reading_name, **arrays)


class Arrival(NamedTuple):
    """A goal that had all its actions."""

    goal: np.ndarray  # (6,) [mm, deg]
    estimate: np.ndarray  # (6,) [mm, deg] pose believed in
    row: int  # index of the log's row


class Run(NamedTuple):
    """What a run gave."""

    log: Log
    arrivals: tuple[Arrival, ...]
    events: tuple[Event, ...]
    latency_s: np.ndarray  # (ticks,) from readings to pressures, without the arm's input and output
    phase: (
        Phase  # HOLD: ended with the last pressures in force; DONE: vented; else not even that could be done
    )
    interrupted: bool

    def counts(self) -> dict[Fault, int]:
        """How often each fault came."""
        return dict(Counter(event.fault for event in self.events))


def follow(
    arm: ArmIO,
    controller: Controller,
    goals: Iterable[np.ndarray],
    duration_s: float | None = None,
    tell: Callable[[str], None] = lambda text: None,
    arrived: Callable[[int], None] = lambda goal: None,
) -> Run:
    """Bring the tip to goals, one after the other, then vent.

    Ctrl-C vents, a second one ends at once; both keep the log.

    Args:
        arm: without pressure, as its driver gives it.
        controller: the policy.
        goals: poses (6,) [mm, deg].
        duration_s: vent after so long, wherever the arm is.
        tell: takes a line for each arrival and each fault.
        arrived: takes the index of each goal arrived at, as the arm rests there; for what a gripper does.
    """
    session = _Session(arm, controller, goals, duration_s, tell, arrived)
    try:
        session.run()
    except KeyboardInterrupt:
        session.interrupted = True
        tell("interrupted -> vent")
        session.state = session.state._replace(phase=Phase.VENT)
        try:
            session.run()
        except KeyboardInterrupt:
            tell("interrupted again -> end")
    return Run(
        log=session.rows.log("run", controller.policy.sensor),
        arrivals=tuple(session.arrivals),
        events=tuple(session.events),
        latency_s=np.array(session.latency_s),
        phase=session.state.phase,
        interrupted=session.interrupted,
    )


class _Session:
    """The mutable middle of `follow`."""

    def __init__(self, arm, controller: Controller, goals, duration_s: float | None, tell, arrived):
        self.arm, self.controller, self.tell, self.arrived = arm, controller, tell, arrived
        self.goals, self.duration_s, self.n_taken = list(goals), duration_s, 0
        self.clock, self.rows = Clock(arm), Recorder(arm)
        self.state: State = start(controller)
        self.pumps = Pumps(arm, len(self.state.pressure_kpa))
        self.began_s = self.clock.now()
        self.arrivals: list[Arrival] = []
        self.events: list[Event] = []
        self.latency_s: list[float] = []
        self.last: set[Fault] = set()
        self.late = self.interrupted = False

    def run(self) -> None:
        while self.state.phase in (Phase.RUN, Phase.VENT):
            begin_s = self.clock.now()
            try:
                in_time = self._tick(begin_s)
            except ArmLost as error:
                self._note([Event(Fault.ARM_LOST, str(error))])
                self.state = self.state._replace(phase=Phase.HOLD)
                return
            self.late = not in_time or self.clock.now() - begin_s > self.controller.dt_s + _ROUNDING_S
            self.clock.wait_until(begin_s + self.controller.dt_s)

    def _tick(self, begin_s: float) -> bool:
        """Returns whether the arm took the pressures in time."""
        self._next_goal(begin_s)
        goal = self.state.goal
        readings = self._read()
        row = self.rows.look(begin_s, self.state.pressure_kpa)
        began = time.perf_counter()
        self.state, tick = step(self.controller, self.state, readings, self.late)
        self.latency_s.append(time.perf_counter() - began)
        try:
            return self.state.phase is Phase.HOLD or self._write()
        finally:  # whatever became of the pressures, they did not wait for this
            self._keep(row, readings, goal, tick)

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

    def _write(self) -> bool:
        in_time = self.pumps.write(self.state.pressure_kpa)
        if not in_time:  # the ones before are still in force
            phase = Phase.VENT if self.state.phase is Phase.DONE else self.state.phase
            self.state = self.state._replace(phase=phase, pressure_kpa=self.pumps.pressure_kpa)
        return in_time

    def _read(self) -> np.ndarray | None:
        try:
            return read(self.arm, len(self.state.pressure_kpa))
        except ArmLost:
            if self.state.phase is Phase.VENT:  # it needs the pumps alone
                return None
            raise

    def _next_goal(self, now_s: float) -> None:
        """Take the next goal that is not refused; vent where there is none, or no time."""
        if self.state.phase is not Phase.RUN:
            return
        while self.state.goal is None and self.n_taken < len(self.goals):
            self.state, events = with_goal(self.controller, self.state, self.goals[self.n_taken])
            self.n_taken += 1
            self._note(events)
        over = self.duration_s is not None and now_s - self.began_s >= self.duration_s
        if over or self.state.goal is None:
            self.state = self.state._replace(phase=Phase.VENT)

    def _note(self, events: Sequence[Event]) -> None:
        """Count events; tell each but those that only repeat the tick before."""
        for event in events:
            if event.fault not in self.last:
                self.tell(f"{len(self.rows) * self.controller.dt_s:.2f} s: {event}")
        self.last = {event.fault for event in events}
        self.events.extend(events)

    def _arrive(self, goal: np.ndarray, estimate: np.ndarray) -> None:
        error = pose_error(np.asarray(estimate, float), goal)
        self.arrivals.append(Arrival(goal, estimate, len(self.rows) - 1))
        self.tell(
            f"{len(self.rows) * self.controller.dt_s:.2f} s: goal {len(self.arrivals)}: estimated "
            f"{np.linalg.norm(error[:3]):.1f} mm off; yaw, pitch, roll "
            + ", ".join(f"{value:+.1f}" for value in error[3:])
            + " deg off"
        )
        self.arrived(self.n_taken - 1)
