"""Goals of a run: from a list, or by a pilot's orders."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.loop import LoopState, Tick, hold, release, with_goal
from mjx_softarm.deploy.safety import Event

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
