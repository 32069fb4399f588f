"""One tick of the control loop: readings in, pressures and faults out. Pure; NumPy only.

    readings, pressures -> belief        lengths, payload, pose, rest (`mjx_softarm.deploy.belief`)
    belief              -> faults        which may vent (`mjx_softarm.deploy.safety`)
    belief, goal        -> references    if an action is due (`mjx_softarm.deploy.strategy`)
    belief, references  -> pressures     the sensor-space law (`mjx_softarm.control`)

Belief, strategy and command are values, which `LoopState` holds side by side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm.control import LawState, pressures
from mjx_softarm.deploy.belief import Belief, Command, believe
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.link import vented
from mjx_softarm.deploy.safety import Event, check, stop_of
from mjx_softarm.deploy.strategy import Strategy


class LoopState(NamedTuple):
    """Memory of the loop from tick to tick."""

    command: Command
    belief: Belief
    strategy: Strategy | None = None  # None without a goal
    goal: np.ndarray | None = None  # (6,) [mm, deg]
    ahead: np.ndarray | None = None  # (6,) [mm, deg] place of a moving goal ahead; None: the goal stands
    arrived: bool = False  # the springs have settled in this tick, and no further action is due


def start(controller: Controller) -> LoopState:
    """Return the state before the first tick, of an arm without pressure."""
    belief = Belief.none(controller)
    return LoopState(belief.command, belief)


def step(
    state: LoopState,
    readings: np.ndarray | None,
    late: bool,
    measured_kpa: np.ndarray | None = None,
) -> tuple[LoopState, tuple[Event, ...]]:
    """Take one tick.

    Args:
        state: after the last tick; its pressures are in force.
        readings (n_springs,): of the sensors, or None where none came in time.
        late: the last tick missed its deadline.
        measured_kpa (n_chambers,) [kPa]: measured pressures; NaN, or None for all, where none was measured.

    Returns:
        The next state, and the faults; its pressures are to be written unless a fault ends the run.
    """
    belief = believe(state.belief, state.command, readings, late, measured_kpa)
    events = check(state.belief, belief)
    state = state._replace(belief=belief, arrived=False)
    if stop_of(events) is not None:
        return state, events

    # References, if each spring was read
    if state.strategy is not None and state.goal is not None and belief.known and not belief.lost.any():
        goal = state.goal if state.ahead is None else state.ahead
        strategy, reference_m, more = state.strategy.references(belief, goal)
        events += more
        state = state._replace(strategy=strategy)
        if strategy is None:
            state = state._replace(goal=None, arrived=True)
        if reference_m is not None:
            state = state._replace(command=state.command._replace(reference_m=reference_m, n_ticks=0))

    # Pressures
    command = _pressed(state.command, belief)
    return state._replace(command=command), events


def _pressed(command: Command, belief: Belief) -> Command:
    """Return the command with the next pressures: the law's; nearer to zero where there are no references."""
    controller = belief.controller
    if command.reference_m is None:
        lower_kpa = vented(command.pressure_kpa, controller.dt_s)
        return command._replace(pressure_kpa=lower_kpa, law=LawState.at_rest(lower_kpa, belief.spring_m))
    law = command.law
    if np.isnan(law.length_m).any():  # these are the first lengths that were read
        law = LawState.at_rest(command.pressure_kpa, belief.spring_m)
    gains = controller.policy.gains
    pressure_kpa, law = pressures(command.reference_m, belief.spring_m, law, gains, controller.dt_s)
    return command._replace(pressure_kpa=pressure_kpa, law=law, n_ticks=command.n_ticks + 1)


def in_force(state: LoopState, pressure_kpa: np.ndarray) -> LoopState:
    """Return the state with the pressures (n_chambers,) [kPa] that the arm has taken."""
    return state._replace(command=state.command._replace(pressure_kpa=pressure_kpa))
