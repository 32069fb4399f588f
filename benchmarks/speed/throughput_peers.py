"""Workers of the throughput benchmark that simulate the arm by other means.

    python -m benchmarks.speed.throughput_peers subproc FOLDER N_PROCESSES     Stable-Baselines3's SubprocVecEnv
    python -m benchmarks.speed.throughput_peers rollout FOLDER N_THREADS       C MuJoCo's own threaded rollout
    python -m benchmarks.speed.throughput_peers warp FOLDER N_ARMS             MJX-Warp, time steps only

FOLDER is what `write_arm` wrote. The first two rest as `benchmarks.speed.mujoco_arm` says, and tell where.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from benchmarks.harness.rounds import Facts, serve
from benchmarks.speed.mujoco_arm import MODEL_FILE, POOL_FILE, SteppedReach
from benchmarks.speed.mujoco_rollout import RolloutArms, RolloutReach, sensed_model
from mjx_softarm.spec import ARM_FILE, ArmSpec

ROUND_S = 5.0
ARMS_PER_THREAD = 32
WARP_STEPS = 50


def write_arm(folder: Path, spec: ArmSpec, n_poses: int = 1024) -> None:
    """What a peer needs: specification, model, poses to start at and to reach."""
    from mjx_softarm.mechanics.workspace import sample_workspace

    spec.to_toml(folder / ARM_FILE)
    mujoco.mj_saveModel(sensed_model(spec), str(folder / MODEL_FILE))
    pool = sample_workspace(spec, n_poses, seed=0)
    arrays: dict[str, Any] = {name: np.asarray(x, float) for name, x in pool._asdict().items()}
    np.savez(folder / POOL_FILE, **arrays)


class Stepped(NamedTuple):
    """What a step of all environments took, and where it led."""

    n_env: int
    n_physics: int  # time steps of all arms together
    stepping_s: float  # of the call, spent in time steps; of processes their mean
    reference_m: np.ndarray  # (n_env, n_chambers)
    tip_mm: np.ndarray  # (n_env, 3)


def timed(step: Callable[[], Stepped], timestep_s: float) -> Facts:
    """Rates over `ROUND_S`, and what an environment step is made of."""
    steps = []
    start = time.perf_counter()
    while (spent := time.perf_counter() - start) < ROUND_S:
        steps.append(step())
    n_env, n_physics = sum(one.n_env for one in steps), sum(one.n_physics for one in steps)
    return {
        "env_steps_per_s": n_env / spent,
        "physics_steps_per_s": n_physics / spent,
        "physics_steps_per_env_step": round(n_physics / n_env),
        "simulated_s_per_env_step": round(timestep_s * n_physics / n_env, 2),
        "share_in_time_steps": round(sum(one.stepping_s for one in steps) / spent, 2),
        "reference_m": np.concatenate([one.reference_m for one in steps]).tolist(),
        "tip_mm": np.concatenate([one.tip_mm for one in steps]).tolist(),
    }


def _subproc(folder: str, n: int) -> tuple[Facts, Callable[[], Facts]]:
    from stable_baselines3 import __version__  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import SubprocVecEnv  # pyright: ignore[reportMissingImports]

    from mjx_softarm.env.gym import EPISODE_LENGTH  # brings JAX, which its processes do without

    makers = [functools.partial(SteppedReach, folder, seed, EPISODE_LENGTH) for seed in range(n)]
    envs = SubprocVecEnv(makers)
    envs.reset()
    model = mujoco.MjModel.from_binary_path(str(Path(folder) / MODEL_FILE))
    rng = np.random.default_rng(0)

    def step():
        *_, infos = envs.step(rng.uniform(-1.0, 1.0, (n, *envs.action_space.shape)))
        told = {name: np.array([info[name] for info in infos]) for name in infos[0]}
        n_physics, stepping_s = told["physics_steps"].sum(), told["stepping_s"].mean()
        return Stepped(n, int(n_physics), float(stepping_s), told["reference_m"], told["tip_mm"])

    step()
    return {"stable_baselines3": __version__}, lambda: timed(step, model.opt.timestep)


def _rollout(folder: str, n_threads: int) -> tuple[Facts, Callable[[], Facts]]:
    from mjx_softarm.env.gym import EPISODE_LENGTH

    spec = ArmSpec.from_toml(Path(folder) / ARM_FILE)
    model = mujoco.MjModel.from_binary_path(str(Path(folder) / MODEL_FILE))
    arms = RolloutArms(model, spec, ARMS_PER_THREAD * n_threads, n_threads)
    with np.load(Path(folder) / POOL_FILE) as pool:
        envs = RolloutReach(arms, {name: pool[name] for name in pool.files}, EPISODE_LENGTH)
    rng = np.random.default_rng(0)

    def step():
        before_s = arms.stepping_s
        *_, reference_m, end = envs.step(rng.uniform(-1.0, 1.0, (arms.n, spec.n_chambers)))
        return Stepped(arms.n, end.physics_steps, arms.stepping_s - before_s, reference_m, end.pose[:, :3])

    return {"arms": arms.n}, lambda: timed(step, model.opt.timestep)


def _warp(folder: str, n: int) -> tuple[Facts, Callable[[], Facts]]:
    import jax

    from mjx_softarm._support.mjx import mjx

    model = mujoco.MjModel.from_binary_path(str(Path(folder) / MODEL_FILE))
    on_device = mjx.put_model(model, impl="warp")
    one = mjx.make_data(model, impl="warp", naconmax=8, njmax=8)
    arms = jax.vmap(lambda _: one)(jax.numpy.arange(n))
    step = jax.vmap(mjx.step, in_axes=(None, 0))
    steps = jax.jit(
        lambda arms: jax.lax.fori_loop(0, WARP_STEPS, lambda _, data: step(on_device, data), arms)
    )
    jax.block_until_ready(steps(arms))

    def work() -> Facts:
        n_calls, start = 0, time.perf_counter()
        while (spent := time.perf_counter() - start) < 1.0:
            jax.block_until_ready(steps(arms))
            n_calls += 1
        return {"physics_steps_per_s": n * WARP_STEPS * n_calls / spent}

    return {"arms": n}, work


if __name__ == "__main__":
    _kind, _folder, _n = sys.argv[1:]
    _peers = {"subproc": _subproc, "rollout": _rollout, "warp": _warp}
    serve(lambda: _peers[_kind](_folder, int(_n)))
