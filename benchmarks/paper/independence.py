"""The paper's claims of load-independence and of no saturation, in simulation, one cause changed at a time.

All policies learn alike, through the gradient of the simulated equilibrium; `POLICIES` says in which settings
they differ. A policy may command nine pressures in place of nine spring lengths, which the sensor-space law
holds. The loss's term that pulls references of saturated chambers back may be left out; pressures have no
references, so they always go without it. Some kinds learn with payloads, and some of these observe them.

Then the arm carries payloads. The policy sees the true pose of the tip after each of four actions, and the
true payload if it observes it, so no estimate adds an error. Gradient descent on the springs knows no
pressures. It goes to some of the goals without a payload, with as many searches as a policy has actions.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.harness.common import grouped
from benchmarks.paper.gradient_descent import gradient_descent
from benchmarks.paper.trials import Settings
from mjx_softarm import ArmSpec
from mjx_softarm._support import xla
from mjx_softarm._support.provenance import write_json
from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from mjx_softarm.env.state import PAYLOAD_SHARE, State
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.mechanics.settle import settle_pressures
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED
from mjx_softarm.policy.file import SHIPPED, load_policy
from train.agent.registry import epoch_of
from train.config import override
from train.presets import PRESETS
from train.runs import evaluate
from train.runs.evaluate import Reached, paths_of, start_keys, towards
from train.runs.task import task_of

LOADS_G = (0, 250, 500, 1000)
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
        return super().step(state, self.action_of(held.spring_m + arm.sensor_offset_m))


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


def results_of(name: str, seeds: Iterable[int]) -> tuple[str, ...]:
    """Return the files of a kind of policy, or of the solver, in the folder."""
    words = name.replace(",", "").replace(" ", "-")
    return tuple(f"independence/{words}-seed{seed}.json" for seed in seeds)


def measure(folder: Path, settings: Settings, name: str) -> None:
    """Train policies of a kind, or take the solver, and write the errors of each seed with each payload."""
    (folder / "independence").mkdir(exist_ok=True)
    rows_of = descent(settings) if name == SOLVER else PolicyTrial(name, settings).rows
    for seed, path in zip(settings.seeds, results_of(name, settings.seeds), strict=True):
        if not (folder / path).exists():
            write_json(folder / path, rows_of(seed))


def figures_of(folder: Path, settings: Settings) -> dict[str, Any]:
    """Return the figures of all seeds, and their means."""
    runs = [
        {"commands": name, "seed": seed, **row}
        for name in (*POLICIES, SOLVER)
        for seed, path in zip(settings.seeds, results_of(name, settings.seeds), strict=True)
        for row in json.loads((folder / path).read_text("utf-8"))
    ]
    return {
        "env_steps": settings.independence_steps,
        "goals": settings.n_goals,
        "under loads": means(runs, ("commands", "load_g")),
        "loads of all runs": runs,
    }


class PolicyTrial:
    """Training and evaluation of one kind of policy, each compiled once."""

    def __init__(self, name: str, settings: Settings):
        xla.enable_compilation_cache()
        steps = f"learner.total_env_steps={settings.independence_steps}"
        kind, spec = POLICIES[name], ArmSpec.default()
        self.config, self.n_goals = override(PRESETS["analytic"], [steps, *kind.settings]), settings.n_goals
        seen, loaded = self.config.env.observation, Randomisation(payload_max_kg=LARGEST_KG)
        env = kind.env(spec, EnvConfig(engine="chain", observation=seen, randomisation=loaded))
        self.paths = paths_of(jnp.concatenate(goals_of(env, self.n_goals)))
        self.keys = start_keys(len(self.paths))
        self._job = task_of(self.config, kind.env(spec, self.config.env)).job
        one = functools.partial(follow, env, epoch_of(self.config.learner, env).learner)
        self._follow = xla.jit(jax.vmap(one, in_axes=(None, None, 0, 0)))

    def rows(self, seed: int) -> list[dict[str, Any]]:
        """Train one policy; return its figures with each payload."""
        state = self._job.start(lambda: self._job.init(jax.random.PRNGKey(seed)))
        for _ in range(self.config.learner.n_epochs):
            state, _ = self._job.epoch(state)
        policy = jax.device_get(self._job.policy(state))
        return [{"load_g": load_g, **self._figures(policy, load_g)} for load_g in LOADS_G]

    def _figures(self, policy: Any, load_g: int) -> dict[str, float]:
        """Return the figures at the goals of both sets."""
        found = jax.device_get(self._follow(policy, 1e-3 * load_g, self.paths, self.keys))
        at_goals = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: 2 * self.n_goals], found)
        return figures(np.asarray(at_goals.tip_error_mm), np.asarray(at_goals.saturated_chambers))


def goals_of(env: ReachEnv, n_goals: int) -> list[Array]:
    """Return n held-out goals (n_goals, 6) [mm, deg] of each of the two sets."""
    return [env.sample_pool(n_goals, HELD_OUT_SEED, evenly).pose for evenly in (False, True)]


def follow(env: ReachEnv, learner: Any, policy: Any, load_kg: Array, path: Array, key: Array) -> Reached:
    """Return the results of one arm with a payload, from a random start, along a path (n, 6) of goals."""
    noise = jax.tree.map(lambda x: x[0], env.sample_noise(key, 1))
    share = noise.uniform.at[PAYLOAD_SHARE].set(load_kg / env.payload_max_kg)
    return evaluate.follow(env, learner, policy, path, env.reset_from(noise._replace(uniform=share)))


def figures(off_mm: np.ndarray, n_saturated: np.ndarray) -> dict[str, float]:
    """Return figures of tip errors [mm] and numbers of saturated chambers at goals (n,)."""
    return {
        "median_mm": float(np.median(off_mm)),
        "mean_mm": float(np.mean(off_mm)),
        "p95_mm": float(np.quantile(off_mm, 0.95)),
        "saturated_percent": 100 * float(np.mean(n_saturated > 0)),
    }


def descent(settings: Settings) -> Callable[[int], list[dict[str, Any]]]:
    """Return a function, seed -> figures of gradient descent, which knows of no payload.

    It goes to some goals of both sets, other ones for each seed, from a random pose, by the estimator of the
    policy that ships.
    """
    env, solve = ReachEnv(config=EnvConfig(engine="chain")), gradient_descent(load_policy(SHIPPED))
    step, reset = xla.jit(env.step), xla.jit(env.reset)
    sets = [np.asarray(poses) for poses in goals_of(env, settings.n_goals)]

    def rows(seed: int) -> list[dict[str, Any]]:
        rng, state = np.random.default_rng(seed), reset(jax.random.PRNGKey(seed))
        ends = []
        for goal in np.concatenate(
            [rng.choice(poses, min(N_SOLVED, len(poses)), replace=False) for poses in sets]
        ):
            for _ in range(N_ACTIONS):
                arm = state.pipeline_state
                spring_m = solve(np.asarray(arm.pose), goal, np.asarray(arm.spring_m, float), None)
                state = step(towards(env, state, goal), env.action_of(jnp.asarray(spring_m)))
            ends.append([float(state.metrics[name]) for name in ("tip_error_mm", "saturated_chambers")])
        return [{"load_g": 0, **figures(*np.array(ends).T)}]

    return rows


def means(rows: list[dict[str, Any]], by: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return the mean and the standard deviation over seeds of all figures, for each value of `by`."""
    table = []
    for key, group in grouped(rows, by).items():
        names = [name for name in group[0] if name not in (*by, "seed")]
        values = np.array([[row[name] for name in names] for row in group])
        cells = (f"{mean:.2f} ± {off:.2f}" for mean, off in zip(values.mean(0), values.std(0), strict=True))
        table.append(dict(zip(by, key, strict=True)) | dict(zip(names, cells, strict=True)))
    return table
