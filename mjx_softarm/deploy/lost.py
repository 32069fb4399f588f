"""A run that goes on without a chamber that has lost its pressure.

The chamber is kept at zero. The policy's actor only knows arms with all chambers. References therefore come
from a search over the other chambers' pressures in the policy's models (`mjx_softarm.policy.reach`). A search
takes longer than a tick. It is spread over some ticks, in which the arm holds its references, before the goal
is taken. Estimates of the pose need springs alone, and stay as they are.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.loop import LoopState, refusal
from mjx_softarm.deploy.safety import Event
from mjx_softarm.deploy.strategy import to_fixed_goal
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.reach import N_STEPS, begin, best_of, improve, nearest_of, springs_of

MORE_STEPS = 3  # steps of a search that goes on from a goal to the same goal with a shift


class GoalSearch:
    """Search for the references of one goal after the other, a step in each tick."""

    def __init__(self, policy: Policy):
        self._policy, self._goal, self._n_left = policy, np.full(6, np.nan), 0
        self._search = begin(policy, 1)

    def step(self, goal: np.ndarray) -> bool:
        """Take a step towards a goal (6,) [mm, deg]; return whether it was the last one."""
        if not np.array_equal(goal, self._goal):
            self._goal, self._n_left, self._search = np.array(goal, float), N_STEPS, begin(self._policy, 1)
        if np.shape(goal) != (6,) or not np.isfinite(goal).all():  # the loop refuses it at once
            return True
        if self._n_left:
            self._search = improve(self._policy, self._goal[None], self._search)
            self._n_left -= 1
        return not self._n_left

    def refusal(self) -> Event | None:
        """Return the refusal of the goal that was searched for, if no pressures reach it."""
        if not np.isfinite(self._goal).all():
            return None
        [pose], [error] = nearest_of(self._policy, self._goal[None], self._search)
        return refusal(self._policy, self._goal, pose, error)

    def plan(
        self, pose: np.ndarray, goal: np.ndarray, spring_m: np.ndarray, sensed: np.ndarray | None
    ) -> np.ndarray:
        """Return references (n_springs,) [m] for the goal with a shift (6,) [mm, deg]; a `Plan`."""
        search = best_of(self._policy, self._goal[None], self._search)
        for _ in range(MORE_STEPS):
            search = improve(self._policy, goal[None], search)
        return springs_of(self._policy, search)[0]


def without(controller: Controller, lost: np.ndarray) -> tuple[Controller, GoalSearch]:
    """Return the controller of an arm whose lost chambers (n_chambers,) have no pressure, and its search.

    A second lost chamber ends the run.
    """
    gains = controller.policy.gains
    low_kpa, high_kpa = (np.where(lost, 0.0, x) for x in (gains.pressure_min_kpa, gains.pressure_max_kpa))
    gains = gains._replace(pressure_min_kpa=low_kpa, pressure_max_kpa=high_kpa)
    policy = dataclasses.replace(controller.policy, gains=gains)
    # The search makes the goal at rest: its references need no correction, which would take several ticks
    config = dataclasses.replace(controller.config, go_on=False, n_corrections=0)
    search = GoalSearch(policy)
    return dataclasses.replace(controller, policy=policy, plan=search.plan, config=config), search


def begun_again(controller: Controller, state: LoopState) -> LoopState:
    """Return the state in which the goal of a run begins again with another controller."""
    watch = state.watch._replace(n_suspect=np.zeros_like(state.watch.n_suspect))
    strategy = to_fixed_goal(controller.policy)
    command = state.command._replace(n_ticks=0)
    return state._replace(watch=watch, strategy=strategy, command=command)
