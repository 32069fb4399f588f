"""Programs of this project that are measured, compiled; and a worker that runs one on request.

    python -m benchmarks.speed.jax_worker steps ENGINE MODE N_ARMS           environment steps
    python -m benchmarks.speed.jax_worker settle ENGINE REFERENCES LINKS     settling alone
    python -m benchmarks.speed.jax_worker learn PRESET N_ARMS BATCH_SIZE [N_DEVICES]    epochs of a learner

REFERENCES is an npy file with references (n, n_springs) [m], LINKS a number of links per section. The first
two report where the arms settled. BATCH_SIZE is 0 for a learner without a replay; N_DEVICES is 1 by default,
and a CPU makes as many of itself.
"""

from __future__ import annotations

import dataclasses
import resource
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from benchmarks.harness.common import mesh_of_cores
from benchmarks.harness.rounds import Facts, serve
from benchmarks.speed.truth import REPORTED, settle_function
from mjx_softarm._support import draws, xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.gym import EPISODE_LENGTH
from mjx_softarm.env.vector import VectorEnv
from mjx_softarm.spec import ArmSpec
from train.agent.registry import epoch_of
from train.config import TrainConfig
from train.epoch.devices import mesh_of, split
from train.epoch.job import Job
from train.presets import PRESETS
from train.runs.task import task_of

N_STEPS = {"quasistatic": 8, "dynamic": 1}  # environment steps of each arm in a call, of up to `N_FEW` arms
N_FEW = 1024  # more arms take one step in a call
N_POSES = 256
N_STARTS = 64  # arms that are reset; more arms start as these do
N_REPORTED = 256  # arms whose tips are reported
ROUND_S = 1.0  # least time of a round
N_VECTOR_STEPS, N_UPDATES = 4, 16  # of an epoch of `learn`: actions of each arm, gradient steps after each


class Program(NamedTuple):
    """A compiled program."""

    compile_s: float  # time to trace and compile it, or to read it from the cache
    call: Callable[[], Any]  # does the work once; returns arrays to wait for, or metrics
    n_env_steps: int  # in a call, of all arms
    n_updates: int = 0  # gradient steps in a call


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


def rollout(engine: Any, mode: Any, n: int, mesh: Mesh | None = None) -> Program:
    """Compile a rollout of n arms with random actions, which saturate about half of the chambers.

    A call returns, for each step, `unsettled`, `saturated_chambers`, references [m] and tips [mm].
    """
    n_steps = N_STEPS[mode] if n <= N_FEW else 1
    env = ReachEnv(config=EnvConfig(engine=engine, mode=mode, n_poses=N_POSES))
    arms = VectorEnv(env, n, EPISODE_LENGTH, mesh)

    def run(state: Any, key: jax.Array) -> Any:
        def step(state: Any, key: jax.Array) -> Any:
            key_action, key_reset = jax.random.split(key)
            action = draws.uniform(key_action, (n, env.action_size), minval=-1.0)
            following, after, _ = arms.step(state, action, key_reset)
            ends = env.reference_m(action), after.pipeline_state.pose[:, :3]
            return following, (after.metrics["unsettled"], after.metrics["saturated_chambers"], *ends)

        with draws.on(mesh):
            return jax.lax.scan(step, state, jax.random.split(key, n_steps))[1]

    # Reset some arms, and repeat them
    few = VectorEnv(env, min(n, N_STARTS), EPISODE_LENGTH)
    state = xla.jit(few.reset, "once")(jax.random.PRNGKey(0))
    state = jax.tree.map(lambda x: np.resize(x, (n, *x.shape[1:])), jax.device_get(state))
    state = jax.device_put(state, split(mesh) if mesh else None)
    # Compile
    start, key = time.perf_counter(), jax.random.PRNGKey(1)
    compiled = xla.jit(run).lower(state, key).compile()
    compile_s = time.perf_counter() - start
    return Program(compile_s, lambda: compiled(state, key), n_steps * n)


