"""Computations of a policy that other languages take over, recorded from the functions that Python runs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm.control import pressures, saturated
from mjx_softarm.deploy import faults
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.link import vented
from mjx_softarm.deploy.reachability import distances
from mjx_softarm.export.symbols import Symbol, constant, symbol
from mjx_softarm.mdp.observation import OBS_SIZE
from mjx_softarm.policy.runtime import action_towards, actor_output, tip_pose
from mjx_softarm.sensing.sensors import Reading, SensorFault


class Computation(NamedTuple):
    """One function of named arrays."""

    inputs: tuple[Symbol, ...]
    outputs: dict[str, Symbol]


def graph(controller: Controller) -> Computation:
    """Record readings, goal and last lengths -> references, as the loop takes them when it acts.

    A lost reading holds the last length of its spring. References are NaN where the loop would give none: a
    spring has neither a reading nor a last length, or the goal is outside the workspace.
    """
    policy, n = controller.policy, controller.policy.spec.n_chambers
    readings, goal, last_m = symbol("readings", (n,)), symbol("goal", (6,)), symbol("last_length_m", (n,))
    xp = readings.__array_namespace__()
    reading = policy.sensor.lengths(readings, last_m)
    pose, away = tip_pose(policy, reading.length_m)
    reference = policy.actions.readings(action_towards(policy, pose, xp.asarray(goal, dtype=np.float32)))
    # A distance that is NaN is not within the limit, nor is a length that is NaN finite.
    inside = xp.min(distances(controller.reachable, goal, policy.reward)) <= 1.0
    acts = inside & xp.all(xp.isfinite(reading.length_m))
    outputs = {
        "reference_m": xp.where(acts, policy.sensor.lengths(reference).length_m, np.nan),
        "reference_reading": xp.where(acts, reference, np.nan),
        "length_m": reading.length_m,
        "reading_lost": _lost(reading),
        "pose": pose,
        "extrapolation": constant(away),
        "goal_outside": ~inside,
    }
    return Computation((readings, goal, last_m), outputs)


def actor(controller: Controller) -> Computation:
    """Record the bare actor: observation (18,) -> action (n,) in [-1, 1]."""
    observation = symbol("observation", (OBS_SIZE,), np.float32)
    return Computation((observation,), {"action": actor_output(controller.policy, observation)})


def parts(controller: Controller) -> dict[str, Computation]:
    """Record the functions that `mjx_softarm.deploy.loop` is made of, each by its name in C++."""
    policy, n, window = controller.policy, controller.policy.spec.n_chambers, controller.window
    gains, tolerance_m = policy.gains, policy.tolerance_m
    names = ("readings", "reference_m", "spring_m", "integral_kpa", "pressure_kpa")
    readings, reference_m, spring_m, integral_kpa, pressure_kpa = (symbol(name, (n,)) for name in names)
    springs_m, pressures_kpa = (symbol(name, (window, n)) for name in ("springs_m", "pressures_kpa"))
    goal, pose = symbol("goal", (6,)), symbol("pose", (6,), np.float32)
    xp = readings.__array_namespace__()

    reading = policy.sensor.lengths(readings, spring_m)
    tip, away = tip_pose(policy, spring_m)
    action = action_towards(policy, pose, xp.asarray(goal, dtype=np.float32))
    written_kpa, next_kpa = pressures(reference_m, spring_m, integral_kpa, gains, controller.dt_s)
    law = {"pressure_kpa": written_kpa, "next_integral_kpa": next_kpa}
    mask = saturated(pressure_kpa, reference_m, spring_m, gains, tolerance_m)
    settled = faults.on_reference(springs_m, reference_m, pressure_kpa, gains, tolerance_m)
    stuck = faults.stock_still(springs_m) & faults.asked_to_move(springs_m, pressures_kpa)
    near = xp.min(distances(controller.reachable, goal, policy.reward))

    def of(*inputs: Symbol, **outputs: Symbol) -> Computation:
        return Computation(inputs, outputs)

    return {
        "lengths": of(readings, spring_m, length_m=reading.length_m, lost=_lost(reading)),
        "tip": of(spring_m, tip=tip, away=constant(away)),
        "references": of(pose, goal, asked_m=policy.actions.lengths(action)),
        "law": of(reference_m, spring_m, integral_kpa, **law),
        "vented": of(pressure_kpa, next_kpa=vented(pressure_kpa, controller.dt_s)),
        "goal_distance": of(goal, distance=near),
        "mean_length": of(springs_m, mean_m=xp.mean(springs_m, axis=0)),
        "still": of(springs_m, holds=faults.still(springs_m)),
        "on_reference": of(springs_m, reference_m, pressure_kpa, holds=settled),
        "saturated": of(pressure_kpa, reference_m, spring_m, mask=mask),
        "stuck": of(springs_m, pressures_kpa, mask=stuck),
        "as_without": of(
            pressure_kpa, spring_m, mask=faults.as_without(policy.spring_model, pressure_kpa, spring_m)
        ),
    }


def _lost(reading: Reading) -> Symbol:
    """Return which readings (n,) gave no length."""
    return reading.fault != SensorFault.OK.value
