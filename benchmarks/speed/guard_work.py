"""Worker of the regression guard: the work that must not get slower, each beside a reference, in rounds.

    python -m benchmarks.speed.guard_work

The reference is matrix products, which do not run through this project's code, so that a faster machine is
faster at both. Seconds are the processor's, all threads added up, so waiting for others on a loaded machine
is not in them; those of work on a GPU are the clock's on the wall. On a CPU the guard keeps this program to
one core: threads of XLA that wait for each other are busy, for how long differs from round to round. So a
loss of parallelism is not seen. On a GPU's machine `tick` and `compile` have all cores.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.rounds import Facts, serve
from benchmarks.speed.truth import random_references, settle_function
from mjx_softarm._support import xla
from mjx_softarm.deploy import loop
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.policy.file import ArmModel, policy_from_actor
from mjx_softarm.sensing.estimator import N_CHANGES, PoseEstimator, SpringModel
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import ArmSpec
from train.config import PRESETS
from train.epoch.job import Job, TrainState

ON_DEVICE, ON_HOST = ("settle", "env_steps", "updates"), ("tick", "compile")
PRODUCT, PRODUCT_ON_GPU = "product", "product_on_gpu"  # NumPy's, and XLA's where there is a GPU
N_ROWS, N_ROWS_ON_GPU, N_PRODUCTS = 1024, 8192, 8  # of the matrices
N_COMPILES = 2


class Sizes(NamedTuple):
    """How much work there is in one measurement, a tenth of a second or more; fixed, or costs change."""

    n_arms: int
    n_settles: int  # of all arms
    n_env_steps: int  # of each arm
    n_updates: int
    batch_size: int  # of an update
    n_ticks: int


SIZES = {
    "cpu": Sizes(128, 20, 16, 16, 256, 400),
    "gpu": Sizes(8192, 50, 32, 512, 256, 400),
}


def sizes_here() -> Sizes:
    """Of this machine's benchmark."""
    return SIZES["gpu" if jax.default_backend() == "gpu" else "cpu"]


def work_here() -> dict[str, int]:
    """All numbers by which this machine's costs are of other work than another's, by name."""
    products = {"n_rows": N_ROWS, "n_rows_on_gpu": N_ROWS_ON_GPU, "n_products": N_PRODUCTS}
    return {**sizes_here()._asdict(), **products, "n_compiles": N_COMPILES}


def reference_of(name: str) -> str:
    """What some work stands beside: the product on the same device."""
    return PRODUCT_ON_GPU if name in ON_DEVICE and jax.default_backend() == "gpu" else PRODUCT


def prepare() -> tuple[Facts, Callable[[], Facts]]:
    """Compile everything; tells the seconds of compiling an epoch, then in rounds those of all else."""
    jax.config.update("jax_enable_compilation_cache", False)
    sizes = sizes_here()
    env = ReachEnv(config=EnvConfig(n_poses=1024))
    config = dataclasses.replace(
        PRESETS["quick"],
        n_arms=sizes.n_arms,
        batch_size=sizes.batch_size,
        updates_per_env_step=sizes.n_updates / sizes.n_arms,
        warmup_env_steps=0,
        env=env.config,
    )
    job = Job(config, env)
    state, epoch = job.init(jax.random.PRNGKey(0)), []

    def compile_epoch() -> None:
        jax.clear_caches()
        epoch.append(job.epoch.lower(state).compile())

    compiling_s = min(_seconds("compile", compile_epoch) for _ in range(N_COMPILES))
    state, _ = epoch[0](state)  # fills the replay
    work = {
        PRODUCT: _product(),
        "settle": _settle(env, sizes),
        "env_steps": _env_steps(job, state, sizes),
        "updates": _updates(job, state),
        "tick": _tick(job, state, sizes),
    }
    if jax.default_backend() == "gpu":
        work[PRODUCT_ON_GPU] = _product_on_gpu()
    for call in work.values():
        call()
    return {"compile": compiling_s}, lambda: {name: _seconds(name, call) for name, call in work.items()}


def _seconds(name: str, call: Callable[[], Any]) -> float:
    on_gpu = PRODUCT_ON_GPU in (name, reference_of(name))
    clock = time.perf_counter if on_gpu else time.process_time
    start = clock()
    call()
    return clock() - start


def _product() -> Callable[[], Any]:
    """Products of a random matrix with itself, by NumPy."""
    matrix = _random(N_ROWS)
    return lambda: [matrix @ matrix for _ in range(N_PRODUCTS)]


