"""Worker: this project's arms, compiled, on all cores.

    python -m benchmarks.speed.jax_worker steps ENGINE MODE N_ARMS LINKS     environment steps
    python -m benchmarks.speed.jax_worker settle ENGINE REFERENCES LINKS     settling alone
    python -m benchmarks.speed.jax_worker start CACHE                        start of a training

LINKS is a number of links per section, REFERENCES an npz file with references (n, n_chambers) [m] by name.
CACHE is the folder of the compilation cache. The first two tell seconds to trace and to compile without a
cache, and where the arms settled.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from benchmarks.harness.common import mesh_of_cores, peak_memory
from benchmarks.harness.rounds import Facts, serve
from benchmarks.speed.truth import TOLD, settle_function
from mjx_softarm._support import draws, xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.gym import EPISODE_LENGTH
from mjx_softarm.env.vector import VectorEnv
from mjx_softarm.spec import ArmSpec
from train.agent.hindsight_tqc import HindsightTQC
from train.epoch.devices import split
from train.epoch.job import Job
from train.presets import PRESETS

N_STEPS = {"quasistatic": 8, "dynamic": 1}  # environment steps of each arm in a call
N_POSES = 1024
N_TOLD = 256  # arms whose tips are told
ROUND_S, SET_S = 1.0, 0.5  # least time of a round of steps, and of a round of each set of references


def compile_timed(function: Callable, *arguments: Any) -> tuple[Callable, Facts]:
    """Compile a jitted function without a cache; return the compiled function, and seconds by name."""
    compilation_cache.reset_cache()
    jax.config.update("jax_enable_compilation_cache", False)
    jax.clear_caches()  # a part may have been traced for something else
    start = time.perf_counter()
    lowered = function.lower(*arguments)
    traced = time.perf_counter()
    compiled = lowered.compile()
    times = {"tracing_s": traced - start, "compiling_s": time.perf_counter() - traced}
    return compiled, {name: round(value, 2) for name, value in times.items()}


def repeats_for(call: Callable[[], Any], round_s: float) -> int:
    """Return the number of calls that take `round_s`; the first call, which may be slow, does not count."""
    jax.block_until_ready(call())
    start = time.perf_counter()
    jax.block_until_ready(call())
    return max(1, round(round_s / (time.perf_counter() - start)))


def steps(engine: Any, mode: Any, n_arms: str, links: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare a rollout of n arms with random actions, which saturate about half of the chambers."""
    n, mesh = int(n_arms), mesh_of_cores(int(n_arms))
    spec = ArmSpec.default().replace(structure={"links_per_section": int(links)})
    xla.enable_compilation_cache()  # for the pool of poses, which is not measured
    env = ReachEnv(spec, EnvConfig(engine=engine, mode=mode, n_poses=N_POSES))
    arms = VectorEnv(env, n, EPISODE_LENGTH, mesh)

    def rollout(state, key):
        def step(state, key):
            key_action, key_reset = jax.random.split(key)
            action = draws.uniform(key_action, (n, env.action_size), minval=-1.0)
            following, after, _ = arms.step(state, action, key_reset)
            ends = env.reference_m(action), after.pipeline_state.pose[:, :3]
            return following, (after.metrics["unsettled"], after.metrics["saturated_chambers"], ends)

        with draws.on(mesh):
            return jax.lax.scan(step, state, jax.random.split(key, N_STEPS[mode]))

    state, key = xla.jit(arms.reset, env.uses_mjx)(jax.random.PRNGKey(0)), jax.random.PRNGKey(1)
    compiled, facts = compile_timed(xla.jit(rollout, env.uses_mjx), state, key)
    repeats = repeats_for(lambda: compiled(state, key), ROUND_S)
    if mode == "quasistatic":
        _, (*_, ends) = compiled(state, key)
        rows = (np.asarray(x, float).reshape(-1, x.shape[-1])[:N_TOLD] for x in ends)  # first step first
        facts |= {name: x.tolist() for name, x in zip(TOLD, rows, strict=True)}

    def work() -> Facts:
        start = time.perf_counter()
        for _ in range(repeats):
            end = compiled(state, key)
        _, (unsettled, saturated, _) = jax.block_until_ready(end)
        spent = time.perf_counter() - start
        return {
            "env_steps_per_s": repeats * N_STEPS[mode] * n / spent,
            "unsettled": int(unsettled.sum()),
            "saturated_chambers": round(float(np.mean(saturated)), 2),
            **peak_memory(),
        }

    return facts, work


def settle(engine: str, references: str, links: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare one compiled function that settles each set of references."""
    spec = ArmSpec.default().replace(structure={"links_per_section": int(links)})
    with np.load(references) as stored:
        sets = {name: stored[name].astype(np.float32) for name in stored.files}
    first = next(iter(sets))
    mesh = mesh_of_cores(len(sets[first]))
    sets = jax.device_put(sets, split(mesh)) if mesh else jax.tree.map(jnp.asarray, sets)
    function, facts = compile_timed(settle_function(spec, engine, mesh=mesh), sets[first])
    repeats = repeats_for(lambda: function(sets[first]), SET_S)

    def work() -> Facts:
        told = {}
        for name, reference in sets.items():
            start = time.perf_counter()
            for _ in range(repeats):
                found = function(reference)
            found = jax.block_until_ready(found)
            told[name] = {
                "solves_per_s": repeats * len(reference) / (time.perf_counter() - start),
                "tip_mm": (1e3 * np.asarray(found.tip_position_m, float)).tolist(),
                "unsettled": int(np.sum(~np.asarray(found.settled))),
            }
        return told

    return facts, work


def start(cache: str) -> tuple[Facts, Callable[[], Facts]]:
    """Start a training up to a compiled epoch."""
    xla.enable_compilation_cache(cache)
    config, env = PRESETS["quick"], ReachEnv()
    job = Job(config, env, HindsightTQC(config, env))
    job.start(lambda: job.init(jax.random.PRNGKey(0)))
    return {}, dict


if __name__ == "__main__":
    serve(lambda: {"steps": steps, "settle": settle, "start": start}[sys.argv[1]](*sys.argv[2:]))