def training(config: TrainConfig, mesh: Mesh | None = None) -> Program:
    """Compile epochs of a training; a call returns the metrics of one epoch."""
    learner = config.learner
    job = task_of(config, ReachEnv(config=config.env), mesh=mesh).job
    state, start = job.init(jax.random.PRNGKey(0)), time.perf_counter()
    if mesh is None:
        job.compile_epoch()
    else:  # it is compiled as it is called first
        state, _ = jax.block_until_ready(job.epoch(state))
    compile_s = time.perf_counter() - start

    def call() -> Any:
        nonlocal state
        state, metrics = job.epoch(state)
        return metrics

    n_updates = learner.n_updates(2) - learner.n_updates(1)
    return Program(compile_s, call, learner.n_env_steps(1), n_updates)


def gradient_steps(preset: str) -> Program:
    """Compile the gradient steps of a preset that learns from a replay; networks and replay are zeros."""
    config = resized(preset, N_STARTS, updates_per_env_step=N_UPDATES / N_STARTS)
    env = dataclasses.replace(config.env, engine="chain", mode="quasistatic", n_poses=N_POSES)
    epoch: Any = epoch_of(config.learner, ReachEnv(config=env))
    state = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), Job(epoch).shapes())
    start, key = time.perf_counter(), jax.random.PRNGKey(0)

    def run(state: Any, key: jax.Array) -> Any:
        return epoch.learn(state.learner, state.memory, key, jnp.asarray(True))[0]

    compiled = xla.jit(run, "networks").lower(state, key).compile()
    return Program(time.perf_counter() - start, lambda: compiled(state, key), 0, N_UPDATES)


def resized(preset: str, n_arms: int, **settings: Any) -> TrainConfig:
    """Return a preset with another number of arms and other settings of its learner, without warm-up."""
    config = PRESETS[preset]
    if hasattr(config.learner, "replay_capacity"):
        capacity = max(4 * n_arms, 16_384)
        settings = {"warmup_env_steps": 0, "replay_capacity": capacity, **settings}
    learner = dataclasses.replace(config.learner, n_arms=n_arms, **settings)
    return dataclasses.replace(config, learner=learner)


def steps(engine: Any, mode: Any, n_arms: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare rounds of `rollout`."""
    xla.enable_compilation_cache()
    program = rollout(engine, mode, int(n_arms), mesh_of_cores(int(n_arms)))
    unsettled, saturated, *ends = program.call()
    facts: Facts = {"compile_s": round(program.compile_s, 1)}
    facts |= {"unsettled": int(unsettled.sum()), "saturated_chambers": round(float(np.mean(saturated)), 2)}
    if mode == "quasistatic":  # first step first
        rows = (np.asarray(x, float).reshape(-1, x.shape[-1])[:N_REPORTED] for x in ends)
        facts |= {name: x.tolist() for name, x in zip(REPORTED, rows, strict=True)}
    return facts, lambda: rates(program, ROUND_S)


def settle(engine: str, references: str, links: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare a compiled function that settles references."""
    spec = ArmSpec.default().replace(structure={"links_per_section": int(links)})
    reference_m = np.load(references).astype(np.float32)
    mesh = mesh_of_cores(len(reference_m))
    placed = jax.device_put(reference_m, split(mesh)) if mesh else jnp.asarray(reference_m)
    function = settle_function(spec, engine, mesh=mesh)
    program = Program(0.0, lambda: function(placed), len(reference_m))
    settled = jax.block_until_ready(program.call())
    tips = {"tip_mm": (1e3 * np.asarray(settled.tip_position_m, float)).tolist()}
    tips["unsettled"] = int(np.sum(~np.asarray(settled.settled)))
    return {}, lambda: {"solves_per_s": rates(program, ROUND_S)["env_steps_per_s"], **tips}


def learn(
    preset: str, n_arms: str, batch_size: str, n_devices: str = "1"
) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare epochs of a preset with other numbers of arms and of transitions in a batch."""
    jax.config.update("jax_num_cpu_devices", int(n_devices))
    n, sizes = int(n_arms), {"vector_steps_per_epoch": N_VECTOR_STEPS}
    if int(batch_size):
        sizes |= {"batch_size": int(batch_size), "updates_per_env_step": N_UPDATES / n}
    start = time.perf_counter()
    program = training(resized(preset, n, **sizes), mesh_of(n_devices))
    facts = {"ready_s": round(time.perf_counter() - start, 1)}

    def work() -> Facts:
        figures = rates(program, ROUND_S)
        return figures | {"peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)}

    return facts, work


if __name__ == "__main__":
    serve(lambda: {"steps": steps, "settle": settle, "learn": learn}[sys.argv[1]](*sys.argv[2:]))
