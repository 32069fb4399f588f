"""The paper's claims of load-independence and of no saturation, in simulation, one cause changed at a time.

All policies learn alike, through the gradient of the simulated equilibrium, the first three of `KINDS` on
arms without a payload. One changes what an action asks for: nine pressures in place of nine spring lengths,
which the sensor-space law holds with whatever pressures it takes. Another leaves out the loss's term that
pulls references of saturated chambers back; pressures have no references, so they go without it, too. Three
more learn with payloads: spring lengths without and with the payload observed, and pressures with it. The
learning rate is each kind's own best of `RATES`, by the held-out medians, in the mean over the payloads, of a
shorter run with a seed that is not used again.

Then the arm carries payloads. The policy sees the true pose of the tip after each of four actions, and the
true payload if it observes it, so no estimate adds an error of its own. Without a payload it goes twice
around circles of `SIZES` times the paper's, and the second lap counts. Gradient descent on the springs, which
solves for lengths and knows no pressures, goes without a payload to some of the goals, others for each seed,
with as many searches as a policy has actions, and once around the same circles.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.paper.gradient_descent import gradient_descent
from mjx_softarm import ArmSpec
from mjx_softarm._support import cli, xla
from mjx_softarm._support.mjx import State
from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from mjx_softarm.env.state import PAYLOAD_SHARE
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.mechanics.excitation import CIRCLE_DIAMETER_MM, circle_poses
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.settle import settle_pressures
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED
from mjx_softarm.policy.file import SHIPPED, load_policy
from train.config import TrainConfig, override
from train.presets import PRESETS
from train.runs import evaluate
from train.runs.evaluate import N_GOALS, PATH, Reached, paths_of, start_keys, towards
from train.runs.task import learner_of, task_of

LOADS_G = (0, 250, 500, 1000)
SIZES = (0.75, 1.0, 1.25, 1.5)  # of the paper's circle: 120 to 240 mm
N_CIRCLE = PATH // 2  # points of a lap
RATES = (2e-3, 5e-4, 1e-4)
TUNING_SEED, TUNING_SHARE = 100, 0.25  # share of a run's steps
SOLVER, N_SOLVED = "gradient descent", 50  # goals of each set, for each seed
N_SEARCHES = 2  # for each point of a circle, the second from where the first has led


class PressureEnv(ReachEnv):
    """The arm at rest, with actions that are pressures: -1 is the least, 1 the greatest."""

    def step(self, state: State, action: Array) -> State:
        """Go to the lengths at which these pressures hold the arm with its payload; see `ReachEnv.step`."""
        arm = state.pipeline_state
        params = self.params_of(arm)
        low, high = params.pressure_min_kpa, params.pressure_max_kpa
        pressure_kpa = low + 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0) * (high - low)
        held = settle_pressures(chain_kinematics(params), params, pressure_kpa)
        return super().step(state, self.action_of(held.spring_m + arm.sensor_offset_m))


class Kind(NamedTuple):
    """Environment and settings of a kind of policy, where they differ from the first."""

    env: Callable[..., ReachEnv] = ReachEnv
    settings: tuple[str, ...] = ()  # NAME=VALUE


LARGEST_KG = ArmSpec.default().mass.largest_payload_kg
LOADED = (f"env.randomisation.payload_max_kg={LARGEST_KG}",)
OBSERVED = ("env.observation=payload",)
NO_TERM = ("analytic.saturation_cost_per_mm=0",)
KINDS = {
    "spring lengths": Kind(),
    "no saturation term": Kind(settings=NO_TERM),
    "pressures": Kind(PressureEnv, NO_TERM),  # the term would read these actions as spring lengths
    "spring lengths, learned with payloads": Kind(settings=LOADED),
    "spring lengths, payload observed": Kind(settings=OBSERVED),
    "pressures, payload observed": Kind(PressureEnv, (*OBSERVED, *NO_TERM)),
}


def measure(
    seeds: cli.Integers = (0, 1, 2), steps: int = 1_048_576, goals: int = N_GOALS, arms: int = 64
) -> dict[str, Any]:
    """Compare what actions ask for under payloads, and learning with and without a saturation term.

    Args:
        seeds: of training
        steps: environment steps of training
        goals: held-out goals of each of the two sets
        arms: of a gradient step
    """
    spec = ArmSpec.default()
    base = override(PRESETS["analytic"], [f"total_env_steps={steps}", f"n_arms={arms}"])
    loads, circles, rates = [], [], {}
    for name, kind in KINDS.items():
        config = override(base, kind.settings)
        trial = Trial(kind, config, spec, goals)
        rates[name] = trial.best_rate()
        for seed in seeds:
            at_goals, around = trial.run(seed, rates[name])
            loads += [{"commands": name, "seed": seed, **row} for row in at_goals]
            circles += [{"way": name, "seed": seed, **row} for row in around]
    descent = Descent(spec, goals)
    for seed in seeds:
        at_goals, around = descent.run(seed)
        loads.append({"commands": SOLVER, "seed": seed, "load_g": 0, **at_goals})
        circles += [{"way": SOLVER, "seed": seed, **row} for row in around]
    return {
        "settings": {"seeds": list(seeds), "env_steps": steps, "goals": goals, "learning_rates": rates},
        "under loads": means(loads, ("commands", "load_g")),
        "circles": means(circles, ("way", "diameter_mm")),
        "loads of all runs": loads,
        "circles of all runs": circles,
    }


class Trial:
    """Training and evaluation of one kind of policy, each compiled once for a learning rate."""

    def __init__(self, kind: Kind, config: TrainConfig, spec: ArmSpec, n_goals: int):
        self.kind, self.config, self.spec, self.n_goals = kind, config, spec, n_goals
        loaded = Randomisation(payload_max_kg=LARGEST_KG)
        self.env = kind.env(spec, EnvConfig(observation=config.env.observation, randomisation=loaded))
        self.paths = np.concatenate([paths_of(jnp.concatenate(goals_of(self.env, n_goals))), laps(spec)])
        self.keys = start_keys(len(self.paths))
        self._jobs: dict[float, Any] = {}  # by learning rate
        one = functools.partial(follow, self.env, learner_of(config, self.env))
        self._follow = xla.jit(jax.vmap(one, in_axes=(None, None, 0, 0)))

    def best_rate(self) -> float:
        """Return the learning rate with the least held-out medians, in the mean over payloads."""
        steps = round(TUNING_SHARE * self.config.total_env_steps)
        off_mm = {}
        for rate in RATES:
            policy = self.policy(TUNING_SEED, rate, steps)
            found = (self.reached(policy, load_g)[0] for load_g in LOADS_G)
            off_mm[rate] = float(np.mean([np.median(workspace.tip_error_mm) for workspace in found]))
        return min(off_mm, key=off_mm.__getitem__)

    def run(self, seed: int, rate: float) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Train one policy; return its figures under each payload, and around each circle without one."""
        policy = self.policy(seed, rate, self.config.total_env_steps)
        found = {load_g: self.reached(policy, load_g) for load_g in LOADS_G}
        at_goals = [
            {
                "load_g": load_g,
                **figures(np.asarray(workspace.tip_error_mm), np.asarray(workspace.saturated_chambers)),
            }
            for load_g, (workspace, _) in found.items()
        ]
        _, circles = found[0]
        off_mm = np.linalg.norm((circles.pose - circles.goal)[..., :3], axis=-1)
        return at_goals, circle_rows(off_mm, np.asarray(circles.saturated_chambers))

    def policy(self, seed: int, rate: float, steps: int) -> Any:
        """Return the parameters of a policy after so many env steps."""
        if rate not in self._jobs:
            config = override(self.config, [f"analytic.learning_rate={rate}"])
            self._jobs[rate] = task_of(config, self.kind.env(self.spec, config.env)).job
        job = self._jobs[rate]
        state = job.start(lambda: job.init(jax.random.PRNGKey(seed)))
        while int(state.n_env_steps) < steps:
            state, _ = job.epoch(state)
        return jax.device_get(job.policy(state))

    def reached(self, policy: Any, load_g: int) -> tuple[Reached, Reached]:
        """Return the results at the goals of both sets (2 n_goals,), and around circles (SIZES, N_CIRCLE)."""
        found = jax.device_get(self._follow(policy, 1e-3 * load_g, self.paths, self.keys))
        n = len(SIZES)
        workspace = jax.tree.map(lambda x: x[:-n].reshape(-1, *x.shape[2:])[: 2 * self.n_goals], found)
        return workspace, jax.tree.map(lambda x: x[-n:, -N_CIRCLE:], found)


