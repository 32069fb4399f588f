"""A run that goes on without a chamber that has lost its pressure.

The chamber is kept at zero. The policy's actor knows arms with all chambers only. So references come of a
search over the other chambers' pressures, in the policy's models (`mjx_softarm.policy.reach`). Estimates
of the pose need springs alone, and stay as they are.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.loop import LoopState
from mjx_softarm.deploy.strategy import strategy_of
from mjx_softarm.policy.reach import nearest_springs


def without(controller: Controller, lost: np.ndarray) -> Controller:
    """Return the controller of an arm whose lost chambers (n_chambers,) have no pressure."""
    gains = controller.policy.gains
    limits_kpa = (np.where(lost, 0.0, limit) for limit in (gains.pressure_min_kpa, gains.pressure_max_kpa))
    low_kpa, high_kpa = limits_kpa
    gains = gains._replace(pressure_min_kpa=low_kpa, pressure_max_kpa=high_kpa)
    policy = dataclasses.replace(controller.policy, gains=gains)
    plan = lambda pose, goal, spring_m, sensed: nearest_springs(policy, goal)  # noqa: E731
    return dataclasses.replace(controller, policy=policy, plan=plan)


def begun_again(controller: Controller, state: LoopState) -> LoopState:
    """Return the state in which the goal of a run begins again with another controller."""
    watch = state.watch._replace(n_suspect=np.zeros_like(state.watch.n_suspect))
    strategy = strategy_of(controller.policy, np.zeros(6), moves=False)
    command = state.command._replace(n_ticks=0)
    return state._replace(watch=watch, strategy=strategy, command=command)
