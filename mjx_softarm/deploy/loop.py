"""One tick of the control loop: readings in, pressures and faults out. Pure; NumPy only.

    readings, pressures -> belief        lengths, payload, pose, rest (`mjx_softarm.deploy.belief`)
    belief              -> faults        which may vent (`mjx_softarm.deploy.safety`)
    belief, goal        -> references    if an action is due (`mjx_softarm.deploy.strategy`)
    belief, references  -> pressures     the sensor-space law (`mjx_softarm.control`)

Belief, strategy and command are values, which `LoopState` holds side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_softarm.control import LawState, pressures
from mjx_softarm.deploy.belief import Belief, believe
from mjx_softarm.deploy.controller import Command, Controller
from mjx_softarm.deploy.link import vented
from mjx_softarm.deploy.safety import Event, Fault, check, stop_of
from mjx_softarm.deploy.strategy import Strategy, to_fixed_goal
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.reach import nearest, nearest_poses


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
    controller: Controller,
    state: LoopState,
    readings: np.ndarray | None,
    late: bool,
    measured_kpa: np.ndarray | None = None,
) -> tuple[LoopState, tuple[Event, ...]]:
    """Take one tick.

    Args:
        controller: the policy.
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
    command = _pressed(controller, state.command, belief.spring_m)
    return state._replace(command=command), events


def _pressed(controller: Controller, command: Command, spring_m: np.ndarray) -> Command:
    """Return the command with the next pressures: the law's; nearer to zero where there are no references."""
    if command.reference_m is None:
        lower_kpa = vented(command.pressure_kpa, controller.dt_s)
        return command._replace(pressure_kpa=lower_kpa, law=LawState.at_rest(lower_kpa, spring_m))
    law = command.law
    if np.isnan(law.length_m).any():  # these are the first lengths that were read
        law = LawState.at_rest(command.pressure_kpa, spring_m)
    gains = controller.policy.gains
    pressure_kpa, law = pressures(command.reference_m, spring_m, law, gains, controller.dt_s)
    return command._replace(pressure_kpa=pressure_kpa, law=law, n_ticks=command.n_ticks + 1)


def in_force(state: LoopState, pressure_kpa: np.ndarray) -> LoopState:
    """Return the state with the pressures (n_chambers,) [kPa] that the arm has taken."""
    return state._replace(command=state.command._replace(pressure_kpa=pressure_kpa))


def with_goal(
    controller: Controller, state: LoopState, goal: np.ndarray
) -> tuple[LoopState, tuple[Event, ...]]:
    """Return the state with a goal (6,) [mm, deg]; unchanged, with an event, if the goal is refused."""
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
            got, near = (", ".join(f"{value:.0f}" for value in values) for values in (goals[k], pose))
            message = f"got {got}, expected a pose that the arm reaches; the nearest is {near} [mm, deg]"
            refused[k] = Event(Fault.GOAL_OUTSIDE, message)
    return refused
