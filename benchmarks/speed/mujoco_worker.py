"""Worker: environment steps of arms that C MuJoCo steps in time, see `benchmarks.speed.mujoco_arms`.

    python -m benchmarks.speed.mujoco_worker subproc N_PROCESSES    Stable-Baselines3's SubprocVecEnv
    python -m benchmarks.speed.mujoco_worker rollout N_THREADS      MuJoCo's own threaded rollout

A step holds the references of a random action until the arm rests. Observation and reward are left out:
beside some 25 ms of physics they take no time.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from benchmarks.harness.rounds import Facts, serve
from benchmarks.speed.mujoco_arms import SteppedArms, SteppedEnv, SteppedRest
from mjx_softarm.mdp.actions import ActionMap
from mjx_softarm.spec import ArmSpec

ROUND_S = 5.0
ARMS_PER_THREAD = 32
SPEC = ArmSpec.default()
TIMESTEP_S = SteppedArms(SPEC, 1, 0).timestep_s


def timed(step: Callable[[np.ndarray], SteppedRest], n: int, rng: np.random.Generator) -> Facts:
    """Step n arms for `ROUND_S`; return rates, references, and tips where the arms stopped."""
    lengths = ActionMap.from_spec(SPEC).lengths
    references, ends = [], []
    start = time.perf_counter()
    while (spent := time.perf_counter() - start) < ROUND_S:
        references.append(lengths(rng.uniform(-1.0, 1.0, (n, SPEC.n_springs))))
        ends.append(step(references[-1]))
    return {
        "env_steps_per_s": n * len(ends) / spent,
        "simulated_s_per_s": TIMESTEP_S * sum(end.physics_steps for end in ends) / spent,
        "reference_m": np.concatenate(references).tolist(),
        "tip_mm": (1e3 * np.concatenate([end.tip_m for end in ends])).tolist(),
    }


def prepare(kind: str, n: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare an arm in each of n processes, or `ARMS_PER_THREAD` arms for each of n threads."""
    if kind == "rollout":
        n_arms = ARMS_PER_THREAD * int(n)
        step = SteppedArms(SPEC, n_arms, int(n)).settle
    else:
        from stable_baselines3.common import vec_env  # pyright: ignore[reportMissingImports]

        n_arms = int(n)
        envs = vec_env.SubprocVecEnv([SteppedEnv] * n_arms)
        envs.reset()

        def step(reference_m: np.ndarray) -> SteppedRest:
            tip_m, _, _, infos = envs.step(reference_m)
            return SteppedRest(tip_m, sum(info["n_physics"] for info in infos))

    rng = np.random.default_rng(0)
    return {"arms": n_arms, "step_ms": 1e3 * TIMESTEP_S}, lambda: timed(step, n_arms, rng)


if __name__ == "__main__":
    serve(lambda: prepare(*sys.argv[1:]))
