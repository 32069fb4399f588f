"""Worker of the throughput benchmark: many arms in one compiled rollout on all cores, as training steps them.

    python -m benchmarks.speed.throughput_arms ENGINE MODE N_ARMS LINKS_PER_SECTION CACHE

What it tells first: seconds to trace and compile with the empty cache folder CACHE, the same again from what
that left there, and where some random actions led to rest.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.experimental.compilation_cache import compilation_cache

from benchmarks.harness.common import mesh_of_cores, peak_memory
from benchmarks.harness.rounds import Facts, serve
from benchmarks.speed.truth import TOLD
from mjx_softarm._support import draws, xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.gym import EPISODE_LENGTH
from mjx_softarm.env.vector import VectorEnv
from mjx_softarm.mechanics.mjcf import steps_per_period
from mjx_softarm.spec import ArmSpec

N_STEPS = {"quasistatic": 8, "dynamic": 1}  # of each arm in one call
N_POSES = 1024
N_RESTS = 256  # told, for the error of the pose
ROUND_S = 1.0  # at least


def compile_twice(function: Callable, *arguments: Any) -> tuple[Callable, Facts]:
    """Compile a jitted function; returns it, and the seconds that took with an empty and with a filled cache.

    The compilation cache must have been enabled, on a folder that is empty.
    """
    jax.clear_caches()  # a part may have been traced for something else
    start = time.perf_counter()
    lowered = function.lower(*arguments)
    traced = time.perf_counter()
    lowered.compile()
    cold = time.perf_counter()
    jax.clear_caches()
    compiled = function.lower(*arguments).compile()
    again = time.perf_counter()
    times = {"tracing_s": traced - start, "compiling_s": cold - traced, "both_from_cache_s": again - cold}
    return compiled, {name: round(value, 2) for name, value in times.items()}


def repeats_for(call: Callable[[], Any], round_s: float = ROUND_S) -> int:
    """How many calls a round is made of; the first call, which is not counted, may be slow."""
    jax.block_until_ready(call())
    start = time.perf_counter()
    jax.block_until_ready(call())
    return max(1, round(round_s / (time.perf_counter() - start)))


def prepare(engine: str, mode: str, n: int, links: int, cache: str) -> tuple[Facts, Callable[[], Facts]]:
    """Compile a rollout of n arms with random actions, which saturate about half of the chambers."""
    mesh = mesh_of_cores(n)
    spec = ArmSpec.default().replace(structure={"links_per_section": links})
    xla.enable_compilation_cache()  # for the pool of poses, which is not what is measured
    env = ReachEnv(spec, EnvConfig(engine=engine, mode=mode, n_poses=N_POSES))  # type: ignore[arg-type]
    compilation_cache.reset_cache()
    xla.enable_compilation_cache(cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    arms = VectorEnv(env, n, EPISODE_LENGTH, mesh)

    def rollout(state, key):
        def step(state, key):
            key_action, key_reset = jax.random.split(key)
            action = draws.uniform(key_action, (n, env.action_size), minval=-1.0)
            following, after, _ = arms.step(state, action, key_reset)
            rests = env.reference_m(action), after.pipeline_state.pose[:, :3]
            told = after.metrics["unsettled"], after.metrics["saturated_chambers"]
            return following, (told, rests)

        with draws.on(mesh):
            return jax.lax.scan(step, state, jax.random.split(key, N_STEPS[mode]))

    state = xla.jit(arms.reset, env.uses_mjx)(jax.random.PRNGKey(0))
    key = jax.random.PRNGKey(1)
    compiled, facts = compile_twice(xla.jit(rollout, env.uses_mjx), state, key)
    repeats = repeats_for(lambda: compiled(state, key))
    if mode == "quasistatic":
        _, (_, rests) = compiled(state, key)
        facts |= {name: _first(rows) for name, rows in zip(TOLD, rests, strict=True)}
    period_s = 1.0 / spec.control.rate_hz
    physics = round(env.config.dynamic_step_s / period_s) * steps_per_period(period_s)

    def work() -> Facts:
        start = time.perf_counter()
        for _ in range(repeats):
            end = compiled(state, key)
        _, ((unsettled, saturated), _) = jax.block_until_ready(end)
        rate = repeats * N_STEPS[mode] * n / (time.perf_counter() - start)
        return {
            "env_steps_per_s": rate,
            **({"physics_steps_per_s": physics * rate} if mode == "dynamic" else {}),
            "unsettled": int(unsettled.sum()),
            "saturated_chambers": round(float(np.mean(saturated)), 2),
            **peak_memory(),
        }

    return facts, work


def _first(rows: Array) -> list[list[float]]:
    """Of rows (steps, arms, k), the first few as (n, k), steps first."""
    return np.asarray(rows, float).reshape(-1, rows.shape[-1])[:N_RESTS].tolist()


if __name__ == "__main__":
    _engine, _mode, _n, _links, _cache = sys.argv[1:]
    serve(lambda: prepare(_engine, _mode, int(_n), int(_links), _cache))