def goals_of(env: ReachEnv, n_goals: int) -> list[Array]:
    """Return n held-out goals (n_goals, 6) [mm, deg] of each of the two sets."""
    return [env.sample_pool(n_goals, HELD_OUT_SEED, evenly).pose for evenly in (False, True)]


def laps(spec: ArmSpec) -> np.ndarray:
    """Return two laps (SIZES, PATH, 6) [mm, deg] of each circle."""
    sizes = np.array([[size, size, 1.0, 1.0, 1.0, 1.0] for size in SIZES], np.float32)  # wider, not lower
    return np.tile(sizes[:, None] * circle_poses(spec, N_CIRCLE), (1, 2, 1))


def follow(env: ReachEnv, learner: Any, policy: Any, load_kg: Array, path: Array, key: Array) -> Reached:
    """Return the results of one arm with a payload, from a random start, along a path (n, 6) of goals."""
    noise = jax.tree.map(lambda x: x[0], env.sample_noise(key, 1))
    share = noise.uniform.at[PAYLOAD_SHARE].set(load_kg / env.payload_max_kg)
    return evaluate.follow(env, learner, policy, path, env.reset_from(noise._replace(uniform=share)))


def figures(off_mm: np.ndarray, n_saturated: np.ndarray) -> dict[str, float]:
    """Return errors, and the share of goals with a saturated chamber, by what each goal (n,) has."""
    return {
        "median_mm": float(np.median(off_mm)),
        "mean_mm": float(np.mean(off_mm)),
        "p95_mm": float(np.quantile(off_mm, 0.95)),
        "saturated_percent": 100 * float(np.mean(n_saturated > 0)),
    }


