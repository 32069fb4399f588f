"""The paper's claims of load-independence and of no saturation, in simulation, one cause changed at a time.

All policies learn alike, through the gradient of the simulated equilibrium; `KINDS` says in which settings
they differ. A policy may command nine pressures in place of nine spring lengths, which the sensor-space law
holds. The loss's term that pulls references of saturated chambers back may be left out; pressures have no
references, so they always go without it. Some kinds learn with payloads, and some of these observe them.

Then the arm carries payloads. The policy sees the true pose of the tip after each of four actions, and the
true payload if it observes it, so no estimate adds an error. Gradient descent on the springs knows no
pressures. It goes to some of the goals without a payload, with as many searches as a policy has actions.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.harness.common import grouped
from benchmarks.paper.gradient_descent import gradient_descent
from mjx_softarm import ArmSpec
from mjx_softarm._support import cli, xla
from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from mjx_softarm.env.state import PAYLOAD_SHARE, State
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.mechanics.settle import settle_pressures
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED
from mjx_softarm.policy.file import SHIPPED, load_policy
from train.agent.registry import epoch_of
from train.config import TrainConfig, override
from train.presets import PRESETS
from train.runs import evaluate
from train.runs.evaluate import N_GOALS, Reached, paths_of, start_keys, towards
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


class PolicyKind(NamedTuple):
    """Environment and settings of a kind of policy."""

    settings: tuple[str, ...]  # NAME=VALUE
    env: Callable[..., ReachEnv] = ReachEnv


# Learning rates are each kind's best of 2e-3, 5e-4 and 1e-4 in runs of 65,536 env steps: the least held-out
# medians in the mean over payloads, with a seed that is not used again. Chosen at commit e54133e.
FAST, SLOW = "learner.learning_rate=2e-3", "learner.learning_rate=5e-4"
LARGEST_KG = ArmSpec.default().mass.largest_payload_kg
LOADED = f"env.randomisation.payload_max_kg={LARGEST_KG}"
OBSERVED = "env.observation=payload"
NO_TERM = "learner.saturation_cost_per_mm=0"
KINDS = {
    "spring lengths": PolicyKind((FAST,)),
    "no saturation term": PolicyKind((SLOW, NO_TERM)),
    "pressures": PolicyKind((SLOW, NO_TERM), PressureEnv),  # the term would read actions as spring lengths
    "spring lengths, learned with payloads": PolicyKind((FAST, LOADED)),
    "spring lengths, payload observed": PolicyKind((FAST, OBSERVED)),
    "pressures, payload observed": PolicyKind((FAST, OBSERVED, NO_TERM), PressureEnv),
}


def measure(
    seeds: cli.Integers = (0, 1, 2), steps: int = 1_048_576, goals: int = N_GOALS, arms: int = 64
) -> dict[str, Any]:
    """Do spring lengths make a policy independent of the load, and does it avoid saturated chambers?

    Args:
        seeds: of training
        steps: environment steps of training
        goals: held-out goals of each of the two sets
        arms: of a gradient step
    """
    spec, loads = ArmSpec.default(), []
    base = override(PRESETS["analytic"], [f"learner.total_env_steps={steps}", f"learner.n_arms={arms}"])
    # Policies, at all goals with each payload.
    for name, kind in KINDS.items():
        trained = PolicyTrial(kind, override(base, kind.settings), spec, goals)
        for seed in seeds:
            loads += [{"commands": name, "seed": seed, **row} for row in trained.run(seed)]
    # Gradient descent, at some goals without one.
    descent = Descent(ReachEnv(spec), goals)
    loads += [{"commands": SOLVER, "seed": seed, "load_g": 0, **descent.run(seed)} for seed in seeds]
    return {
        "settings": {"seeds": list(seeds), "env_steps": steps, "goals": goals},
        "under loads": means(loads, ("commands", "load_g")),
        "loads of all runs": loads,
    }


class PolicyTrial:
    """Training and evaluation of one kind of policy, each compiled once."""

    def __init__(self, kind: PolicyKind, config: TrainConfig, spec: ArmSpec, n_goals: int):
        self.config, self.n_goals = config, n_goals
        loaded = Randomisation(payload_max_kg=LARGEST_KG)
        env = kind.env(spec, EnvConfig(observation=config.env.observation, randomisation=loaded))
        self.paths = paths_of(jnp.concatenate(goals_of(env, n_goals)))
        self.keys = start_keys(len(self.paths))
        self._job = task_of(config, kind.env(spec, config.env)).job
        one = functools.partial(follow, env, epoch_of(config.learner, env).learner)
        self._follow = xla.jit(jax.vmap(one, in_axes=(None, None, 0, 0)))

    def run(self, seed: int) -> list[dict[str, Any]]:
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


class Descent:
    """Gradient descent by the estimator of the policy that ships; it knows of no payload."""

    def __init__(self, env: ReachEnv, n_goals: int):
        self.env, self.solve = env, gradient_descent(load_policy(SHIPPED))
        self.step, self.reset = xla.jit(env.step), xla.jit(env.reset)
        self.sets = [np.asarray(poses) for poses in goals_of(env, n_goals)]

    def run(self, seed: int) -> dict[str, float]:
        """Return its figures at some goals of both sets, other ones for each seed, from a random pose."""
        rng = np.random.default_rng(seed)
        some = [rng.choice(poses, min(N_SOLVED, len(poses)), replace=False) for poses in self.sets]
        return figures(*self.along(np.concatenate(some), jax.random.PRNGKey(seed)))

    def along(self, path: np.ndarray, key: Array) -> np.ndarray:
        """Return tip errors [mm] and saturated chambers (2, n) at the goals of a path (n, 6)."""
        state, found = self.reset(key), []
        for goal in path:
            for _ in range(N_ACTIONS):
                arm = state.pipeline_state
                spring_m = self.solve(np.asarray(arm.pose), goal, np.asarray(arm.spring_m, float), None)
                action = self.env.action_of(jnp.asarray(spring_m))
                state = self.step(towards(self.env, state, goal), action)
            found.append([float(state.metrics[name]) for name in ("tip_error_mm", "saturated_chambers")])
        return np.array(found).T


def means(rows: list[dict[str, Any]], by: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return the mean and the standard deviation over seeds of all figures, for each value of `by`."""
    found = []
    for key, group in grouped(rows, by).items():
        names = [name for name in group[0] if name not in (*by, "seed")]
        values = np.array([[row[name] for name in names] for row in group])
        told = (f"{mean:.2f} ± {off:.2f}" for mean, off in zip(values.mean(0), values.std(0), strict=True))
        found.append(dict(zip(by, key, strict=True)) | dict(zip(names, told, strict=True)))
    return found
