"""Workers of the throughput benchmark that simulate the arm by other means.

    python -m benchmarks.throughput_peers subproc FOLDER N_PROCESSES     Stable-Baselines3's SubprocVecEnv
    python -m benchmarks.throughput_peers rollout FOLDER N_THREADS       C MuJoCo's own threaded rollout
    python -m benchmarks.throughput_peers warp FOLDER N_ARMS             MJX-Warp, time steps only

FOLDER is what `write_arm` wrote. The first two rest as `benchmarks.mujoco_arm` says, and tell where.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.mujoco_arm import EPISODE_LENGTH, MODEL_FILE, POOL_FILE, SteppedReach
from benchmarks.mujoco_rollout import RolloutArms, RolloutReach, sensed_model
from benchmarks.rounds import Facts, serve
from mjx_softarm.spec import ARM_FILE, ArmSpec

ROUND_S = 5.0
ARMS_PER_THREAD = 32
WARP_STEPS = 50


def write_arm(folder: Path, spec: ArmSpec, n_poses: int = 1024) -> None:
    """What a peer needs: specification, model, poses to start at and to reach."""
    from mjx_softarm.workspace import sample_workspace

    spec.to_toml(folder / ARM_FILE)
    mujoco.mj_saveModel(sensed_model(spec), str(folder / MODEL_FILE))
    pool = sample_workspace(spec, n_poses, seed=0)
    np.savez(folder / POOL_FILE, **{name: np.asarray(x, float) for name, x in pool._asdict().items()})


def _timed(step: Callable[[], tuple[int, int, np.ndarray, np.ndarray]]) -> Facts:
    """Rates over `ROUND_S`; a step gives its environment and time steps, its references and tips."""
    n_env = n_physics = 0
    reference, tip = [], []
    start = time.perf_counter()
    while (spent := time.perf_counter() - start) < ROUND_S:
        steps, physics, reference_m, tip_mm = step()
        n_env, n_physics = n_env + steps, n_physics + physics
        reference.append(reference_m)
        tip.append(tip_mm)
    return {
        "env_steps_per_s": n_env / spent,
        "physics_steps_per_s": n_physics / spent,
        "reference_m": np.concatenate(reference).tolist(),
        "tip_mm": np.concatenate(tip).tolist(),
    }


def _subproc(folder: str, n: int) -> tuple[Facts, Callable[[], Facts]]:
    from stable_baselines3 import __version__  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import SubprocVecEnv  # pyright: ignore[reportMissingImports]

    envs = SubprocVecEnv([functools.partial(SteppedReach, folder, seed) for seed in range(n)])
    envs.reset()
    rng = np.random.default_rng(0)

    def step():
        *_, infos = envs.step(rng.uniform(-1.0, 1.0, (n, *envs.action_space.shape)))
        arrays = (np.array([info[name] for info in infos]) for name in ("reference_m", "tip_mm"))
        return n, sum(info["physics_steps"] for info in infos), *arrays

    step()
    return {"stable_baselines3": __version__}, lambda: _timed(step)


def _rollout(folder: str, n_threads: int) -> tuple[Facts, Callable[[], Facts]]:
    spec = ArmSpec.from_toml(Path(folder) / ARM_FILE)
    model = mujoco.MjModel.from_binary_path(str(Path(folder) / MODEL_FILE))
    arms = RolloutArms(model, spec, ARMS_PER_THREAD * n_threads, n_threads)
    with np.load(Path(folder) / POOL_FILE) as pool:
        envs = RolloutReach(arms, {name: pool[name] for name in pool.files}, EPISODE_LENGTH)
    rng = np.random.default_rng(0)

    def step():
        *_, reference_m, end = envs.step(rng.uniform(-1.0, 1.0, (arms.n, spec.n_chambers)))
        return arms.n, end.physics_steps, reference_m, end.pose[:, :3]

    return {"arms": arms.n}, lambda: _timed(step)


def _warp(folder: str, n: int) -> tuple[Facts, Callable[[], Facts]]:
    import jax

    from mjx_softarm._mjx import mjx

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
