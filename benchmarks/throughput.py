"""How many env steps per second, settling included, and how long the first and the second start take."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.common import seconds
from mjx_softarm import xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.wrappers import VectorEnv

N_STEPS = 8
ARMS = {"chain": (32, 128, 512), "mjx": (128,)}


def measure() -> dict[str, Any]:
    """Env steps/s of both engines; start-up times of a training epoch, cache empty and filled."""
    rows = [_steps_per_second(engine, n) for engine, arms in ARMS.items() for n in arms]
    with tempfile.TemporaryDirectory() as cache:
        starts = [_start(cache) for _ in range(2)]
    return {"env_steps": rows, "start": {"cold": starts[0], "cached": starts[1]}}


def _steps_per_second(engine: str, n: int) -> dict[str, Any]:
    """Random actions, so that about half of the chambers saturate; resets included."""
    env = ReachEnv(config=EnvConfig(engine=engine, n_poses=1024))
    arms = VectorEnv(env, n, episode_length=4)

    def rollout(state, key):
        def step(state, key):
            key_action, key_reset = jax.random.split(key)
            action = jax.random.uniform(key_action, (n, env.action_size), minval=-1.0)
            following, after, _ = arms.step(state, action, key_reset)
            return following, (after.metrics["unsettled"].sum(), after.metrics["saturated_chambers"].mean())

        return jax.lax.scan(step, state, jax.random.split(key, N_STEPS))

    state = xla.jit(arms.reset, env.uses_mjx)(jax.random.PRNGKey(0))
    start = time.perf_counter()
    compiled = xla.jit(rollout, env.uses_mjx)
    _, (unsettled, saturated) = jax.block_until_ready(compiled(state, jax.random.PRNGKey(1)))
    compile_s = time.perf_counter() - start
    rate = n * N_STEPS / seconds(lambda: compiled(state, jax.random.PRNGKey(1)))
    return {
        "engine": engine,
        "arms": n,
        "env_steps_per_s": round(rate),
        "first_call_s": round(compile_s, 1),
        "unsettled": int(unsettled.sum()),
        "saturated_chambers": round(float(jnp.mean(saturated)), 2),
    }


_START = """
import json, time
start = time.perf_counter()
import jax
from mjx_softarm import xla
xla.enable_compilation_cache({cache!r})
from mjx_softarm.env import ReachEnv
from train.config import PRESETS
from train.job import Job
imported = time.perf_counter()
job = Job(PRESETS["quick"], ReachEnv())
pool = time.perf_counter()
state = job.init(jax.random.PRNGKey(0))
lowered = job.epoch.lower(state)
lowered.compile()
print(json.dumps({{"import_s": imported - start, "workspace_s": pool - imported,
                   "compile_epoch_s": time.perf_counter() - pool, "total_s": time.perf_counter() - start}}))
"""


def _start(cache: str) -> dict[str, float]:
    """A new process up to a compiled training epoch."""
    environment = {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"}
    done = subprocess.run(
        [sys.executable, "-c", _START.format(cache=cache)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return {name: round(value, 1) for name, value in json.loads(done.stdout.splitlines()[-1]).items()}
