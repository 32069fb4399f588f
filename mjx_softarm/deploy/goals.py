"""Goals of a run: from a list, by somebody's orders, or one that moves past poses.

Only `n_goals` of them count for the run's exit status; of these, `n_taken` are taken or refused so far.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Literal

import numpy as np

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.loop import LoopState
from mjx_softarm.deploy.moving import lead_of, to_moving_goal
from mjx_softarm.deploy.safety import Event, Fault
from mjx_softarm.deploy.strategy import to_fixed_goal
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.reach import nearest, nearest_poses
from mjx_softarm.sensing.pose import pose_error

Events = tuple[Event, ...]
# An order for the next tick: let the pressures go to zero, after which a goal brings the arm up again; give
# up the goals and hold the springs where they are; poses (6,) [mm, deg] that replace all others; no change
Order = Literal["vent", "hold"] | Sequence[np.ndarray] | None


def with_goal(state: LoopState, goal: np.ndarray) -> tuple[LoopState, Events]:
    """Return the state with a goal (6,) [mm, deg]; unchanged, with an event, if the goal is refused."""
    controller = state.belief.controller
    goal = np.asarray(goal, float)
    text = ", ".join(f"{value:g}" for value in goal)
    if goal.shape != (6,) or not np.isfinite(goal).all():
        return state, (Event(Fault.GOAL_OUTSIDE, f"got {text}, expected six finite numbers"),)
    pose, away = nearest(controller.reachable, goal)
    if away > 1.0:
        near = ", ".join(f"{value:.0f}" for value in pose)
        far = f"{text} is {away:.1f} times as far from the nearest reachable pose as a goal may be"
        return state, (Event(Fault.GOAL_OUTSIDE, f"{far}; that pose is {near} [mm, deg]"),)
    strategy = to_fixed_goal(controller.policy)
    command = state.command._replace(n_ticks=0)
    return state._replace(goal=goal, ahead=None, strategy=strategy, command=command), ()


def hold(state: LoopState) -> LoopState:
    """Return the state without a goal, the springs held as they were read last.

    An arm without references, which has no pressure or is being vented, stays so.
    """
    if state.command.reference_m is None or not state.belief.known:
        return state._replace(goal=None)
    held = state.command._replace(reference_m=state.belief.spring_m, n_ticks=0)
    return state._replace(goal=None, command=held)


def release(state: LoopState) -> LoopState:
    """Return the state without goal and references, in which the pressures go to zero along the ramp."""
    return state._replace(goal=None, command=state.command._replace(reference_m=None))


def refusals(policy: Policy, goals: Sequence[np.ndarray]) -> dict[int, Event]:
    """Return which goals (6,) [mm, deg] are refused, since no pressures reach them; takes longer than a tick.

    It is sharper than `with_goal`, whose poses lie some 15 mm apart.
    """
    finite = [k for k, goal in enumerate(goals) if np.shape(goal) == (6,) and np.isfinite(goal).all()]
    if not finite:
        return {}
    poses, errors = nearest_poses(policy, np.array([goals[k] for k in finite], float))
    refused = {}
    for k, pose, error in zip(finite, poses, errors, strict=True):
        if not error <= policy.reward.threshold:
            got = ", ".join(f"{value:g}" for value in goals[k])
            near = ", ".join(f"{value:.0f}" for value in pose)
            message = f"got {got}, expected a pose that the arm reaches; the nearest is {near} [mm, deg]"
            refused[k] = Event(Fault.GOAL_OUTSIDE, message)
    return refused


class ListedGoals:
    """Goals one after the other, as `follow` takes them; those that no pressures reach are skipped."""

    ways: Sequence[slice] = ()  # rows of the log in which the goal moved

    def __init__(
        self,
        policy: Policy,
        goals: Iterable[np.ndarray],
        duration_s: float = np.inf,
        stay: bool = False,
    ):
        self._goals = list(goals)
        self._refused = refusals(policy, self._goals)  # now: it takes longer than a tick
        self._duration_s = duration_s
        self._stays = stay
        self._began_s = np.nan
        self.n_goals = len(self._goals)
        self.n_taken = 0

    def advance(self, state: LoopState, now_s: float, row: int) -> tuple[LoopState | None, Events]:
        """Return the state with the goal of this tick, None once the run is over; and refusals of goals.

        Args:
            state: after the last tick.
            now_s: time.
            row: of the log, in this tick.
        """
        if np.isnan(self._began_s):
            self._began_s = now_s
        state, events = self._with_next(state)
        ended = state.goal is None and self.n_taken == len(self._goals)
        stays = self._stays and state.command.reference_m is not None
        over = (ended and not stays) or now_s - self._began_s >= self._duration_s
        return None if over else state, events

    def _with_next(self, state: LoopState) -> tuple[LoopState, Events]:
        """Return the state with the next accepted goal, if it has none, and the refusals until then."""
        refused: Events = ()
        while state.goal is None and self.n_taken < len(self._goals):
            goal = self._goals[self.n_taken]
            if self.n_taken in self._refused:
                refused += (self._refused[self.n_taken],)
            else:
                state, events = with_goal(state, goal)
                refused += events
            self.n_taken += 1
        return state, refused


class OrderedGoals(ListedGoals):
    """Goals that somebody orders; they are not counted, and only an exception of `orders` ends the run."""

    def __init__(self, policy: Policy, orders: Callable[[], Order]):
        super().__init__(policy, ())
        self._orders = orders

    def advance(self, state: LoopState, now_s: float, row: int) -> tuple[LoopState | None, Events]:
        """Obey the order since the last tick."""
        order = self._orders()
        if isinstance(order, str):
            self._goals = []
            self.n_taken = 0
            state = {"vent": release, "hold": hold}[order](state)
        elif order is not None:
            self._goals = list(order)
            self.n_taken = 0
            state = state._replace(goal=None)
        return self._with_next(state)


class MovingGoal:
    """Goal that moves past poses (p, 6), two or more, from stop to stop, as `trace` takes them.

    It leaves a stop once the arm answers, some time after the arrival there: see `lead_of`. It does not begin
    to move if any pose is refused.
    """

    def __init__(
        self,
        controller: Controller,
        goals: np.ndarray,
        stops: np.ndarray,
        pace_s: float,
    ):
        self._controller = controller
        self._poses = np.asarray(goals, float)
        self._pace_s = pace_s
        # Before the arm moves: both may take seconds
        self._refused = refusals(controller.policy, list(goals))
        self._lead_s, self._start_s = lead_of(controller)
        self._stops = np.union1d(np.flatnonzero(stops), [0, len(goals) - 1])
        self._began_s = 0.0
        self._leg = self._poses
        self.n_goals = len(self._stops)
        self.n_taken = 0
        self.ways = list[slice]()

    def advance(self, state: LoopState, now_s: float, row: int) -> tuple[LoopState | None, Events]:
        """Move the goal, from an arrival at a stop until the goal is at the next."""
        if self._refused:
            return None, tuple(self._refused.values())
        if state.goal is None and self.n_taken == len(self._poses):
            return None, ()

        # Leave a stop, or go to the first one.
        if state.goal is None:
            k = self.n_taken - 1
            stop = int(self._stops[self._stops > k][0])
            self.n_taken = stop + 1
            if k < 0:
                return self._stop(state)
            self._began_s = now_s + self._start_s
            self._leg = self._poses[k : stop + 1]
            self.ways.append(slice(row, row))
        elif state.ahead is None:
            return state, ()

        # Go on, or stop; the way's rows begin as the goal leaves the stop.
        stands = now_s < self._began_s + 0.5 * self._controller.dt_s
        self.ways[-1] = slice(row if stands else self.ways[-1].start, row)
        if now_s - self._began_s >= self._pace_s * (len(self._leg) - 1):
            return self._stop(state)
        strategy = state.strategy
        if state.ahead is None:  # it has just left the stop
            strategy = to_moving_goal(self._controller.policy, self._lead_s)
        goal, ahead = self._place(now_s), self._place(now_s + self._lead_s)
        return state._replace(goal=goal, ahead=ahead, strategy=strategy), ()

    def _stop(self, state: LoopState) -> tuple[LoopState | None, Events]:
        """Return the state with the next stop as its goal, None where it is refused, and the refusal."""
        state, events = with_goal(state, self._poses[self.n_taken - 1])
        return None if events else state, events

    def _place(self, now_s: float) -> np.ndarray:
        """Return the place (6,) [mm, deg] of the goal at a time."""
        return on_the_way(self._leg, (now_s - self._began_s) / (self._pace_s * (len(self._leg) - 1)))


def on_the_way(goals: np.ndarray, share: float) -> np.ndarray:
    """Return the pose (6,) [mm, deg] after a share of the way past goals (p, 6); its ends beyond 0 and 1."""
    passed = min(max(share, 0.0), 1.0) * (len(goals) - 1)
    k = min(int(passed), len(goals) - 2)
    return goals[k] + (passed - k) * pose_error(goals[k + 1], goals[k])
