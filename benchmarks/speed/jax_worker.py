"""Worker: this project's arms, compiled, on all cores.

    python -m benchmarks.speed.jax_worker steps ENGINE MODE N_ARMS           environment steps
    python -m benchmarks.speed.jax_worker settle ENGINE REFERENCES LINKS     settling alone
    python -m benchmarks.speed.jax_worker learn PRESET N_ARMS BATCH_SIZE [N_DEVICES]    epochs of a learner

REFERENCES is an npy file with references (n, n_springs) [m], LINKS a number of links per section. The first
two tell where the arms settled. BATCH_SIZE is 0 for a learner without a replay; N_DEVICES is 1 if it is left
out, and a CPU makes as many of itself.
"""

from __future__ import annotations

import dataclasses
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.common import mesh_of_cores
from benchmarks.harness.rounds import Facts, serve
from benchmarks.speed.truth import TOLD, settle_function
from mjx_softarm._support import draws, xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.gym import EPISODE_LENGTH
from mjx_softarm.env.vector import VectorEnv
from mjx_softarm.spec import ArmSpec
from train.epoch.devices import mesh_of, split
from train.presets import PRESETS
from train.runs.run import timed_epoch
from train.runs.task import task_of

N_STEPS = {"quasistatic": 8, "dynamic": 1}  # environment steps of each arm in a call, of up to `N_FEW` arms
N_FEW = 8192  # more arms take one step in a call
N_POSES = 1024
N_TOLD = 256  # arms whose tips are told
ROUND_S = 1.0  # least time of a round
N_VECTOR_STEPS, N_UPDATES = 4, 16  # of an epoch of `learn`: actions of each arm, gradient steps after each


def repeats_for(call: Callable[[], Any]) -> int:
    """Return the number of calls that take `ROUND_S`; a first call, which compiles, does not count."""
    jax.block_until_ready(call())
    start = time.perf_counter()
    jax.block_until_ready(call())
    return max(1, round(ROUND_S / (time.perf_counter() - start)))


def steps(engine: Any, mode: Any, n_arms: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare a rollout of n arms with random actions, which saturate about half of the chambers."""
    # Two devices of a CPU deadlock in MJX's own step (jaxlib 0.10.2): it takes one.
    n, alone = int(n_arms), (engine, mode) == ("mjx", "dynamic")
    mesh = None if alone else mesh_of_cores(n)
    n_steps = N_STEPS[mode] if n <= N_FEW else 1
    # The arms, and their pool of poses; compilation is not measured.
    xla.enable_compilation_cache()
    env = ReachEnv(config=EnvConfig(engine=engine, mode=mode, n_poses=N_POSES))
    arms = VectorEnv(env, n, EPISODE_LENGTH, mesh)

    def rollout(state, key):
        def step(state, key):
            key_action, key_reset = jax.random.split(key)
            action = draws.uniform(key_action, (n, env.action_size), minval=-1.0)
            following, after, _ = arms.step(state, action, key_reset)
            ends = env.reference_m(action), after.pipeline_state.pose[:, :3]
            return following, (after.metrics["unsettled"], after.metrics["saturated_chambers"], ends)

        with draws.on(mesh):
            return jax.lax.scan(step, state, jax.random.split(key, n_steps))

    state, key = xla.jit(arms.reset)(jax.random.PRNGKey(0)), jax.random.PRNGKey(1)
    # Choose how often the rollout is called in a round.
    compiled = xla.jit(rollout)
    repeats = repeats_for(lambda: compiled(state, key))
    # Tell where the arms of the first steps settled.
    facts: Facts = {}
    if mode == "quasistatic":
        _, (*_, ends) = compiled(state, key)
        rows = (np.asarray(x, float).reshape(-1, x.shape[-1])[:N_TOLD] for x in ends)  # first step first
        facts = {name: x.tolist() for name, x in zip(TOLD, rows, strict=True)}

    def work() -> Facts:
        start = time.perf_counter()
        for _ in range(repeats):
            end = compiled(state, key)
        _, (unsettled, saturated, _) = jax.block_until_ready(end)
        spent = time.perf_counter() - start
        return {
            "env_steps_per_s": repeats * n_steps * n / spent,
            "unsettled": int(unsettled.sum()),
            "saturated_chambers": round(float(np.mean(saturated)), 2),
        }

    return facts, work


def settle(engine: str, references: str, links: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare a compiled function that settles references."""
    spec = ArmSpec.default().replace(structure={"links_per_section": int(links)})
    reference_m = np.load(references).astype(np.float32)
    mesh = mesh_of_cores(len(reference_m))
    placed = jax.device_put(reference_m, split(mesh)) if mesh else jnp.asarray(reference_m)
    function = settle_function(spec, engine, mesh=mesh)
    repeats = repeats_for(lambda: function(placed))

    def work() -> Facts:
        start = time.perf_counter()
        for _ in range(repeats):
            found = function(placed)
        found = jax.block_until_ready(found)
        return {
            "solves_per_s": repeats * len(reference_m) / (time.perf_counter() - start),
            "tip_mm": (1e3 * np.asarray(found.tip_position_m, float)).tolist(),
            "unsettled": int(np.sum(~np.asarray(found.settled))),
        }

    return {}, work


def learn(
    preset: str, n_arms: str, batch_size: str, n_devices: str = "1"
) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare epochs of a preset with other numbers of arms and of transitions in a batch."""
    jax.config.update("jax_num_cpu_devices", int(n_devices))
    config, n, batch = PRESETS[preset], int(n_arms), int(batch_size)
    # A short epoch. A learner from the replay warms up in the first action of all arms.
    sizes: dict[str, Any] = {"n_arms": n, "vector_steps_per_epoch": N_VECTOR_STEPS}
    if batch:
        sizes |= {"batch_size": batch, "updates_per_env_step": N_UPDATES / n, "warmup_env_steps": n}
        sizes |= {"replay_capacity": N_VECTOR_STEPS * n}
    learner = dataclasses.replace(config.learner, **sizes)
    mesh = mesh_of(n_devices)
    job = task_of(dataclasses.replace(config, learner=learner), ReachEnv(config=config.env), mesh=mesh).job
    start = time.perf_counter()
    state = job.start(lambda: job.init(jax.random.PRNGKey(0)))
    state, _ = jax.block_until_ready(job.epoch(state))
    facts = {"ready_s": round(time.perf_counter() - start, 1)}

    def work() -> Facts:
        nonlocal state
        begin, rates = time.perf_counter(), []
        while not rates or time.perf_counter() - begin < ROUND_S:
            state, metrics = timed_epoch(job, state, learner, 1)
            rates.append({name: metrics[f"speed/{name}_per_s"] for name in ("env_steps", "updates")})
        told = {f"{name}_per_s": float(np.median([rate[name] for rate in rates])) for name in rates[0]}
        return told | {"peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)}

    return facts, work


if __name__ == "__main__":
    serve(lambda: {"steps": steps, "settle": settle, "learn": learn}[sys.argv[1]](*sys.argv[2:]))
