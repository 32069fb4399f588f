"""Programs of this project that are measured, compiled; and a worker that runs one on request.

    python -m benchmarks.speed.jax_worker ENGINE MODE N_ARMS    environment steps

It reports where the arms settled.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from benchmarks.harness.rounds import Facts, n_cores, serve
from benchmarks.speed.truth import REPORTED
from mjx_softarm._support import draws, xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.gym import EPISODE_LENGTH
from mjx_softarm.env.vector import VectorEnv
from train.config import TrainConfig
from train.presets import PRESETS
from train.runs.run import task_of

N_STEPS = {"quasistatic": 8, "dynamic": 1}  # environment steps of each arm in a call, of up to `N_FEW` arms
N_FEW = 1024  # more arms take one step in a call
N_POSES = 256
N_STARTS = 64  # arms that are reset; more arms start as these do
N_REPORTED = 256  # arms whose tips are reported
ROUND_S = 1.0  # least time of a round


class Program(NamedTuple):
    """A compiled program."""

    compile_s: float  # time to trace and compile it, or to read it from the cache
    call: Callable[[], Any]  # does the work once; returns arrays to wait for, or metrics
    n_env_steps: int  # in a call, of all arms
    n_updates: int = 0  # gradient steps in a call


def split_cpu() -> None:
    """Make each core of this process a device; call it before JAX is used.

    XLA runs most of settling on one core, so a CPU that is one device leaves the others idle.
    """
    jax.config.update("jax_num_cpu_devices", n_cores())


def mesh_of(n_arms: int, n_devices: int = 1) -> Mesh:
    """Return the first devices, which share n arms; instead of one CPU, as many cores as divide n."""
    if n_devices == 1 and jax.default_backend() == "cpu":
        n_devices = max(n for n in range(1, jax.device_count() + 1) if n_arms % n == 0)
    return Mesh(np.array(jax.devices()[:n_devices]), ("arms",))


def spread(mesh: Mesh) -> NamedSharding:
    """Return the sharding of arrays whose first axis is that of the arms."""
    return NamedSharding(mesh, PartitionSpec(mesh.axis_names))


def of_shares(function: Callable, mesh: Mesh, axis: int = 0) -> Callable:
    """Return a function of arms of which each device computes its share, and waits for no other's arms.

    The arms are the first axis of its arrays, and `axis` of its results.
    """
    arms, results = PartitionSpec(mesh.axis_names), PartitionSpec(*[None] * axis, mesh.axis_names)
    return jax.shard_map(function, mesh=mesh, in_specs=arms, out_specs=results, check_vma=False)


def digits(rate: float) -> float | int:
    """Round a rate to two decimals below 100, else to an integer."""
    return round(rate) if rate >= 100 else round(rate, 2)


def rates(program: Program, seconds: float) -> Facts:
    """Call a program for a time; return environment steps and gradient steps a second."""
    n, start = 0, time.perf_counter()
    jax.block_until_ready(program.call())
    spent = first_s = time.perf_counter() - start
    while spent < first_s + seconds and not (n == 0 and first_s > seconds):  # a long first call counts
        jax.block_until_ready(program.call())
        n, spent = n + 1, time.perf_counter() - start
    each_s = (spent - first_s) / n if n else first_s
    done = {"env_steps_per_s": program.n_env_steps, "updates_per_s": program.n_updates}
    return {name: count / each_s for name, count in done.items() if count}


def rollout(engine: Any, mode: Any, n: int, mesh: Mesh) -> Program:
    """Compile a rollout of n arms with random actions, which saturate about half of the chambers.

    A call returns, for each step, `unsettled`, `saturated_chambers`, references [m] and tips [mm].
    """
    n_steps = N_STEPS[mode] if n <= N_FEW else 1
    env = ReachEnv(config=EnvConfig(engine=engine, mode=mode, n_poses=N_POSES))
    arms = VectorEnv(env, n // mesh.size, EPISODE_LENGTH)  # of a device

    def run(state: Any, keys: jax.Array) -> Any:
        def step(state: Any, key: jax.Array) -> Any:
            key_action, key_reset = jax.random.split(key)
            action = draws.uniform(key_action, (arms.n, env.action_size), minval=-1.0)
            following, after, *_ = arms.step(state, action, key_reset)
            ends = env.reference_m(action), after.pipeline_state.pose[:, :3]
            return following, (after.metrics["unsettled"], after.metrics["saturated_chambers"], *ends)

        return jax.lax.scan(step, state, jax.random.split(keys[0], n_steps))[1]

    # Reset some arms, and repeat them
    few = VectorEnv(env, min(n, N_STARTS), EPISODE_LENGTH)
    state = xla.jit(few.reset, "once")(jax.random.PRNGKey(0))
    state = jax.tree.map(lambda x: np.resize(x, (n, *x.shape[1:])), jax.device_get(state))
    keys = jax.random.split(jax.random.PRNGKey(1), mesh.size)
    state, keys = jax.device_put((state, keys), spread(mesh))
    # Compile
    start = time.perf_counter()
    compiled = xla.jit(of_shares(run, mesh, axis=1)).lower(state, keys).compile()
    compile_s = time.perf_counter() - start
    return Program(compile_s, lambda: compiled(state, keys), n_steps * n)


def training(config: TrainConfig) -> Program:
    """Compile epochs of a training; a call returns the metrics of one epoch."""
    learner, job = config.learner, task_of(config, ReachEnv(config=config.env)).job
    state, start = job.init(jax.random.PRNGKey(0)), time.perf_counter()
    job.compile_epoch()
    compile_s = time.perf_counter() - start

    def call() -> Any:
        nonlocal state
        state, metrics = job.epoch(state)
        return metrics

    n_updates = learner.n_updates(2) - learner.n_updates(1)
    return Program(compile_s, call, learner.n_env_steps(1), n_updates)


def resized(preset: str, n_arms: int, **settings: Any) -> TrainConfig:
    """Return a preset with another number of arms and other settings of its learner, without warm-up."""
    config = PRESETS[preset]
    if hasattr(config.learner, "replay_capacity"):
        capacity = max(4 * n_arms, 16_384)
        settings = {"warmup_env_steps": 0, "replay_capacity": capacity, **settings}
    learner = dataclasses.replace(config.learner, n_arms=n_arms, **settings)
    return dataclasses.replace(config, learner=learner)


def steps(engine: Any, mode: Any, n_arms: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare rounds of `rollout`; in motion they have the simulated time of all arms together, too."""
    xla.enable_compilation_cache()
    split_cpu()
    program = rollout(engine, mode, int(n_arms), mesh_of(int(n_arms)))
    _, _, *ends = program.call()
    facts: Facts = {"arms": int(n_arms), "compile_s": round(program.compile_s, 1)}
    if mode == "quasistatic":  # first step first
        rows = (np.asarray(x, float).reshape(-1, x.shape[-1])[:N_REPORTED] for x in ends)
        facts |= {name: x.tolist() for name, x in zip(REPORTED, rows, strict=True)}

    def work() -> Facts:
        done = rates(program, ROUND_S)
        simulated_s = {"simulated_s_per_s": done["env_steps_per_s"] * EnvConfig().dynamic_step_s}
        return done | (simulated_s if mode == "dynamic" else {})

    return facts, work


if __name__ == "__main__":
    serve(lambda: steps(*sys.argv[1:]))
