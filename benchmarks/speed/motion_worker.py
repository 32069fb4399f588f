"""Worker: `N_ARMS` arms in motion by one engine, on one device, as training has it.

With two devices of one CPU, XLA (jax 0.10.2) waits for ever in `mjx.step` of 4 links.

python -m benchmarks.speed.motion_worker ENGINE STEP_MS LINKS
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.rounds import Facts, serve
from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.gym import EPISODE_LENGTH
from mjx_softarm.env.vector import VectorEnv, over_arms
from mjx_softarm.spec import ArmSpec

N_ARMS = 128
N_TOLD, N_ACTIONS = 16, 4  # arms whose paths are told, over this many actions


def prepare(engine: Any, step_ms: str, links: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare steps of arms with random actions, which saturate about half of the chambers."""
    # Arms at rest, the same ones for each engine
    spec = ArmSpec.default().replace(structure={"links_per_section": int(links)})
    config = EnvConfig(engine=engine, mode="dynamic", simulation_step_s=1e-3 * float(step_ms), n_poses=N_ARMS)
    env = ReachEnv(spec, config)
    start = xla.jit(VectorEnv(env, N_ARMS, EPISODE_LENGTH).reset)(jax.random.PRNGKey(0))
    shape = (N_ACTIONS, N_ARMS, env.action_size)
    actions = jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, shape), jnp.float32)

    # One step of all arms, compiled
    begin = time.perf_counter()
    traced = xla.jit(over_arms(env.step)).lower(start, actions[0])
    middle = time.perf_counter()
    step = traced.compile()
    facts: Facts = {"tracing_s": round(middle - begin, 1)}
    facts["compiling_s"] = round(time.perf_counter() - middle, 1)

    # Paths of some arms, for the error
    state, paths = start, []
    for action in actions:
        state = step(state, action)
        paths.append(np.asarray(state.info["path_mm"])[:N_TOLD])
    told = {
        "q": start.pipeline_state.motion.q[:N_TOLD],
        "pressure_kpa": start.pipeline_state.pressure_kpa[:N_TOLD],
        "reference_m": env.reference_m(actions)[:, :N_TOLD].swapaxes(0, 1),
        "path_mm": np.concatenate(paths, axis=1),  # (arms, control periods, 3)
    }
    facts |= {name: np.asarray(x, float).tolist() for name, x in told.items()}

    def work() -> Facts:
        begin, state = time.perf_counter(), start
        for action in actions:
            state = step(state, action)
        jax.block_until_ready(state)
        return {"env_steps_per_s": N_ACTIONS * N_ARMS / (time.perf_counter() - begin)}

    return facts, work


if __name__ == "__main__":
    serve(lambda: prepare(*sys.argv[1:]))
