"""Computations of a policy for other languages, recorded from the functions that Python runs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.control import LawState, pressures, saturated
from mjx_softarm.deploy.belief import as_without, on_reference, still, stuck_springs
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.link import vented
from mjx_softarm.deploy.strategy import followed
from mjx_softarm.export.symbols import Symbol, constant, repeat, symbol
from mjx_softarm.mdp.rewards import scaled_error
from mjx_softarm.policy import reach
from mjx_softarm.policy.reachable import distances
from mjx_softarm.policy.runtime import InMotion, action_towards, actor_output, sensed, tip_pose
from mjx_softarm.sensing.load import estimate_load
from mjx_softarm.sensing.pose import pose_error
from mjx_softarm.sensing.sensors import Reading, SensorFault
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
    inputs = *inputs, symbol("load_kg", ()), symbol("pressure_kpa", chambers)
    motion = _in_motion(spec)
    found = answer(controller, *inputs, motion)
    inputs += tuple(motion) if controller.policy.observation == "motion" else ()
    return Computation(inputs, {name: constant(value) for name, value in found.items()})


def answer(
    controller: Controller,
    readings: Array,
    goal: Array,
    last_m: Array,
    load_kg: Array,
    pressure_kpa: Array,
    motion: InMotion,
) -> dict[str, Array]:
    """Return the loop's references for readings (n_springs,) and a goal (6,), with pose, faults and payload.

    A lost reading holds the last length (n_springs,) [m] of its spring. References are NaN if the loop would
    not act: a spring has neither a reading nor a last length, or the goal is outside the workspace. The
    payload () [kg] is the caller's average of estimates at rest, each from pressures (n_chambers,) [kPa].
    Only policies that observe motion use `motion`.
    """
    # References of the policy.
    policy, xp = controller.policy, array_namespace(readings)
    reading = policy.sensor.lengths(readings, last_m)
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
        "reading_lost": _lost(reading),
        "pose": pose,
        "extrapolation": away,
        "goal_outside": ~inside,
        "load_estimate_kg": estimate_load(policy.load_estimator, reading.length_m, pressure_kpa),
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
    # Inputs.
    policy, spec, window = controller.policy, controller.policy.spec, controller.window
    gains, tolerance_m, config = policy.gains, policy.tolerance_m, controller.config
    springs, chambers = (spec.n_springs,), (spec.n_chambers,)
    names = ("readings", "reference_m", "spring_m", "mean_m", "asked_m")
    readings, reference_m, spring_m, mean_m, asked_m = (symbol(name, springs) for name in names)
    pressure_kpa, is_saturated = symbol("pressure_kpa", chambers), symbol("is_saturated", chambers, bool)
    sizes = chambers, springs, springs  # integral, references and lengths of the law
    state = LawState(
        *(symbol(f"last_{name}", size) for name, size in zip(LawState._fields, sizes, strict=True))
    )
    springs_m, pressures_kpa = (
        symbol("springs_m", (window, *springs)),
        symbol("pressures_kpa", (window, *chambers)),
    )
    goal, pose, load_kg = symbol("goal", (6,)), symbol("pose", (6,), np.float32), symbol("load_kg", ())
    xp = readings.__array_namespace__()

    # Belief.
    reading = policy.sensor.lengths(readings, spring_m)
    tip, away = tip_pose(policy, spring_m, load_kg)
    estimate_kg = estimate_load(
        policy.load_estimator, xp.mean(springs_m, axis=0), xp.mean(pressures_kpa, axis=0)
    )
    # Policy and law.
    motion = _in_motion(spec)
    observed = sensed(policy, pose, spring_m, motion, load_kg)
    action = action_towards(policy, pose, xp.asarray(goal, dtype=np.float32), observed)
    written_kpa, after = pressures(reference_m, spring_m, state, gains, controller.dt_s)
    law = {"written_kpa": written_kpa} | {f"next_{name}": value for name, value in after._asdict().items()}
    # Faults, and the way that remains.
    mask = saturated(pressure_kpa, reference_m, spring_m, gains, tolerance_m)
    settled = on_reference(springs_m, reference_m, pressure_kpa, gains, tolerance_m)
    scaled = scaled_error(xp.asarray(pose, dtype=np.float64), goal, policy.reward)
    weighted = xp.sqrt(xp.sum(scaled * scaled))
    stuck = stuck_springs(springs_m, pressures_kpa, spec.structure.n_sections, config)
    without = as_without(policy.spring_model, pressure_kpa, spring_m, config, gains.allocation)
    moved = reference_m, mean_m, asked_m, is_saturated
    search = symbol("search", reach.begin(policy, 1).shape)
    found, error = reach.nearest_of(policy, goal[None], search)

    def of(*inputs: Symbol, **outputs: Symbol) -> Computation:
        return Computation(inputs, outputs)

    return {
        "lengths": of(readings, spring_m, length_m=reading.length_m, lost=_lost(reading)),
        "estimated_load": of(springs_m, pressures_kpa, kg=estimate_kg),
        "left": of(pose, goal, off=pose_error(xp.asarray(pose, dtype=np.float64), goal), error=weighted),
        "tip": of(spring_m, load_kg, tip=tip, away=constant(away)),
        "references": of(pose, goal, spring_m, *motion, load_kg, asked_m=policy.actions.lengths(action)),
        "law": of(reference_m, spring_m, *state, **law),
        "vented": of(pressure_kpa, next_kpa=vented(pressure_kpa, controller.dt_s)),
        "inside": of(goal, holds=_inside(controller, goal)),
        "search_begin": of(search=constant(reach.begin(policy, 1))),
        "search_step": of(goal, search, next=reach.improve(policy, goal[None], search)),
        "search_end": of(search, goal, nearest=found[0], error=error[0]),
        "mean_length": of(springs_m, mean_m=xp.mean(springs_m, axis=0)),
        "still": of(springs_m, holds=still(springs_m, config)),
        "on_reference": of(springs_m, reference_m, pressure_kpa, holds=settled),
        "saturated": of(pressure_kpa, reference_m, spring_m, mask=mask),
        "followed": of(*moved, lengths_m=followed(*moved, policy)),
        "stuck": of(springs_m, pressures_kpa, mask=stuck),
        "as_without": of(pressure_kpa, spring_m, mask=without),
    }


def _in_motion(spec: ArmSpec) -> InMotion:
    sizes = spec.n_springs, spec.n_springs, spec.n_chambers
    return InMotion(*(symbol(name, (n,)) for name, n in zip(InMotion._fields, sizes, strict=True)))


def _lost(reading: Reading) -> Array:
    """Return which readings (n_springs,) gave no length."""
    return reading.fault != SensorFault.OK.value
