"""Many arms in C MuJoCo's own threaded rollout, each stepped under the law until it rests.

One threaded call a control period, with the arms that still move.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import rollout

from benchmarks.speed.mujoco_arm import REST_M, Rest, Task
from mjx_softarm import control
from mjx_softarm.mechanics.mjcf import spring_lengths
from mjx_softarm.sensing.pose import pose_from_quaternion
from mjx_softarm.spec import ArmSpec


class Rested(NamedTuple):
    """What holding references led to."""

    pose: np.ndarray  # (n, 6) [mm, deg]
    pressure_kpa: np.ndarray  # (n, n_chambers)
    physics_steps: int  # of all arms together


def sensed_model(spec: ArmSpec) -> mujoco.MjModel:
    """The arm's model with sensors of its springs and its tip, which is what a rollout tells."""
    from mjx_softarm.mechanics.mjcf import build_spec

    mjspec = build_spec(spec)
    for chamber in range(spec.n_chambers):
        mjspec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_TENDONPOS,
            objtype=mujoco.mjtObj.mjOBJ_TENDON,
            objname=f"spring{chamber}",
        )
    for kind in (mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_FRAMEQUAT):
        mjspec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="tip")
    return mjspec.compile()


class RolloutArms:
    """Arms side by side; `stepping_s` is the time spent in the rollout so far.

    Args:
        model: from `sensed_model`.
        spec: of the same arm.
        n: arms.
        n_threads: of the rollout.
    """

    def __init__(self, model: mujoco.MjModel, spec: ArmSpec, n: int, n_threads: int):
        self.n, self.spec, self.model, self.task = n, spec, model, Task(spec)
        self._data = [mujoco.MjData(model) for _ in range(n_threads)]
        self._rollout, self.stepping_s = rollout.Rollout(nthread=n_threads), 0.0
        self._n_steps = round(self.task.period_s / model.opt.timestep)
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)  # time, qpos, qvel
        self._state = np.zeros((n, size))
        self._integral_kpa, self.length_m = np.zeros((2, n, spec.n_chambers))
        self.place(np.ones(n, bool), np.zeros((n, model.nq)), np.zeros((n, model.nu)))

    def place(self, arms: np.ndarray, q: np.ndarray, pressure_kpa: np.ndarray) -> None:
        """Put arms of a mask (n,) to rest: joint coordinates (k, nq) and the pressures [kPa] they balance."""
        self._state[arms] = 0.0
        self._state[arms, 1 : self.model.nq + 1] = q
        self._integral_kpa[arms] = pressure_kpa
        data = self._data[0]
        for index, coordinates in zip(np.flatnonzero(arms), q, strict=True):
            data.qpos[:] = coordinates
            mujoco.mj_fwdPosition(self.model, data)
            self.length_m[index] = spring_lengths(data)

    def move(self, reference_m: np.ndarray, rest_m: float = REST_M) -> Rested:
        """Hold references (n, n_chambers) until each arm rests.

        Springs are read as a rollout leaves them, one time step old.
        """
        rest, moving, n_physics = Rest(self.n, self.spec, rest_m), np.arange(self.n), 0
        pressure_kpa, tip = np.zeros_like(reference_m), np.zeros((self.n, 7))
        while len(moving):
            pressure, self._integral_kpa[moving] = control.pressures(
                reference_m[moving],
                self.length_m[moving],
                self._integral_kpa[moving],
                self.task.gains,
                self.task.period_s,
            )
            start = time.perf_counter()
            state, sensed = self._rollout.rollout(
                self.model, self._data, self._state[moving], pressure[:, None], nstep=self._n_steps
            )
            self.stepping_s += time.perf_counter() - start
            self._state[moving], pressure_kpa[moving] = state[:, -1], pressure
            self.length_m[moving], tip[moving] = np.split(sensed[:, -1], [self.spec.n_chambers], axis=1)
            n_physics += len(moving) * self._n_steps
            moving = moving[~rest.after(self.length_m[moving], moving)]
        return Rested(pose_from_quaternion(tip[:, :3], tip[:, 3:]), pressure_kpa, n_physics)

    def close(self) -> None:
        self._rollout.close()


class RolloutReach:
    """Reaching for poses with these arms, as `SteppedReach` does with one.

    Args:
        arms: many.
        pool: poses to start at and to reach.
        episode_length: environment steps.
    """

    def __init__(self, arms: RolloutArms, pool: dict[str, np.ndarray], episode_length: int):
        self.arms, self._pool, self._episode_length = arms, pool, episode_length
        self._rng = np.random.default_rng(0)
        self._goal, self._n_taken = np.zeros((arms.n, 6)), np.zeros(arms.n, int)
        self._reset(np.ones(arms.n, bool))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, Rested]:
        """Act with all arms (n, n_chambers): observations, rewards, references, and where they rest."""
        task = self.arms.task
        reference_m = task.reference_m(action)
        end = self.arms.move(reference_m)
        self._n_taken += 1
        value, reached = task.reward(
            end.pose, self._goal, self._n_taken, end.pressure_kpa, reference_m, self.arms.length_m
        )
        obs = task.observe(end.pose, self._goal)
        self._reset(reached | (self._n_taken >= self._episode_length))
        return obs, value, reference_m, end

    def _reset(self, over: np.ndarray) -> None:
        start, goal = self._rng.integers(len(self._pool["pose"]), size=(2, np.count_nonzero(over)))
        self.arms.place(over, self._pool["q"][start], self._pool["pressure_kpa"][start])
        self._goal[over], self._n_taken[over] = self._pool["pose"][goal], 0