def circle_rows(off_mm: np.ndarray, n_saturated: np.ndarray) -> list[dict[str, Any]]:
    """Return a row for each circle, by tip errors [mm] and saturated chambers (SIZES, N_CIRCLE)."""
    return [
        {
            "diameter_mm": CIRCLE_DIAMETER_MM * size,
            "mean_mm": float(np.mean(off)),
            "max_mm": float(np.max(off)),
            "saturated_points": int(np.sum(saturated > 0)),
        }
        for size, off, saturated in zip(SIZES, off_mm, n_saturated, strict=True)
    ]


class Descent:
    """Gradient descent by the estimator of the policy that ships; it knows of no payload."""

    def __init__(self, spec: ArmSpec, n_goals: int):
        self.env, self.spec = ReachEnv(spec, EnvConfig()), spec
        self.solve = gradient_descent(load_policy(SHIPPED))
        self.step, self.reset = xla.jit(self.env.step), xla.jit(self.env.reset)
        self.sets = [np.asarray(poses) for poses in goals_of(self.env, n_goals)]

    def run(self, seed: int) -> tuple[dict[str, float], list[dict[str, Any]]]:
        """Return its figures at some goals of both sets, and around each circle, from random poses."""
        rng = np.random.default_rng(seed)
        *keys, key_goals = jax.random.split(jax.random.PRNGKey(seed), len(SIZES) + 1)
        some = [rng.choice(poses, min(N_SOLVED, len(poses)), replace=False) for poses in self.sets]
        at_goals = figures(*self.along(np.concatenate(some), key_goals, N_ACTIONS))
        laps_once = laps(self.spec)[:, :N_CIRCLE]
        around = [self.along(path, key, N_SEARCHES) for path, key in zip(laps_once, keys, strict=True)]
        return at_goals, circle_rows(*np.stack(around, axis=1))

    def along(self, path: np.ndarray, key: Array, n_searches: int) -> np.ndarray:
        """Return tip errors [mm] and saturated chambers (2, n) at the goals of a path (n, 6)."""
        state, found = self.reset(key), []
        for goal in path:
            for _ in range(n_searches):
                arm = state.pipeline_state
                spring_m = self.solve(np.asarray(arm.pose), goal, np.asarray(arm.spring_m, float), None)
                action = self.env.action_of(jnp.asarray(spring_m))
                state = self.step(towards(self.env, state, goal), action)
            found.append([float(state.metrics[name]) for name in ("tip_error_mm", "saturated_chambers")])
        return np.array(found).T


def means(rows: list[dict[str, Any]], by: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return the mean and the standard deviation over seeds of all figures, for each value of `by`."""
    groups: dict[tuple, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    found = []
    for group in groups.values():
        names = [name for name in group[0] if name not in (*by, "seed")]
        values = np.array([[row[name] for name in names] for row in group])
        told = (f"{mean:.2f} ± {off:.2f}" for mean, off in zip(values.mean(0), values.std(0), strict=True))
        found.append({name: group[0][name] for name in by} | dict(zip(names, told, strict=True)))
    return found
