"""Results of a run of the control loop on an arm."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np

from mjx_softarm.deploy.ending import DONE, FAULT, MISSED, Ending
from mjx_softarm.deploy.faults import Event, Fault, Response
from mjx_softarm.logs.schema import Log


class Arrival(NamedTuple):
    """A goal that had all its actions."""

    goal: np.ndarray  # (6,) [mm, deg]
    estimate: np.ndarray  # (6,) [mm, deg] pose believed in
    row: int  # index of the log's row
    index: int  # of the goal among those asked for
    reached: bool = True  # within the policy's threshold of a goal, by motion capture if there is any


class Run(NamedTuple):
    """Results of a run."""

    log: Log
    arrivals: tuple[Arrival, ...]
    events: tuple[Event, ...]
    latency_s: np.ndarray  # (ticks,) from readings to pressures, without the arm's input and output
    ending: Ending
    n_goals: int = 0  # number of goals asked for; 0 with a pilot
    ways: tuple[slice, ...] = ()  # rows of the log in which the goal moved

    def counts(self) -> dict[Fault, int]:
        """Return how often each fault came."""
        return dict(Counter(event.fault for event in self.events))

    @property
    def status(self) -> int:
        """Exit status: that of the ending, of a fault if a goal was refused, or of a goal not reached."""
        refused = any(event.response is not Response.GO_ON for event in self.events)
        n_reached = sum(arrival.reached for arrival in self.arrivals)
        return self.ending.status or (FAULT if refused else MISSED if n_reached < self.n_goals else DONE)
