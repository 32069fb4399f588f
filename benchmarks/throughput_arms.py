"""Worker of the throughput benchmark: many arms in one compiled rollout, as training steps them.

    python -m benchmarks.throughput_arms ENGINE MODE N_ARMS LINKS_PER_SECTION CACHE

What it tells first: seconds to trace and compile with the empty cache folder CACHE, the same again from what
that left there, and for the chain, where random actions led.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from benchmarks.common import peak_memory
from benchmarks.rounds import Facts, serve
from mjx_softarm import xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.mjcf import steps_per_period
from mjx_softarm.spec import ArmSpec
from mjx_softarm.wrappers import VectorEnv

N_STEPS = {"quasistatic": 8, "dynamic": 1}  # of each arm in one call
EPISODE_LENGTH = 4
N_POSES = 1024
N_RESTS = 256  # told, for the error of the pose
ROUND_S = 1.0  # at least


def compile_twice(function: Callable, *arguments: Any) -> tuple[Callable, Facts]:
    """Compile a jitted function; returns it, and the seconds that took with an empty and with a filled cache.

    The compilation cache must have been enabled, on a folder that is empty.
    """
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
    spec = ArmSpec.default().replace(structure={"links_per_section": links})
    env = ReachEnv(spec, EnvConfig(engine=engine, mode=mode, n_poses=N_POSES))  # type: ignore[arg-type]
    xla.enable_compilation_cache(cache)  # from here on: what the pool of poses needed is not counted
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    arms = VectorEnv(env, n, EPISODE_LENGTH)

    def rollout(state, key):
        def step(state, key):
            key_action, key_reset = jax.random.split(key)
            action = jax.random.uniform(key_action, (n, env.action_size), minval=-1.0)
            following, after, _ = arms.step(state, action, key_reset)
            return following, (after.metrics["unsettled"].sum(), after.metrics["saturated_chambers"].mean())

        return jax.lax.scan(step, state, jax.random.split(key, N_STEPS[mode]))

    state = xla.jit(arms.reset, env.uses_mjx)(jax.random.PRNGKey(0))
    key = jax.random.PRNGKey(1)
    compiled, facts = compile_twice(xla.jit(rollout, env.uses_mjx), state, key)
    repeats = repeats_for(lambda: compiled(state, key))
    facts |= _rests(env) if not env.uses_mjx else {}  # it would take another minute to compile
    period_s = 1.0 / spec.control.rate_hz
    physics = round(env.config.dynamic_step_s / period_s) * steps_per_period(period_s)

    def work() -> Facts:
        start = time.perf_counter()
        for _ in range(repeats):
            end = compiled(state, key)
        _, (unsettled, saturated) = jax.block_until_ready(end)
        rate = repeats * N_STEPS[mode] * n / (time.perf_counter() - start)
        return {
            "env_steps_per_s": rate,
            **({"physics_steps_per_s": physics * rate} if mode == "dynamic" else {}),
            "unsettled": int(unsettled.sum()),
            "saturated_chambers": round(float(np.mean(saturated)), 2),
            **peak_memory(),
        }

    return facts, work


def _rests(env: ReachEnv) -> Facts:
    """References and tips of some environment steps, for the error of the pose."""
    action = jax.random.uniform(jax.random.PRNGKey(2), (N_RESTS, env.action_size), minval=-1.0)
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(3), N_RESTS))
    end = jax.jit(jax.vmap(env.step))(start, action)
    tip_mm = np.asarray(end.pipeline_state.pose[:, :3])
    return {"reference_m": np.asarray(env.reference_m(action)).tolist(), "tip_mm": tip_mm.tolist()}


if __name__ == "__main__":
    _engine, _mode, _n, _links, _cache = sys.argv[1:]
    serve(lambda: prepare(_engine, _mode, int(_n), int(_links), _cache))
