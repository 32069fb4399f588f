"""The control loop on an arm: input, output and time around the pure `mjx_softarm.deploy.loop`.

Measured pressures and motion capture are logged where the arm offers them. Control does not use motion
capture, and uses measured pressures only to estimate the payload.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.ending import DONE, MISSED, Ending, vent_at_end
from mjx_softarm.deploy.goals import ListedGoals, MovingGoal, Order, OrderedGoals
from mjx_softarm.deploy.link import ArmFault, Link, Recorder
from mjx_softarm.deploy.loop import LoopState, in_force, start, step
from mjx_softarm.deploy.safety import PAYLOAD_FAULTS, Event, Fault, Response, stop_of
from mjx_softarm.logs.schema import Log
from mjx_softarm.mdp.rewards import weighted_error
from mjx_softarm.sensing.pose import pose_error, seen_error

_ROUNDING_S = 1e-6  # rounding error of a simulated tick's duration
_KEPT = 1000  # number of rows, arrivals and faults that a run without a log keeps


class Arrival(NamedTuple):
    """An arrival: the springs have settled after the last action towards a goal."""

    goal: np.ndarray  # (6,) [mm, deg]
    estimate: np.ndarray  # (6,) [mm, deg] believed pose
    row: int  # index of the log's row
    index: int  # index of the goal in the list of goals
    reached: bool = True  # within the policy's threshold of a goal, by motion capture if there is any


class LoopRun(NamedTuple):
    """Results of a run."""

    log: Log
    arrivals: tuple[Arrival, ...]
    events: tuple[Event, ...]
    latency_s: np.ndarray  # (ticks,) from readings to pressures, without the arm's input and output
    ending: Ending
    n_goals: int = 0  # number of goals that count; 0 in `steer`
    ways: tuple[slice, ...] = ()  # rows of the log in which the goal moved

    def counts(self) -> dict[Fault, int]:
        """Return the number of events of each fault."""
        return dict(Counter(event.fault for event in self.events))

    @property
    def status(self) -> int:
        """Exit status of the ending; after a good one `MISSED` if a goal was not reached or was refused."""
        n_reached = sum(arrival.reached for arrival in self.arrivals)
        return self.ending.status or (MISSED if n_reached < self.n_goals else DONE)


def follow(
    arm: ArmIO,
    controller: Controller,
    goals: Iterable[np.ndarray],
    duration_s: float = np.inf,
    tell: Callable[[str], None] = lambda text: None,
    arrived: Callable[[int], None] = lambda goal: None,
    save: Callable[[Log], None] = lambda log: None,
    stay: bool = False,
) -> LoopRun:
    """Bring the tip to goals, one after the other, then vent; `vent_at_end` says what else ends a run.

    Args:
        arm: without pressure, as its driver gives it.
        controller: the policy.
        goals: poses (6,) [mm, deg].
        duration_s: time after which the arm is vented, wherever it is.
        tell: takes a line for each arrival and each fault.
        arrived: takes the index of each goal arrived at, as the arm rests there; a gripper may act.
        save: writes the log, once the arm is vented.
        stay: hold the last goal until `duration_s` or something else ends the run.
    """
    listed = ListedGoals(controller.policy, goals, duration_s, stay)
    return _Session(arm, controller, listed, tell, arrived).to_end(save)


def trace(
    arm: ArmIO,
    controller: Controller,
    goals: np.ndarray,
    pace_s: float,
    stops: np.ndarray | bool = False,
    tell: Callable[[str], None] = lambda text: None,
    arrived: Callable[[int], None] = lambda goal: None,
    save: Callable[[Log], None] = lambda log: None,
) -> LoopRun:
    """Bring the tip from stop to stop, past the goals in between, then vent.

    Args:
        arm: without pressure, as its driver gives it.
        controller: the policy.
        goals (p, 6) [mm, deg]: poses; between two of them the goal moves on a straight line.
        pace_s: time from a goal to the next.
        stops (p,): bool; the first and the last goal are stops in any case.
        tell, arrived, save: as for `follow`; stops are the goals that count.
    """
    goal = MovingGoal(controller, goals, np.broadcast_to(stops, len(goals)), pace_s)
    return _Session(arm, controller, goal, tell, arrived).to_end(save)


def steer(
    arm: Any,
    controller: Controller,
    orders: Callable[[], Order],
    look: Callable[[LoopState, dict[str, Any]], None] = lambda state, row: None,
    tell: Callable[[str], None] = lambda text: None,
    save: Callable[[Log], None] | None = None,
) -> LoopRun:
    """Steer an arm by somebody's orders until something ends the run, then vent.

    Without `save` only the newest rows, arrivals and faults are kept: the run may last for days.

    Args:
        arm: an `ArmIO` without pressure, as its driver gives it.
        controller: the policy.
        orders: returns the order for the next tick: "vent", "hold", goals (6,) [mm, deg] that replace all
            others, or None; called in each tick, so it may not wait.
        look: takes the state after each tick and the row that it logged; may not wait.
        tell, save: as for `follow`.
    """
    goals = OrderedGoals(controller.policy, orders)
    session = _Session(arm, controller, goals, tell, look=look, kept=None if save else _KEPT)
    return session.to_end(save or (lambda log: None))


class _Session:
    """A run: moves data between the arm, the loop, the goals and the log."""

    def __init__(
        self,
        arm: ArmIO,
        controller: Controller,
        goals: ListedGoals | MovingGoal,
        tell: Callable[[str], None],
        arrived: Callable[[int], None] = lambda goal: None,
        look: Callable[[LoopState, dict[str, Any]], None] = lambda state, row: None,
        kept: int | None = None,
    ):
        self.controller = controller
        self.goals = goals
        self.tell = tell
        self.arrived = arrived
        self.look = look
        self.state = start(controller)
        self.nothing = np.full(controller.policy.spec.n_springs, np.nan)
        self.link = Link(arm, controller.policy.spec, controller.dt_s)
        self.rows = Recorder(kept)
        self.arrivals: deque[Arrival] = deque(maxlen=kept)
        self.events: deque[Event] = deque(maxlen=kept)
        self.latency_s: deque[float] = deque(maxlen=kept)
        self.last: set[Fault] = set()  # faults that were reported and last

    def to_end(self, save: Callable[[Log], None]) -> LoopRun:
        """Run, vent and save the log; return the results."""
        ending = vent_at_end(
            self._run, self.link, self.tell, lambda: save(self._log()) if len(self.rows) else None
        )
        return LoopRun(
            self._log(),
            tuple(self.arrivals),
            tuple(self.events),
            np.array(self.latency_s),
            ending,
            self.goals.n_goals,
            tuple(self.goals.ways),
        )

    def _log(self) -> Log:
        return self.rows.log("run", self.controller.policy.sensor)

    def _run(self) -> None:
        """Go through the goals.

        Raises:
            ArmFault: a fault whose response is to vent.
        """
        if not self.link.measures:
            self.tell("payload: estimated from the commanded pressures, since the arm measures none")
        try:
            stop = self._ticks()
        except ArmFault as error:
            self.events.append(Event(Fault.ARM_LOST, str(error)))
            raise
        if stop is not None:
            raise ArmFault(self._stamped(f"{stop.fault.value}: {stop.message}"))

    def _ticks(self) -> Event | None:
        """Take ticks until the goals are over; return the event that ends the run before."""
        dt_s = self.controller.dt_s
        late = False
        while True:
            begin_s = self.link.now()
            state, refused = self.goals.advance(self.state, begin_s, len(self.rows))
            if refused:
                self._note(refused)
            if state is None:
                return None
            self.state = state
            stop, in_time = self._tick(begin_s, late)
            if stop is not None:
                return stop
            late = not in_time or self.link.now() - begin_s > dt_s + _ROUNDING_S
            self.link.wait_until(begin_s + dt_s)

    def _tick(self, begin_s: float, late: bool) -> tuple[Event | None, bool]:
        """Return the event that ends the run, and whether the arm took the pressures in time."""
        # Read the arm.
        goal = self.state.goal
        readings, row = self.link.read(begin_s)
        row["goal"] = np.full(6, np.nan) if goal is None else goal

        # Take a tick of the loop.
        began = time.perf_counter()
        try:
            self.state, events = step(self.state, readings, late, row["pressure_kpa"])
        except Exception:  # the row that explains it is kept
            self._add(row)
            raise
        self.latency_s.append(time.perf_counter() - began)

        # Write the pressures.
        stop = stop_of(events)
        try:
            in_time = stop is not None or self.link.write(self.state.command.pressure_kpa)
            self.state = in_force(self.state, self.link.pressure_kpa)
        finally:  # the row is kept even if the pressures were refused; logging comes after them
            self._add(row)
            self._note(events, self.state.belief.estimate_kg is not None)
            if self.state.arrived:
                self._arrive(row["goal"], row["estimate"])
            self.look(self.state, row)
        return stop, in_time

    def _add(self, row: dict[str, Any]) -> None:
        belief = self.state.belief
        reference_m = self.state.command.reference_m
        row["estimate"], row["load_kg"] = belief.pose, belief.load.believed_kg
        row["reference_m"] = self.nothing if reference_m is None else reference_m
        self.rows.add(row)

    def _note(self, events: Sequence[Event], estimated: bool = False) -> None:
        """Count events, and report those that are new in this tick; the end of the run says why it vents.

        Faults of the payload last until it is next estimated; `estimated` says whether it was.
        """
        for event in events:
            if event.fault not in self.last and event.fault.response is not Response.VENT:
                self.tell(self._stamped(event))
        lasting = set() if estimated else self.last & PAYLOAD_FAULTS
        self.last = lasting | {event.fault for event in events}
        self.events.extend(events)

    def _arrive(self, goal: np.ndarray, estimate: np.ndarray) -> None:
        # The error by motion capture over the window of rest, or else by the springs
        rows = self.rows.last(self.controller.window)
        tip_m = np.array([row.get("tip_m", np.full(3, np.nan)) for row in rows])
        quaternion = np.array([row.get("tip_quaternion", np.full(4, np.nan)) for row in rows])
        error, how = seen_error(tip_m, quaternion, goal), "motion capture"
        if np.isnan(error).any():
            error, how = pose_error(np.asarray(estimate, float), goal), "the springs"

        # Whether it is within what the goal allows
        reward = self.controller.policy.reward
        share = float(weighted_error(goal + error, goal, reward)) / reward.threshold
        reached = share < 1.0
        self.arrivals.append(Arrival(goal, estimate, len(self.rows) - 1, self.goals.n_taken - 1, reached))
        asked = np.where(reward.asked, error, 0.0)
        off = f"{np.linalg.norm(asked[:3]):.1f} mm off by {how}"
        if any(reward.asked[3:]):
            off += f"; yaw, pitch, roll {', '.join(f'{value:+.1f}' for value in asked[3:])} deg off"
        missed = "" if reached else f"; NOT REACHED, {share:.2f} times the error that a goal allows"
        self.tell(self._stamped(f"goal {len(self.arrivals)}: {off}{missed}"))
        self.arrived(self.goals.n_taken - 1)

    def _stamped(self, text: object) -> str:
        return f"{len(self.rows) * self.controller.dt_s:.2f} s: {text}"
