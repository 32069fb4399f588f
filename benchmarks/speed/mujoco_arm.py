"""The arm as one would simulate it without this project's solver: C MuJoCo stepped in time until it rests.

An environment step holds the references until no spring has moved by more than `REST_M` within `REST_S`,
under the same law at the same rate, with the arm's own damping. Task, observation and reward are those of
`ReachEnv`. Nothing of JAX is imported, so that processes start fast and are small.

That takes seconds of simulated time for each environment step: the arm swings until its own damping has had
its due, and the law's integral action fills or empties a chamber no faster than its gains let it. Stopping
earlier is cheaper and ends further from rest, so the error of where it ends is told beside every rate.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

from mjx_softarm import control
from mjx_softarm.mdp.actions import ActionMap
from mjx_softarm.mdp.observation import OBS_SIZE, ObsScale, observe
from mjx_softarm.mdp.rewards import RewardConfig, reward
from mjx_softarm.mechanics.mjcf import spring_lengths
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.spec import ARM_FILE, ArmSpec

REST_S, REST_M = 0.5, 1e-4
LONGEST_S = 12.0  # an arm that moves on after this is taken as it is, and counted
SATURATION_TOLERANCE_M = 1e-3
MODEL_FILE, POOL_FILE = "model.mjb", "pool.npz"


class Rest:
    """Whether arms (n) have come to rest, judged by their springs tick by tick.

    Args:
        n: arms.
        spec: the arm.
        rest_m: within which a spring stays that rests.
    """

    def __init__(self, n: int, spec: ArmSpec, rest_m: float = REST_M):
        self._rest_m = rest_m
        self._n_ticks = round(REST_S * spec.control.rate_hz)
        self._longest = round(LONGEST_S * spec.control.rate_hz)
        self._past_m = np.empty((self._n_ticks + 1, n, spec.n_chambers))
        self._tick = 0

    def after(self, length_m: np.ndarray, arms: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Take the springs of some arms (k, n_chambers) after a tick; returns which are done (k,)."""
        self._past_m[self._tick % len(self._past_m), arms] = length_m
        self._tick += 1
        if self._tick >= self._longest:
            return np.ones(len(length_m), bool)
        if self._tick < len(self._past_m):
            return np.zeros(len(length_m), bool)
        oldest_m = self._past_m[self._tick % len(self._past_m), arms]
        if (np.abs(length_m - oldest_m).max(axis=-1) > self._rest_m).all():
            return np.zeros(len(length_m), bool)
        return (np.ptp(self._past_m[:, arms], axis=0) <= self._rest_m).all(axis=-1)


class Task:
    """References of actions, observations and rewards of arms (..., n), as `ReachEnv` has them."""

    def __init__(self, spec: ArmSpec):
        self.spec = spec
        self.gains = control.Gains.from_spec(spec)
        self.period_s = 1.0 / spec.control.rate_hz
        self._actions = ActionMap.from_spec(spec)
        self._scale, self._reward = ObsScale.from_spec(spec), RewardConfig()

    def reference_m(self, action: np.ndarray) -> np.ndarray:
        return self._actions.lengths(action)

    def observe(self, pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
        return observe(pose, goal, self._scale, self._reward).astype(np.float32)

    def reward(self, pose, goal, n_steps, pressure_kpa, reference_m, length_m) -> tuple[Any, Any]:
        """Reward, and whether the goal is reached."""
        saturated = control.saturated(
            pressure_kpa, reference_m, length_m, self.gains, SATURATION_TOLERANCE_M
        ).any(axis=-1)
        return reward(pose, goal, n_steps, saturated, self._reward)[:2]


class SteppedArm:
    """One arm that is stepped until it rests; `stepping_s` is the time spent in `mj_step` so far."""

    def __init__(self, model: mujoco.MjModel, task: Task, rest_m: float = REST_M):
        self.model, self.data, self.task = model, mujoco.MjData(model), task
        self._rest_m = rest_m
        self._n_steps = round(task.period_s / model.opt.timestep)
        self.stepping_s = 0.0
        self.place(np.zeros(model.nq), np.zeros(model.nu))

    def place(self, q: np.ndarray, pressure_kpa: np.ndarray) -> None:
        """Put it to rest at joint coordinates (nq,) that balance pressures (n,) [kPa]."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.ctrl[:] = q, pressure_kpa
        self._integral_kpa = np.array(pressure_kpa, float)
        mujoco.mj_forward(self.model, self.data)

    def move(self, reference_m: np.ndarray) -> int:
        """Hold references (n,) until it rests; returns the number of time steps.

        Springs are read as `mj_step` leaves them, one time step old.
        """
        rest, data, n_ticks = Rest(1, self.task.spec, self._rest_m), self.data, 0
        done = False
        while not done:
            data.ctrl[:], self._integral_kpa = control.pressures(
                reference_m, spring_lengths(data), self._integral_kpa, self.task.gains, self.task.period_s
            )
            start = time.perf_counter()
            mujoco.mj_step(self.model, data, self._n_steps)
            self.stepping_s += time.perf_counter() - start
            n_ticks += 1
            done = rest.after(data.ten_length[None, 1::2])[0]
        if data.warning.number.any():
            raise FloatingPointError("the model became unstable")
        return n_ticks * self._n_steps

    @property
    def tip_m(self) -> np.ndarray:
        return self.data.site("tip").xpos.copy()

    @property
    def pose(self) -> np.ndarray:
        tip = self.data.site("tip")
        return pose_from_frame(tip.xpos, tip.xmat.reshape(3, 3))


class SteppedReach(gymnasium.Env):
    """Reaching for poses with one such arm; an info has what an error of its rest can be found from.

    Args:
        folder: with specification, model and pool of poses, as `throughput_peers.write_arm` makes it.
        seed: of starts and goals.
        episode_length: environment steps.
    """

    def __init__(self, folder: str, seed: int, episode_length: int):
        spec = ArmSpec.from_toml(Path(folder) / ARM_FILE)
        self._task = Task(spec)
        self._arm = SteppedArm(mujoco.MjModel.from_binary_path(str(Path(folder) / MODEL_FILE)), self._task)
        with np.load(Path(folder) / POOL_FILE) as pool:
            self._pool = {name: pool[name] for name in pool.files}
        self._rng, self._episode_length = np.random.default_rng(seed), episode_length
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBS_SIZE,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (spec.n_chambers,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode at a random pose with a random goal; numbers go on where they were."""
        start, goal = self._rng.integers(len(self._pool["pose"]), size=2)
        self._arm.place(self._pool["q"][start], self._pool["pressure_kpa"][start])
        self._goal, self._n_steps = self._pool["pose"][goal], 0
        return self._task.observe(self._pool["pose"][start], self._goal), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        reference_m = self._task.reference_m(action)
        before_s = self._arm.stepping_s
        n_physics = self._arm.move(reference_m)
        self._n_steps += 1
        data, pose = self._arm.data, self._arm.pose
        value, reached = self._task.reward(
            pose, self._goal, self._n_steps, data.ctrl, reference_m, spring_lengths(data)
        )
        info = {
            "physics_steps": n_physics,
            "stepping_s": self._arm.stepping_s - before_s,
            "reference_m": reference_m,
            "tip_mm": pose[:3],
        }
        over = self._n_steps >= self._episode_length
        return self._task.observe(pose, self._goal), float(value), bool(reached), over, info
