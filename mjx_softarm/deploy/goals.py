"""Goals of a run: from a list, along a way past poses, or by a pilot's orders."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.loop import LoopState, Tick, hold, release, with_goal, with_moving_goal
from mjx_softarm.deploy.lost import GoalSearch
from mjx_softarm.deploy.safety import Event
from mjx_softarm.sensing.pose import pose_error

Note = Callable[[Sequence[Event]], None]


class ListedGoals:
    """Goals one after the other, as `follow` takes them; goals in `refused`, by index, are skipped."""

    ways = ()  # rows of the log in which the goal moved

    def __init__(
        self,
        controller: Controller,
        goals: Iterable[np.ndarray],
        refused: Mapping[int, Event],
        duration_s: float | None = None,
        stay: bool = False,
    ):
        self._controller, self._goals, self._refused = controller, list(goals), refused
        self._duration_s, self._began_s, self._stays, self._accepted = duration_s, np.nan, stay, False
        self.n_goals, self.n_taken = len(self._goals), 0
        self._search: GoalSearch | None = None

    def advance(self, state: LoopState, now_s: float, row: int, note: Note) -> LoopState | None:
        """Return the state with the goal of a tick, None where the run is over.

        Args:
            state: after the last tick.
            now_s: time.
            row: of the log.
            note: takes the refusals of goals.
        """
        self._began_s = now_s if np.isnan(self._began_s) else self._began_s
        state = self.taken(state, note)
        over = self._duration_s is not None and now_s - self._began_s >= self._duration_s
        ended = state.goal is None and self.n_taken == len(self._goals)
        return None if over or (ended and not (self._stays and self._accepted)) else state

    def go_on(self, controller: Controller, search: GoalSearch, state: LoopState) -> LoopState:
        """Take another controller and its search; return the state that begins its goal again."""
        self._controller, self._search = controller, search
        self.n_taken -= state.goal is not None
        return state._replace(goal=None)

    def taken(self, state: LoopState, note: Note) -> LoopState:
        """Return the state with the next accepted goal, if it has none; without during a search."""
        while state.goal is None and self.n_taken < len(self._goals):
            goal, refusal = self._goals[self.n_taken], self._refused.get(self.n_taken)
            if self._search and not refusal:
                if not self._search.step(goal):
                    return state
                refusal = self._search.refusal()
            self.n_taken += 1
            events = (refusal,) if refusal else ()
            if not refusal:
                state, events = with_goal(self._controller, state, goal)
            self._accepted |= not events
            note(events)
        return state


class Orders(NamedTuple):
    """Orders for the next tick; of several, the safest one counts."""

    vent: bool = False  # let the pressures go to zero; a later goal brings the arm up again
    hold: bool = False  # give up the goals and hold the springs where they are
    goals: Sequence[np.ndarray] | None = None  # poses (6,) [mm, deg] that replace all others; None: no change


class Pilot(Protocol):
    """Interface of a pilot, who steers an arm. Both methods run within a tick: neither may wait."""

    def orders(self) -> Orders:
        """Return the orders since the last tick."""
        ...

    def look(self, state: LoopState, tick: Tick, row: dict[str, Any]) -> None:
        """Take a tick: the state after it, its results, and the row that it logged."""
        ...


class OrderedGoals(ListedGoals):
    """Goals that a pilot orders; they are not counted, and only the pilot ends the run."""

    def __init__(self, controller: Controller, pilot: Pilot):
        super().__init__(controller, (), {})
        self._pilot = pilot

    def advance(self, state: LoopState, now_s: float, row: int, note: Note) -> LoopState:
        """Obey the orders since the last tick."""
        orders = self._pilot.orders()
        if orders.vent or orders.hold:
            self._goals, self.n_taken = [], 0
            state = release(state) if orders.vent else hold(state)
        elif orders.goals is not None:
            self._goals, self.n_taken = list(orders.goals), 0
            state = state._replace(goal=None)
        return self.taken(state, note)


class Way:
    """A goal that moves past poses (p, 6), two or more, from stop to stop, as `trace` takes them.

    It leaves a stop `Controller.start_s` after the arm has arrived there: policy, references and actuators
    take this time to answer. The way is not begun if any pose is refused.
    """

    def __init__(
        self,
        controller: Controller,
        goals: np.ndarray,
        stops: np.ndarray,
        pace_s: float,
        refused: Mapping[int, Event],
    ):
        self._controller, self._poses, self._pace_s = controller, np.asarray(goals, float), pace_s
        self._lead_s = controller.lead_s  # found before the arm moves
        self._refused = refused
        self._stops = np.union1d(np.flatnonzero(stops), [0, len(goals) - 1])
        self._began_s, self._leg = 0.0, self._poses
        self.n_goals, self.n_taken, self.ways = len(self._stops), 0, list[slice]()

    def advance(self, state: LoopState, now_s: float, row: int, note: Note) -> LoopState | None:
        """Move the goal, from an arrival at a stop until the goal is at the next."""
        if self._refused:
            note(tuple(self._refused.values()))
            return None
        if state.goal is None and self.n_taken == len(self._poses):
            return None

        # Leave a stop, or go to the first one.
        if state.goal is None:
            k = self.n_taken - 1
            stop = int(self._stops[self._stops > k][0])
            self.n_taken = stop + 1
            if k < 0:
                return self._stop(state, note)
            self._began_s, self._leg = now_s + self._controller.start_s, self._poses[k : stop + 1]
            self.ways.append(slice(row, row))
        elif state.lead is None:
            return state

        # Go on, or stop; the way's rows begin as the goal leaves the stop.
        stands = now_s < self._began_s + 0.5 * self._controller.dt_s
        self.ways[-1] = slice(row if stands else self.ways[-1].start, row)
        if now_s - self._began_s >= self._pace_s * (len(self._leg) - 1):
            return self._stop(state, note)
        return with_moving_goal(self._controller, state, self._at(now_s), self._at(now_s + self._lead_s))

    def _stop(self, state: LoopState, note: Note) -> LoopState | None:
        """Return the state with the next stop as its goal; None where it is refused."""
        state, events = with_goal(self._controller, state, self._poses[self.n_taken - 1])
        note(events)
        return None if events else state

    def _at(self, now_s: float) -> np.ndarray:
        """Return the place (6,) [mm, deg] of the goal at a time."""
        return on_the_way(self._leg, (now_s - self._began_s) / (self._pace_s * (len(self._leg) - 1)))


Goals = ListedGoals | Way


def on_the_way(goals: np.ndarray, share: float) -> np.ndarray:
    """Return the pose (6,) [mm, deg] after a share of the way past goals (p, 6); its ends beyond 0 and 1."""
    at = min(max(share, 0.0), 1.0) * (len(goals) - 1)
    k = min(int(at), len(goals) - 2)
    return goals[k] + (at - k) * pose_error(goals[k + 1], goals[k])
