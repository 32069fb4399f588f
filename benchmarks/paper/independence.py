"""The paper's claims of load-independence and of no saturation, in simulation, one cause changed at a time.

All policies learn through the gradient of the equilibrium; `POLICIES` says where they differ. They see the
true pose, and the true payload if they observe it, so no estimate adds an error.
"""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.harness.common import over_runs
from benchmarks.paper.gradient_descent import gradient_descent
from benchmarks.paper.trials import Settings
from mjx_softarm import ArmSpec
from mjx_softarm._support import xla
from mjx_softarm._support.provenance import write_json
from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from mjx_softarm.env.reach import PAYLOAD_SHARE
from mjx_softarm.env.state import State
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.mechanics.settle import settle_pressures
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED
from mjx_softarm.policy.file import SHIPPED, load_policy
from train.config import override
from train.presets import PRESETS
from train.runs import evaluate
from train.runs.evaluate import Reached, paths_of, start_keys, towards
from train.runs.run import task_of

LOADS_G = (0, 250, 500, 1000)
FIGURES = ("median_mm", "mean_mm", "p95_mm", "saturated_percent")
SOLVER, N_SOLVED = "gradient descent", 50  # goals of each set, for each seed


class PressureEnv(ReachEnv):
    """The arm at rest, with actions that are pressures: -1 is the least, 1 the greatest."""

    def step(self, state: State, action: Array) -> State:
        """Go to the lengths at which these pressures hold the arm with its payload; see `ReachEnv.step`."""
        arm = state.pipeline_state
        params = self.params_of(arm)
        low, high = params.pressure_min_kpa, params.pressure_max_kpa
        pressure_kpa = low + 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0) * (high - low)
        held = settle_pressures(params, pressure_kpa, self.n_at_once)
        return super().step(state, self.action_of(held.spring_m))


class Commands(NamedTuple):
    """Commands of a policy, and settings that it learns with."""

    settings: tuple[str, ...]  # NAME=VALUE
    env: Callable[..., ReachEnv] = ReachEnv


# Learning rates are each kind's best of 2e-3, 5e-4 and 1e-4 in runs of 65,536 env steps: the least held-out
# medians in the mean over payloads, with a seed that is not used again. Chosen at commit e54133e.
FAST, SLOW = "learner.learning_rate=2e-3", "learner.learning_rate=5e-4"
LARGEST_KG = ArmSpec.default().mass.largest_payload_kg
LOADED = f"env.randomisation.payload_max_kg={LARGEST_KG}"
OBSERVED = "env.observation=payload"
NO_TERM = "learner.saturation_cost_per_mm=0"
POLICIES = {
    "spring lengths": Commands((FAST,)),
    "no saturation term": Commands((SLOW, NO_TERM)),
    "pressures": Commands((SLOW, NO_TERM), PressureEnv),  # the term would read actions as spring lengths
    "spring lengths, learned with payloads": Commands((FAST, LOADED)),
    "spring lengths, payload observed": Commands((FAST, OBSERVED)),
    "pressures, payload observed": Commands((FAST, OBSERVED, NO_TERM), PressureEnv),
}


def result(name: str, seed: int) -> str:
    """Return the file of a policy, or of the solver, in the folder."""
    return f"independence/{name.replace(',', '').replace(' ', '-')}-seed{seed}.json"


def measure(folder: Path, settings: Settings, name: str, seed: int) -> None:
    """Train a policy, or take the solver, and write its errors with each payload."""
    xla.enable_compilation_cache()
    rows = descent_rows(settings, seed) if name == SOLVER else policy_rows(settings, name, seed)
    (folder / "independence").mkdir(exist_ok=True)
    write_json(folder / result(name, seed), rows)


def figures_of(folder: Path, settings: Settings) -> dict[str, Any]:
    """Return the figures of all seeds, and their spreads."""
    runs = [
        {"commands": name, "seed": seed, **row}
        for name, seed in itertools.product((*POLICIES, SOLVER), settings.seeds)
        for row in json.loads((folder / result(name, seed)).read_text("utf-8"))
    ]
    return {
        "env_steps": settings.independence_steps,
        "goals": settings.n_goals,
        "spreads": over_runs(runs, ("commands", "load_g"), FIGURES),
        "runs": runs,
    }