def _product_on_gpu() -> Callable[[], Any]:
    matrix, product = jnp.asarray(_random(N_ROWS_ON_GPU)), jax.jit(lambda x: x @ x)
    return lambda: jax.block_until_ready([product(matrix) for _ in range(N_PRODUCTS)])


def _random(n: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(n, n)).astype(np.float32)


def _settle(env: ReachEnv, sizes: Sizes) -> Callable[[], Any]:
    """Rests at random references, about half of their chambers at a limit."""
    solve = settle_function(env.spec)
    reference_m = jnp.asarray(random_references(env.spec, sizes.n_arms), jnp.float32)
    return lambda: jax.block_until_ready([solve(reference_m) for _ in range(sizes.n_settles)])


def _env_steps(job: Job, state: TrainState, sizes: Sizes) -> Callable[[], Any]:
    """Random actions of all arms, resets included."""

    def rollout(arms: Any, key: Any):
        def step(arms: Any, key: Any):
            key_action, key_reset = jax.random.split(key)
            action = jax.random.uniform(key_action, (job.arms.n, job.env.action_size), minval=-1.0)
            arms, _, outcome = job.arms.step(arms, action, key_reset)
            return arms, jnp.sum(outcome.reward)

        return jax.lax.scan(step, arms, jax.random.split(key, sizes.n_env_steps))

    compiled, key = xla.jit(rollout, job.env.uses_mjx), jax.random.PRNGKey(1)
    return lambda: jax.block_until_ready(compiled(state.arms, key))


def _updates(job: Job, state: TrainState) -> Callable[[], Any]:
    """Gradient steps, sampled and relabelled, as within an epoch."""

    def learn(state: TrainState, key: Any):
        state, metrics = job._updates(state, key, jnp.array(True))
        return state.agent, metrics

    compiled, key = xla.jit(learn, job.env.uses_mjx), jax.random.PRNGKey(2)
    return lambda: jax.block_until_ready(compiled(state, key))


def _tick(job: Job, state: TrainState, sizes: Sizes) -> Callable[[], Any]:
    """Ticks of the deployed loop in which the policy acts, on springs at rest with a little noise.

    The networks have the sizes of a trained policy's, and all but the actor's are zero.
    """
    spec, pool = job.env.spec, job.env.pool
    spring_m = np.asarray(pool.spring_m[0], float)
    model = _model(spec, np.asarray(pool.pose, np.float32), spring_m)
    actor = jax.device_get(state.agent.actor_params)
    controller = loop.Controller.of(policy_from_actor(actor, spec, job.config.env.reward, model, {}))
    noise_m = 4e-5 * np.random.default_rng(3).normal(size=(controller.window, spec.n_chambers))
    readings = Sensor.from_spec(spec).readings(spring_m + noise_m)
    before = loop.start(controller)
    for reading in readings:
        before, _ = loop.step(controller, before, reading, False)
    before, refused = loop.with_goal(controller, before, np.asarray(pool.pose[0], float))
    after, _ = loop.step(controller, before, readings[0], False)
    if refused or after.phase is not loop.Phase.RUN or after.n_actions != 1:
        raise RuntimeError(f"the tick is not one in which the policy acts: {refused}, {after}")
    return lambda: [loop.step(controller, before, readings[0], False) for _ in range(sizes.n_ticks)]


def _model(spec: ArmSpec, workspace: np.ndarray, spring_m: np.ndarray) -> ArmModel:
    n, width = spec.n_chambers, 128

    def zeros(*widths: int) -> Any:
        pairs = itertools.pairwise(widths)
        return tuple((np.zeros(pair, np.float32), np.zeros(pair[1], np.float32)) for pair in pairs)

    def row(value: Any, size: int = n) -> np.ndarray:
        return np.broadcast_to(np.float32(value), size).copy()

    angle = np.pi / 2 + 2 * np.pi * np.arange(n) / 3
    site_m = np.float32(0.067 * np.stack([np.cos(angle), np.sin(angle)], -1))
    n_changes = N_CHANGES * spec.structure.n_sections
    estimator = PoseEstimator(
        zeros(2 * n, width, width, n_changes), site_m, row(spring_m), row(0.05), row(1e-3, N_CHANGES)
    )
    springs = SpringModel(zeros(n, width, width, n), row(-10.0), row(30.0), row(spring_m), row(0.05))
    return ArmModel(workspace, estimator, springs, None)


if __name__ == "__main__":
    serve(prepare)
