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
from typing import Any

import mujoco
import numpy as np

from benchmarks.mujoco_arm import (
    EPISODE_LENGTH,
    MODEL_FILE,
    POOL_FILE,
    Rest,
    SteppedReach,
    Task,
)
from benchmarks.rounds import Facts, serve
from mjx_softarm import control
from mjx_softarm.spec import ARM_FILE, ArmSpec

ROUND_S = 5.0
ARMS_PER_THREAD = 32
WARP_STEPS = 50


def write_arm(folder: Path, spec: ArmSpec, n_poses: int = 1024) -> None:
    """What a peer needs: specification, model with sensors of springs and tip, poses to start at and reach."""
    from mjx_softarm.mjcf import build_spec
    from mjx_softarm.workspace import sample_workspace

    spec.to_toml(folder / ARM_FILE)
    mjspec = build_spec(spec)
    for chamber in range(spec.n_chambers):
        mjspec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_TENDONPOS,
            objtype=mujoco.mjtObj.mjOBJ_TENDON,
            objname=f"spring{chamber}",
        )
    for kind in (mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_FRAMEQUAT):
        mjspec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="tip")
    mujoco.mj_saveModel(mjspec.compile(), str(folder / MODEL_FILE))
    pool = sample_workspace(spec, n_poses, seed=0)
    np.savez(folder / POOL_FILE, **{name: np.asarray(x, float) for name, x in pool._asdict().items()})


class RolloutArms:
    """Many arms, each stepped until it rests, those that still move in one threaded call per control period.

    Args:
        folder: from `write_arm`.
        n: arms.
        n_threads: of the rollout.
    """

    def __init__(self, folder: str, n: int, n_threads: int):
        from mujoco import rollout

        self.n, self.spec = n, ArmSpec.from_toml(Path(folder) / ARM_FILE)
        self.task = Task(self.spec)
        self.model = mujoco.MjModel.from_binary_path(str(Path(folder) / MODEL_FILE))
        self._data = [mujoco.MjData(self.model) for _ in range(n_threads)]
        self._rollout = rollout.Rollout(nthread=n_threads)
        self._n_steps = round(self.task.period_s / self.model.opt.timestep)
        with np.load(Path(folder) / POOL_FILE) as pool:
            self._pool = {name: pool[name] for name in pool.files}
        self._rng = np.random.default_rng(0)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self._state = np.zeros((n, mujoco.mj_stateSize(self.model, kind)))  # time, qpos, qvel
        self._integral_kpa, self._length_m = np.zeros((2, n, self.spec.n_chambers))
        self._goal, self._n_taken = np.zeros((n, 6)), np.zeros(n, int)
        self.reset(np.ones(n, bool))

    def reset(self, over: np.ndarray) -> None:
        """New episodes where `over` (n,) says so."""
        start, goal = self._rng.integers(len(self._pool["pose"]), size=(2, np.count_nonzero(over)))
        nq = self.model.nq
        self._state[over] = 0.0
        self._state[over, 1 : nq + 1] = self._pool["q"][start]
        self._integral_kpa[over] = self._pool["pressure_kpa"][start]
        self._length_m[over] = self._pool["spring_m"][start]
        self._goal[over], self._n_taken[over] = self._pool["pose"][goal], 0

    def step(self, action: np.ndarray) -> dict[str, Any]:
        """Act with all arms (n, n_chambers) until each rests; what that led to, and how many time steps."""
        reference_m = self.task.reference_m(action)
        rest, moving, n_physics = Rest(self.n, self.spec), np.arange(self.n), 0
        pressure_kpa, tip = np.zeros_like(reference_m), np.zeros((self.n, 7))
        while len(moving):
            pressure, self._integral_kpa[moving] = control.pressures(
                reference_m[moving],
                self._length_m[moving],
                self._integral_kpa[moving],
                self.task.gains,
                self.task.period_s,
            )
            state, sensed = self._rollout.rollout(
                self.model, self._data, self._state[moving], pressure[:, None], nstep=self._n_steps
            )
            self._state[moving], pressure_kpa[moving] = state[:, -1], pressure
            self._length_m[moving], tip[moving] = np.split(sensed[:, -1], [self.spec.n_chambers], axis=1)
            n_physics += len(moving) * self._n_steps
            moving = moving[~rest.after(self._length_m[moving], moving)]
        return self._outcome(reference_m, pressure_kpa, tip) | {"physics_steps": n_physics}

    def _outcome(self, reference_m: np.ndarray, pressure_kpa: np.ndarray, tip: np.ndarray) -> dict[str, Any]:
        from mjx_softarm.pose import pose_from_quaternion

        pose = pose_from_quaternion(tip[:, :3], tip[:, 3:])
        self._n_taken += 1
        value, reached = self.task.reward(
            pose, self._goal, self._n_taken, pressure_kpa, reference_m, self._length_m
        )
        obs = self.task.observe(pose, self._goal)
        self.reset(reached | (self._n_taken >= EPISODE_LENGTH))
        return {"obs": obs, "reward": value, "reference_m": reference_m, "tip_mm": pose[:, :3]}

    def close(self) -> None:
        self._rollout.close()


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
    arms = RolloutArms(folder, ARMS_PER_THREAD * n_threads, n_threads)
    rng = np.random.default_rng(0)

    def step():
        end = arms.step(rng.uniform(-1.0, 1.0, (arms.n, arms.spec.n_chambers)))
        return arms.n, end["physics_steps"], end["reference_m"], end["tip_mm"]

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