def policy_rows(settings: Settings, name: str, seed: int) -> list[dict[str, Any]]:
    """Train one policy; return its figures at the goals of both sets with each payload."""
    kind, spec = POLICIES[name], ArmSpec.default()
    steps = f"learner.total_env_steps={settings.independence_steps}"
    config = override(PRESETS["analytic"], [steps, *kind.settings])
    job = task_of(config, kind.env(spec, config.env)).job
    state = job.start(lambda: job.init(jax.random.PRNGKey(seed)))
    for _ in range(config.learner.n_epochs):
        state, _ = job.epoch(state)
    policy = jax.device_get(job.learner.policy(state.learner))
    loaded = Randomisation(payload_max_kg=LARGEST_KG)
    env_config = EnvConfig(engine="chain", observation=config.env.observation, randomisation=loaded)
    env = kind.env(spec, env_config)
    paths = paths_of(jnp.concatenate(goals_of(env, settings.n_goals)))
    one = functools.partial(follow, env, config.learner.make_epoch(env).learner)
    follow_all = xla.jit(jax.vmap(one, in_axes=(None, None, 0, 0)))
    rows = []
    for load_g in LOADS_G:
        reached = jax.device_get(follow_all(policy, 1e-3 * load_g, paths, start_keys(len(paths))))
        at_goals = (np.ravel(reached.tip_error_mm), np.ravel(reached.saturated_chambers))
        rows.append({"load_g": load_g, **figures(*(x[: 2 * settings.n_goals] for x in at_goals))})
    return rows


def goals_of(env: ReachEnv, n_goals: int) -> list[Array]:
    """Return n held-out goals (n_goals, 6) [mm, deg] of each of the two sets."""
    return [env.sample_pool(n_goals, HELD_OUT_SEED, evenly).pose for evenly in (False, True)]


def follow(env: ReachEnv, learner: Any, policy: Any, load_kg: Array, path: Array, key: Array) -> Reached:
    """Return the results of one arm with a payload, from a random start, along a path (n, 6) of goals."""
    noise = env.sample_noise(key, 1)[0].at[PAYLOAD_SHARE].set(load_kg / env.payload_max_kg)
    return evaluate.follow(env, learner, policy, path, env.reset_from(noise))


def figures(off_mm: np.ndarray, n_saturated: np.ndarray) -> dict[str, float]:
    """Return figures of tip errors [mm] and numbers of saturated chambers at goals (n,)."""
    return {
        "median_mm": float(np.median(off_mm)),
        "mean_mm": float(np.mean(off_mm)),
        "p95_mm": float(np.quantile(off_mm, 0.95)),
        "saturated_percent": 100 * float(np.mean(n_saturated > 0)),
    }


def descent_rows(settings: Settings, seed: int) -> list[dict[str, Any]]:
    """Return the figures of gradient descent without a payload, by the estimator of the policy that ships.

    Each seed has other goals of both sets.
    """
    env, solve = ReachEnv(config=EnvConfig(engine="chain")), gradient_descent(load_policy(SHIPPED))
    step, state = xla.jit(env.step), xla.jit(env.reset)(jax.random.PRNGKey(seed))
    rng, ends = np.random.default_rng(seed), []
    for poses in map(np.asarray, goals_of(env, settings.n_goals)):
        for goal in rng.choice(poses, min(N_SOLVED, len(poses)), replace=False):
            for _ in range(N_ACTIONS):
                arm = state.pipeline_state
                spring_m = solve(np.asarray(arm.pose), goal, np.asarray(arm.spring_m, float), None)
                state = step(towards(env, state, goal), env.action_of(jnp.asarray(spring_m)))
            ends.append([float(state.metrics[name]) for name in ("tip_error_mm", "saturated_chambers")])
    return [{"load_g": 0, **figures(*np.array(ends).T)}]
