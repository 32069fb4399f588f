"""Goals of a run: from a list, along a way past poses, or by a pilot's orders."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.loop import LoopState, Tick, hold, release, with_goal, with_moving_goal
from mjx_softarm.deploy.safety import Event
from mjx_softarm.sensing.pose import pose_error

Note = Callable[[Sequence[Event]], None]


class Goals(Protocol):
    """Source of a run's goals."""

    n_goals: int  # number of goals asked for; 0 with a pilot
    n_taken: int  # goals taken from the source so far
    ways: Sequence[slice]  # rows of the log in which the goal moved

    def advance(self, state: LoopState, now_s: float, row: int, note: Note) -> LoopState | None:
        """Return the state with the goal of a tick; None where the run is over.

        Args:
            state: after the last tick.
            now_s: time.
            row: of the log.
            note: takes why goals were refused.
        """
        ...

    def shown(self, state: LoopState, now_s: float) -> np.ndarray | None:
        """Return the goal (6,) [mm, deg] of the log."""
        ...


class ListedGoals:
    """Goals (6,) [mm, deg] one after the other.

    Args:
        controller: the policy.
        goals: poses.
        refused: goals that are skipped, by their index.
        duration_s: time after which the run is over, wherever the arm is.
        stay: hold the last goal, until something else ends the run.
    """

    ways = ()

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

    def advance(self, state: LoopState, now_s: float, row: int, note: Note) -> LoopState | None:
        """Take the next accepted goal once the last is done."""
        self._began_s = now_s if np.isnan(self._began_s) else self._began_s
        state = self.taken(state, note)
        over = self._duration_s is not None and now_s - self._began_s >= self._duration_s
        return None if over or (state.goal is None and not (self._stays and self._accepted)) else state

    def taken(self, state: LoopState, note: Note) -> LoopState:
        """Return the state with the next accepted goal, if it has none."""
        while state.goal is None and self.n_taken < len(self._goals):
            goal, refusal = self._goals[self.n_taken], self._refused.get(self.n_taken)
            self.n_taken += 1
            events = (refusal,) if refusal else ()
            if not refusal:
                state, events = with_goal(self._controller, state, goal)
            self._accepted |= not events
            note(events)
        return state

    def shown(self, state: LoopState, now_s: float) -> np.ndarray | None:
        return state.goal


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

    def look(self, state: LoopState, tick: Tick, row: dict[str, Any]) -> None:
        """Take a tick: the state after it, its results, and the row that it logged."""
        ...


class OrderedGoals:
    """Goals that a pilot orders; they are not counted, and only the pilot ends the run."""

    n_goals, ways = 0, ()

    def __init__(self, controller: Controller, pilot: Pilot):
        self._controller, self._pilot = controller, pilot
        self._goals = ListedGoals(controller, (), {})

    @property
    def n_taken(self) -> int:
        return self._goals.n_taken

    def advance(self, state: LoopState, now_s: float, row: int, note: Note) -> LoopState:
        """Obey the orders since the last tick."""
        orders = self._pilot.orders()
        if orders.vent or orders.hold:
            self._goals = ListedGoals(self._controller, (), {})
            state = release(state) if orders.vent else hold(state)
        elif orders.goals is not None:
            self._goals = ListedGoals(self._controller, orders.goals, {})
            state = state._replace(goal=None)
        return self._goals.taken(state, note)

    def shown(self, state: LoopState, now_s: float) -> np.ndarray | None:
        return state.goal


class Way:
    """A goal that moves past poses on straight lines, all as far apart in time, from stop to stop.

    Args:
        controller: the policy.
        goals (p, 6) [mm, deg]: poses, two or more.
        stops (p,): bool; the first and the last are stops in any case.
        pace_s: time from a pose to the next.
        refused: poses that are out of reach, by their index; with any of them the way is not begun.
    """

    def __init__(
        self,
        controller: Controller,
        goals: np.ndarray,
        stops: np.ndarray,
        pace_s: float,
        refused: Mapping[int, Event],
    ):
        config = controller.config
        self._controller, self._poses, self._pace_s = controller, np.asarray(goals, float), pace_s
        self._lead_s = config.lead_actions * controller.policy.action_s or config.lead_s
        self._refused = refused
        self._stops = np.union1d(np.flatnonzero(stops), [0, len(goals) - 1])
        self._began_s, self._leg, self._moves = 0.0, self._poses, False
        self.n_goals, self.n_taken, self.ways = len(self._stops), 0, list[slice]()

    def advance(self, state: LoopState, now_s: float, row: int, note: Note) -> LoopState | None:
        """Move the goal, from an arrival at a stop until the goal is at the next."""
        if self._refused:
            note(tuple(self._refused.values()))
            return None
        if state.goal is None:
            if self.n_taken == len(self._poses):
                return None
            if not self.n_taken:
                self.n_taken = 1
                return self._stop(state, note)
            self._begin(now_s, row)
            return with_moving_goal(self._controller, state, self._at(now_s + self._lead_s), begins=True)
        if not self._moves:
            return state
        self.ways[-1] = slice(self.ways[-1].start, row)
        if now_s - self._began_s < self._leg_s:
            return with_moving_goal(self._controller, state, self._at(now_s + self._lead_s), begins=False)
        self._moves = False
        return self._stop(state, note)

    def shown(self, state: LoopState, now_s: float) -> np.ndarray | None:
        """Return the moving goal itself, not the one ahead that the policy is given."""
        return self._at(now_s) if self._moves else state.goal

    def _begin(self, now_s: float, row: int) -> None:
        """Let the goal leave a stop, at a row of the log."""
        k = self.n_taken - 1
        stop = int(self._stops[self._stops > k][0])
        self._began_s, self._leg, self._moves, self.n_taken = now_s, self._poses[k : stop + 1], True, stop + 1
        self.ways.append(slice(row, row))

    def _stop(self, state: LoopState, note: Note) -> LoopState | None:
        """Return the state with the next stop as its goal; None where it is refused."""
        state, events = with_goal(self._controller, state, self._poses[self.n_taken - 1])
        note(events)
        return None if events else state

    @property
    def _leg_s(self) -> float:
        return self._pace_s * (len(self._leg) - 1)

    def _at(self, now_s: float) -> np.ndarray:
        return on_the_way(self._leg, (now_s - self._began_s) / self._leg_s)


def on_the_way(goals: np.ndarray, share: float) -> np.ndarray:
    """Return the pose (6,) [mm, deg] after a share of the way past goals (p, 6); its end for more than 1."""
    at = min(share, 1.0) * (len(goals) - 1)
    k = min(int(at), len(goals) - 2)
    return goals[k] + (at - k) * pose_error(goals[k + 1], goals[k])
