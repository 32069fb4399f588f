"""Computations of a policy for other languages, recorded from the functions that Python runs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.control import LawState, pressures, saturated
from mjx_softarm.deploy.belief import (
    explained_by_pressure_loss,
    hysteresis_after,
    on_reference,
    stuck_springs,
)
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.link import vented
from mjx_softarm.export.symbols import Symbol, constant, repeat, symbol
from mjx_softarm.mdp.rewards import asked_error, weighted_error
from mjx_softarm.policy import reach
from mjx_softarm.policy.lag import still
from mjx_softarm.policy.reach import distances, followed
from mjx_softarm.policy.runtime import InMotion, action_towards, actor_output, sensed, tip_pose
from mjx_softarm.sensing.load import estimate_load
from mjx_softarm.spec import ArmSpec


class Computation(NamedTuple):
    """One function of named arrays."""

    inputs: tuple[Symbol, ...]
    outputs: dict[str, Symbol]


def graph(controller: Controller) -> Computation:
    """Record `answer`."""
    spec = controller.policy.spec
    springs, chambers = (spec.n_springs,), (spec.n_chambers,)
    inputs = symbol("readings", springs), symbol("goal", (6,)), symbol("last_length_m", springs)
    inputs = *inputs, symbol("load_kg", ()), symbol("pressure_kpa", chambers), symbol("stop", chambers)
    motion = _in_motion(spec)
    outputs = answer(controller, *inputs, motion)
    inputs += tuple(motion) if controller.policy.observation == "motion" else ()
    return Computation(inputs, {name: constant(value) for name, value in outputs.items()})


def answer(
    controller: Controller,
    readings: Array,
    goal: Array,
    last_m: Array,
    load_kg: Array,
    pressure_kpa: Array,
    stop: Array,
    motion: InMotion,
) -> dict[str, Array]:
    """Return the loop's references for readings (n_springs,) and a goal (6,), with pose, faults and payload.

    A lost reading holds the last length (n_springs,) [m] of its spring. References are NaN if the loop would
    not act: a spring has neither a reading nor a last length, or the goal is outside the workspace. The
    payload () [kg] is the caller's average of estimates at rest, each from pressures (n_chambers,) [kPa] and
    the state (n_chambers,) of the chambers' hysteresis, which the caller gives back in the next tick.
    Only policies that observe motion use `motion`.
    """
    # References of the policy.
    policy, xp = controller.policy, array_namespace(readings)
    reading = policy.sensor.lengths(readings, last_m)
    stop = hysteresis_after(policy, stop, last_m, reading.length_m)
    estimated_kg, half_width_kg = estimate_load(policy.load_estimator, reading.length_m, pressure_kpa, stop)
    pose, away = tip_pose(policy, reading.length_m, load_kg)
    observed = sensed(policy, pose, reading.length_m, motion, load_kg)
    action = action_towards(policy, pose, xp.asarray(goal, dtype=np.float32), observed)
    reference = policy.actions.readings(action)
    # NaN never counts as inside or finite.
    inside = _inside(controller, goal)
    acts = inside & xp.all(xp.isfinite(reading.length_m))
    return {
        "reference_m": xp.where(acts, policy.sensor.lengths(reference).length_m, np.nan),
        "reference_reading": xp.where(acts, reference, np.nan),
        "length_m": reading.length_m,
        "reading_lost": reading.lost,
        "pose": pose,
        "extrapolation": away,
        "goal_outside": ~inside,
        "load_estimate_kg": estimated_kg,
        "load_half_width_kg": half_width_kg,
        "next_stop": stop,
    }


def check(controller: Controller) -> Computation:
    """Record goal -> refusal before a run, nearest pose and its weighted error."""
    policy, goal = controller.policy, symbol("goal", (6,))
    start = constant(reach.begin(policy, 1))
    search = repeat(lambda search: reach.improve(policy, goal[None], search), start, reach.N_STEPS)
    pose, error = reach.nearest_of(policy, goal[None], search)
    reached = _inside(controller, goal) & (error[0] <= policy.reward.threshold)
    return Computation((goal,), {"goal_outside": ~reached, "nearest": pose[0], "error": error[0]})


def _inside(controller: Controller, goal: Array) -> Array:
    """Return whether the loop takes a goal (6,) in a run."""
    xp = array_namespace(goal)
    return xp.min(distances(controller.reachable, goal)) <= 1.0


def actor(controller: Controller) -> Computation:
    """Record the bare actor: observation (O,) -> action (n_springs,) in [-1, 1]."""
    policy = controller.policy
    observation = symbol("observation", (len(policy.obs_layout),), np.float32)
    return Computation((observation,), {"action": actor_output(policy, observation)})


def parts(controller: Controller) -> dict[str, Computation]:
    """Record the functions of which `mjx_softarm.deploy.loop` consists, by their names in C++."""
    # Inputs that several functions share.
    policy, window = controller.policy, controller.window
    springs, chambers = (policy.spec.n_springs,), (policy.spec.n_chambers,)
    readings, spring_m = symbol("readings", springs), symbol("spring_m", springs)
    reference_m, pressure_kpa = symbol("reference_m", springs), symbol("pressure_kpa", chambers)
    springs_m = symbol("springs_m", (window, *springs))
    pressures_kpa = symbol("pressures_kpa", (window, *chambers))
    goal, pose = symbol("goal", (6,)), symbol("pose", (6,), np.float32)
    load_kg, stop = symbol("load_kg", ()), symbol("stop", chambers)
    xp = array_namespace(readings)

    # Belief.
    reading = policy.sensor.lengths(readings, spring_m)
    tip, away = tip_pose(policy, spring_m, load_kg)
    means = xp.mean(springs_m, axis=0), xp.mean(pressures_kpa, axis=0)
    estimated_kg, half_width_kg = estimate_load(policy.load_estimator, *means, stop)
    last_m = symbol("last_m", spring_m.shape)
    next_stop = hysteresis_after(policy, stop, last_m, spring_m)
    # Policy.
    motion = _in_motion(policy.spec)
    observed = sensed(policy, pose, spring_m, motion, load_kg)
    action = action_towards(policy, pose, xp.asarray(goal, dtype=np.float32), observed)
    # Law.
    sizes = policy.spec.n_chambers, policy.spec.n_springs, policy.spec.n_springs
    state = LawState(*(symbol(f"last_{name}", (n,)) for name, n in zip(LawState._fields, sizes, strict=True)))
    written_kpa, next_state = pressures(reference_m, spring_m, state, policy.gains, controller.dt_s)
    law = {"written_kpa": written_kpa} | {
        f"next_{name}": value for name, value in next_state._asdict().items()
    }
    acting = pose, goal, spring_m, *motion, load_kg
    acts = {
        "lengths": _of(readings, spring_m, length_m=reading.length_m, lost=reading.lost),
        "mean_length": _of(springs_m, mean_m=means[0]),
        "hysteresis": _of(stop, last_m, spring_m, next_stop=next_stop),
        "estimated_load": _of(springs_m, pressures_kpa, stop, kg=estimated_kg, width_kg=half_width_kg),
        "tip": _of(spring_m, load_kg, tip=tip, away=constant(away)),
        "references": _of(*acting, asked_m=policy.actions.lengths(action)),
        "law": _of(reference_m, spring_m, *state, **law),
        "vented": _of(pressure_kpa, next_kpa=vented(pressure_kpa, controller.dt_s)),
    }

    # Rest and faults.
    rest, gains = controller.rest, policy.gains
    settled = on_reference(springs_m, reference_m, pressure_kpa, gains, rest.arrived_m)
    mask = saturated(pressure_kpa, reference_m, spring_m, gains, policy.tolerance_m)
    stuck = stuck_springs(springs_m, pressures_kpa, policy.spec.structure.n_sections)
    lost = explained_by_pressure_loss(policy.spring_model, pressure_kpa, spring_m, gains)
    # Error of a pose, and lengths that references make.
    exact = xp.asarray(pose, dtype=np.float64)
    weighted = weighted_error(exact, goal, policy.reward)
    mean_m, asked_m = (symbol(name, spring_m.shape) for name in ("mean_m", "asked_m"))
    lengths = reference_m, mean_m, asked_m, symbol("is_saturated", pressure_kpa.shape, bool)
    judges = {
        "still": _of(springs_m, holds=still(springs_m, rest.still_m)),
        "on_reference": _of(springs_m, reference_m, pressure_kpa, holds=settled),
        "saturated": _of(pressure_kpa, reference_m, spring_m, mask=mask),
        "stuck": _of(springs_m, pressures_kpa, mask=stuck),
        "explained_by_pressure_loss": _of(pressure_kpa, spring_m, mask=lost),
        "left": _of(pose, goal, off=asked_error(exact, goal, policy.reward), error=weighted),
        "followed": _of(*lengths, lengths_m=followed(*lengths, policy)),
    }
    return acts | judges | _goal_tests(controller)


def _goal_tests(controller: Controller) -> dict[str, Computation]:
    """Record the tests of a goal: among reachable poses, and by a search."""
    policy, goal = controller.policy, symbol("goal", (6,))
    start = constant(reach.begin(policy, 1))
    search = symbol("search", start.shape)
    nearest, error = reach.nearest_of(policy, goal[None], search)
    return {
        "inside": _of(goal, holds=_inside(controller, goal)),
        "search_begin": _of(search=start),
        "search_step": _of(goal, search, next=reach.improve(policy, goal[None], search)),
        "search_end": _of(search, goal, nearest=nearest[0], error=error[0]),
    }


def _of(*inputs: Symbol, **outputs: Symbol) -> Computation:
    return Computation(inputs, outputs)


def _in_motion(spec: ArmSpec) -> InMotion:
    sizes = spec.n_springs, spec.n_springs, spec.n_chambers
    return InMotion(*(symbol(name, (n,)) for name, n in zip(InMotion._fields, sizes, strict=True)))
