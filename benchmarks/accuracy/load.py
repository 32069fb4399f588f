"""Load-independence: what does a policy gain that commands spring lengths instead of pressures?

Both are trained alike, through the gradient of the simulated equilibrium, on arms without a payload. Then
the arm carries one that the policy does not know. It sees the true pose of the tip after each of four
actions, so that no estimate of pose or payload stands between the two. Nothing differs but what an action
asks for: nine lengths, which the sensor-space law holds with whatever pressures it takes, or nine pressures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from benchmarks.harness.common import goal
from mjx_softarm import ArmSpec
from mjx_softarm._support import cli
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.state import ArmState
from mjx_softarm.mechanics.dynamics import Motion
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.settle import Settled, settle_pressures
from train.presets import PRESETS
from train.runs.evaluate import N_GOALS, Evaluator
from train.runs.task import task_of

LOADS_G = (0, 250, 500, 1000)
LIGHT_G, TIMES = 500, 5.0  # the goal: with this payload, held pressures are so many times as far off


class PressureEnv(ReachEnv):
    """The arm at rest, with actions that are pressures: -1 is the least, 1 the greatest."""

    def move(self, arm: ArmState, action: Array) -> tuple[Motion, Settled, Array]:
        """Return the arm at rest at the pressures; its readings are not asked to be anything else."""
        params = self.params_of(arm)
        low, high = params.pressure_min_kpa, params.pressure_max_kpa
        pressure_kpa = low + 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0) * (high - low)
        end = settle_pressures(chain_kinematics(params), params, pressure_kpa)
        reading_m = jax.lax.stop_gradient(end.spring_m) + arm.sensor_offset_m
        return Motion.at_rest(end.q, end.pressure_kpa, end.spring_m), end, reading_m


KINDS: dict[str, Callable[..., ReachEnv]] = {"spring lengths": ReachEnv, "pressures": PressureEnv}


def measure(
    seeds: cli.Integers = (0, 1, 2), steps: int = 262_144, goals: int = N_GOALS, arms: int = 64
) -> dict[str, Any]:
    """Compare policies that command spring lengths with those that command pressures, under a payload.

    Args:
        seeds: of training
        steps: environment steps of training
        goals: held-out goals
        arms: of a gradient step
    """
    rows = [row for kind in KINDS for seed in seeds for row in of_policy(kind, seed, steps, goals, arms)]
    means = {
        (kind, load_g): sum(row["median_mm"] for row in rows if _is(row, kind, load_g)) / len(seeds)
        for kind in KINDS
        for load_g in LOADS_G
    }
    lengths_mm, pressures_mm = (means[kind, LIGHT_G] for kind in KINDS)
    ratio = pressures_mm / lengths_mm
    text = f"{LIGHT_G} g: held pressures at least {TIMES:g} times as far off as held spring lengths"
    return {
        "settings": {"seeds": list(seeds), "env_steps": steps, "goals": goals, "arms": arms},
        "goals": [goal(text, f"{ratio:.1f} times", ratio >= TIMES)],
        "means": [
            {"commands": kind, "load_g": load_g, "median_mm": mm} for (kind, load_g), mm in means.items()
        ],
        "runs": rows,
    }


def of_policy(kind: str, seed: int, steps: int, n_goals: int, n_arms: int) -> list[dict[str, Any]]:
    """Train a policy of a kind, a key of `KINDS`, and return its figures under each payload."""
    config = dataclasses.replace(PRESETS["analytic"], seed=seed, total_env_steps=steps, n_arms=n_arms)
    make, spec = KINDS[kind], ArmSpec.default()
    job = task_of(config, make(spec, config.env)).job
    state = job.start(lambda: job.init(jax.random.PRNGKey(seed)))
    for _ in range(config.n_epochs):
        state, _ = job.epoch(state)
    policy, rows = job.policy(state), []
    for load_g in LOADS_G:
        loaded = spec.replace(mass={"payload_kg": spec.mass.payload_kg + 1e-3 * load_g})
        summary, *_ = Evaluator(make(loaded, EnvConfig()), job.learner, n_goals)(policy)
        figures = {name: getattr(summary, name) for name in ("median_mm", "p95_mm", "unsettled")}
        rows.append({"commands": kind, "seed": seed, "load_g": load_g, **figures})
    return rows


def _is(row: dict[str, Any], kind: str, load_g: int) -> bool:
    return row["commands"] == kind and row["load_g"] == load_g
