"""Worker: arms that C MuJoCo steps in time, as `benchmarks.speed.mujoco_arms` defines them.

    python -m benchmarks.speed.mujoco_worker subproc FOLDER N_PROCESSES    Stable-Baselines3's SubprocVecEnv
    python -m benchmarks.speed.mujoco_worker rollout FOLDER N_THREADS      MuJoCo's own threaded rollout
    python -m benchmarks.speed.mujoco_worker settle REFERENCES LINKS       equilibria of references

FOLDER is made by `write_arm`. REFERENCES is an npy file with references (n, n_springs) [m]; the first
`N_STEPPED` of them are taken. All tell where the arms stopped.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.harness.rounds import Facts, serve
from benchmarks.speed.mujoco_arms import SteppedArms, SteppedReach, SteppedReachGym, sensed_model
from mjx_softarm.spec import ArmSpec

ROUND_S = 5.0
ARMS_PER_THREAD = 32
N_STEPPED = 64


class Step(NamedTuple):
    """Cost of a step of all environments, and where it led."""

    n_physics: int  # time steps of all arms together
    reference_m: np.ndarray  # (n_env, n_springs)
    tip_mm: np.ndarray  # (n_env, 3)


def timed(step: Callable[[], Step], timestep_s: float) -> Facts:
    """Step for `ROUND_S`; return rates, the simulated time of an environment step, and where they led."""
    steps = []
    start = time.perf_counter()
    while (spent := time.perf_counter() - start) < ROUND_S:
        steps.append(step())
    reference_m, tip_mm = (np.concatenate([getattr(one, x) for one in steps]) for x in Step._fields[1:])
    simulated_s = timestep_s * sum(one.n_physics for one in steps)  # of all arms together
    return {
        "env_steps_per_s": len(tip_mm) / spent,
        "simulated_s_per_s": simulated_s / spent,
        "simulated_s_per_env_step": round(simulated_s / len(tip_mm), 2),
        "reference_m": reference_m.tolist(),
        "tip_mm": tip_mm.tolist(),
    }


def subproc(folder: str, n: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare an arm in each of n processes."""
    from stable_baselines3 import __version__  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import SubprocVecEnv  # pyright: ignore[reportMissingImports]

    from mjx_softarm.env.gym import EPISODE_LENGTH  # imports JAX, which the processes do without

    makers = [functools.partial(SteppedReachGym, folder, seed, EPISODE_LENGTH) for seed in range(int(n))]
    envs, rng = SubprocVecEnv(makers), np.random.default_rng(0)
    timestep_s = envs.get_attr("timestep_s")[0]
    envs.reset()

    def step() -> Step:
        *_, infos = envs.step(rng.uniform(-1.0, 1.0, (int(n), *envs.action_space.shape)))
        told = {name: np.array([info[name] for info in infos]) for name in Step._fields}
        return Step(int(told["n_physics"].sum()), told["reference_m"], told["tip_mm"])

    step()
    return {"stable_baselines3": __version__}, lambda: timed(step, timestep_s)


def rollout(folder: str, n_threads: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare `ARMS_PER_THREAD` arms for each of n threads."""
    from mjx_softarm.env.gym import EPISODE_LENGTH

    n = ARMS_PER_THREAD * int(n_threads)
    envs, rng = SteppedReach(folder, n, int(n_threads), 0, EPISODE_LENGTH), np.random.default_rng(0)
    envs.reset(np.ones(n, bool))

    def step() -> Step:
        action = rng.uniform(-1.0, 1.0, (n, envs.arms.spec.n_springs))
        _, _, reached, over, end = envs.step(action)
        envs.reset(reached | over)
        return Step(end.physics_steps, envs.reference_m(action), end.pose[:, :3])

    timestep_s = envs.arms.model.opt.timestep
    return {"arms": n, "step_ms": 1e3 * timestep_s}, lambda: timed(step, timestep_s)


def settle(references: str, links: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare arms that go from straight to their references, on all cores."""
    from benchmarks.harness.common import n_cores  # imports packages that a peer's environment lacks

    spec = ArmSpec.default().replace(structure={"links_per_section": int(links)})
    reference_m = np.load(references)[:N_STEPPED]
    n = len(reference_m)
    arms = SteppedArms(sensed_model(spec), spec, n, n_cores())
    straight, empty = np.zeros((n, arms.model.nq)), np.zeros((n, spec.n_chambers))

    def work() -> Facts:
        start = time.perf_counter()
        arms.place(np.ones(n, bool), straight, empty)
        end = arms.settle(reference_m)
        return {
            "solves_per_s": n / (time.perf_counter() - start),
            "tip_mm": end.pose[:, :3].tolist(),
            "mean_simulated_s": round(end.physics_steps * arms.model.opt.timestep / n, 2),
        }

    return {}, work


if __name__ == "__main__":
    serve(lambda: {"subproc": subproc, "rollout": rollout, "settle": settle}[sys.argv[1]](*sys.argv[2:]))
