"""A goal that moves along a way past poses, from stop to stop."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.goals import Note
from mjx_softarm.deploy.loop import LoopState, with_goal, with_moving_goal
from mjx_softarm.deploy.safety import Event
from mjx_softarm.sensing.pose import pose_error


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


def on_the_way(goals: np.ndarray, share: float) -> np.ndarray:
    """Return the pose (6,) [mm, deg] after a share of the way past goals (p, 6); its ends beyond 0 and 1."""
    at = min(max(share, 0.0), 1.0) * (len(goals) - 1)
    k = min(int(at), len(goals) - 2)
    return goals[k] + (at - k) * pose_error(goals[k + 1], goals[k])
