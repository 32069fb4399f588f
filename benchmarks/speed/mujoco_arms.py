"""Arms without this project's solver: C MuJoCo's threaded rollout, stepped in time until each arm settles.

An environment step holds the references until no spring has moved by more than `REST_M` within `REST_S`.
Control law, rate, task, observation and reward are those of `ReachEnv`; the damping is the arm's own. JAX is
not imported, so that processes start fast and stay small.

An environment step takes seconds of simulated time: the arm swings until its damping has stopped it, and the
law's gains limit how fast a chamber fills. Stopping earlier is cheaper but ends further from the equilibrium.
So each rate has the error of the arms' resting place beside it.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import mujoco
import numpy as np
from mujoco import rollout

from mjx_softarm import control
from mjx_softarm.mdp.actions import ActionMap
from mjx_softarm.mdp.observation import OBS_SIZE, ObsScale, observe
from mjx_softarm.mdp.rewards import RewardConfig, reward
from mjx_softarm.sensing.pose import pose_from_frame, pose_from_quaternion
from mjx_softarm.spec import ARM_FILE, ArmSpec

REST_S, REST_M = 0.5, 1e-4
LONGEST_S = 12.0  # an arm that still moves after this is taken as it is
MODEL_FILE, POOL_FILE = "model.mjb", "pool.npz"


def sensed_model(spec: ArmSpec) -> mujoco.MjModel:
    """Return the arm's model with sensors of its springs and its tip, which a rollout records."""
    from mjx_softarm.mechanics.mjcf import build_spec  # imports JAX

    mjspec = build_spec(spec)
    for spring in range(spec.n_springs):
        kind, of = mujoco.mjtSensor.mjSENS_TENDONPOS, mujoco.mjtObj.mjOBJ_TENDON
        mjspec.add_sensor(type=kind, objtype=of, objname=f"spring{spring}")
    for kind in (mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_FRAMEQUAT):
        mjspec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="tip")
    return mjspec.compile()


def _springs(data: mujoco.MjData, spec: ArmSpec) -> np.ndarray:
    """Return the spring lengths (n_springs,) [m]; imports no JAX, as `mechanics.mjcf` does."""
    return data.ten_length[spec.n_chambers : spec.n_chambers + spec.n_springs]


class RestDetector:
    """Detector of n settled arms: no spring has moved by more than `REST_M` within `REST_S`."""

    def __init__(self, n: int, spec: ArmSpec):
        self._longest = round(LONGEST_S * spec.control.rate_hz)
        self._past_m = np.empty((round(REST_S * spec.control.rate_hz) + 1, n, spec.n_springs))
        self._tick = 0

    def after(self, length_m: np.ndarray, arms: slice | np.ndarray) -> np.ndarray:
        """Take the springs (k, n_springs) of some arms after a period; return which arms are done (k,)."""
        self._past_m[self._tick % len(self._past_m), arms] = length_m
        self._tick += 1
        if self._tick >= self._longest:
            return np.ones(len(length_m), bool)
        if self._tick < len(self._past_m):
            return np.zeros(len(length_m), bool)
        oldest_m = self._past_m[self._tick % len(self._past_m), arms]
        done = np.abs(length_m - oldest_m).max(axis=-1) <= REST_M
        if done.any():  # only then is the whole past worth its time
            done[done] = np.ptp(self._past_m[:, arms][:, done], axis=0).max(axis=-1) <= REST_M
        return done


class SteppedRest(NamedTuple):
    """Arms after holding references."""

    pose: np.ndarray  # (n, 6) [mm, deg]
    pressure_kpa: np.ndarray  # (n, n_chambers)
    physics_steps: int  # of all arms together


class SteppedArms:
    """Arms side by side in a threaded rollout of a `sensed_model`.

    With 0 threads a single arm is stepped without rollout and sensors, which is faster for one.
    """

    def __init__(self, model: mujoco.MjModel, spec: ArmSpec, n: int, n_threads: int):
        self.n, self.spec, self.model = n, spec, copy.copy(model)
        if not n_threads:
            self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        self.gains, self.period_s = control.Gains.from_spec(spec), 1.0 / spec.control.rate_hz
        self._data = [mujoco.MjData(model) for _ in range(max(1, n_threads))]
        self._rollout = rollout.Rollout(nthread=n_threads) if n_threads else None
        self._n_steps = round(self.period_s / model.opt.timestep)
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)  # time, qpos, qvel
        self._state = np.zeros((n, size))
        self.length_m = np.zeros((n, spec.n_springs))
        sizes = spec.n_chambers, spec.n_springs, spec.n_springs
        self._law = control.LawState(*(np.zeros((n, size)) for size in sizes))
        self._tip = np.zeros((n, 7))  # position and quaternion
        self.place(np.ones(n, bool), np.zeros((n, model.nq)), np.zeros((n, model.nu)))

    def place(self, arms: np.ndarray, q: np.ndarray, pressure_kpa: np.ndarray) -> None:
        """Put the arms of a mask (n,) to rest at joint coordinates (k, nq) that balance pressures [kPa]."""
        self._state[arms] = 0.0
        self._state[arms, 1 : self.model.nq + 1] = q
        data = self._data[0]
        for index, coordinates in zip(np.flatnonzero(arms), q, strict=True):
            mujoco.mj_resetData(self.model, data)
            data.qpos[:] = coordinates
            mujoco.mj_fwdPosition(self.model, data)
            self.length_m[index] = _springs(data, self.spec)
        self._remember(arms, control.LawState.at_rest(pressure_kpa, self.length_m[arms]))

    def _remember(self, arms: slice | np.ndarray, law: control.LawState) -> None:
        """Keep the law's memory of some arms."""
        for memory, new in zip(self._law, law, strict=True):
            memory[arms] = new

    def settle(self, reference_m: np.ndarray) -> SteppedRest:
        """Hold references (n, n_springs) until each arm rests.

        Springs are read as a rollout leaves them, one time step old.
        """
        rest, moving, n_physics = RestDetector(self.n, self.spec), np.arange(self.n), 0
        pressure_kpa = np.zeros((self.n, self.spec.n_chambers))
        while len(moving):
            arms = moving if len(moving) < self.n else slice(None)  # a slice copies nothing
            pressure_kpa[arms] = self._tick(arms, reference_m[arms])
            n_physics += len(moving) * self._n_steps
            moving = moving[~rest.after(self.length_m[arms], arms)]
        if self._rollout is None:
            tip = self._data[0].site("tip")
            pose = pose_from_frame(tip.xpos, tip.xmat.reshape(3, 3))[None]
        else:
            pose = pose_from_quaternion(self._tip[:, :3], self._tip[:, 3:])
        return SteppedRest(pose, pressure_kpa, n_physics)

    def hold(self, reference_m: np.ndarray, seconds: float) -> np.ndarray:
        """Hold references (n, n_springs) for a time; return the tips (ticks, n, 3) [mm] after each period."""
        tips_mm = np.empty((round(seconds / self.period_s), self.n, 3))
        for tick in range(len(tips_mm)):
            self._tick(slice(None), reference_m)
            tips_mm[tick] = 1e3 * self._tip[:, :3]
        return tips_mm

    def _tick(self, arms: slice | np.ndarray, reference_m: np.ndarray) -> np.ndarray:
        """Run the law and a control period of some arms; return the pressures (k, n_chambers)."""
        law = control.LawState(*(memory[arms] for memory in self._law))
        pressure_kpa, law = control.pressures(
            reference_m, self.length_m[arms], law, self.gains, self.period_s
        )
        self._remember(arms, law)
        self._step(arms, pressure_kpa)
        return pressure_kpa

    def _step(self, arms: slice | np.ndarray, pressure_kpa: np.ndarray) -> None:
        """Hold pressures (k, n_chambers) of some arms for a control period, and read springs and tips."""
        if self._rollout is None:
            self._data[0].ctrl[:] = pressure_kpa[0]
            mujoco.mj_step(self.model, self._data[0], self._n_steps)
            self.length_m[0] = _springs(self._data[0], self.spec)
        else:
            state, sensed = self._rollout.rollout(
                self.model, self._data, self._state[arms], pressure_kpa[:, None], nstep=self._n_steps
            )
            self._state[arms] = state[:, -1]
            self.length_m[arms], self._tip[arms] = np.split(sensed[:, -1], [self.spec.n_springs], axis=1)


def write_arm(folder: Path, spec: ArmSpec, n_poses: int = 1024) -> None:
    """Write the inputs of `SteppedReach`: specification, model, and poses to start at and to reach."""
    from mjx_softarm.mechanics.workspace import sample_workspace  # imports JAX

    spec.to_toml(folder / ARM_FILE)
    mujoco.mj_saveModel(sensed_model(spec), str(folder / MODEL_FILE))
    pool = sample_workspace(spec, n_poses, seed=0)
    arrays: dict[str, Any] = {name: np.asarray(x, float) for name, x in pool._asdict().items()}
    np.savez(folder / POOL_FILE, **arrays)


class SteppedReach:
    """Reaching for poses as `ReachEnv` defines it, with arms that are stepped in time.

    The folder has specification, model and pool of poses, as `write_arm` makes it.
    """

    def __init__(self, folder: str, n: int, n_threads: int, seed: int, episode_length: int):
        spec = ArmSpec.from_toml(Path(folder) / ARM_FILE)
        model = mujoco.MjModel.from_binary_path(str(Path(folder) / MODEL_FILE))
        self.arms = SteppedArms(model, spec, n, n_threads)
        with np.load(Path(folder) / POOL_FILE) as pool:
            self._pool = {name: pool[name] for name in pool.files}
        self._rng, self._episode_length = np.random.default_rng(seed), episode_length
        self._scale, self._reward = ObsScale.from_spec(spec), RewardConfig()
        self.reference_m = ActionMap.from_spec(spec).lengths  # of actions
        self.goal, self.n_taken = np.zeros((n, 6)), np.zeros(n, int)

    def reset(self, arms: np.ndarray) -> np.ndarray:
        """Start episodes of the arms of a mask (n,) at random poses; return observations (k, OBS_SIZE)."""
        start, goal = self._rng.integers(len(self._pool["pose"]), size=(2, np.count_nonzero(arms)))
        self.arms.place(arms, self._pool["q"][start], self._pool["pressure_kpa"][start])
        self.goal[arms], self.n_taken[arms] = self._pool["pose"][goal], 0
        return observe(self._pool["pose"][start], self.goal[arms], self._scale, self._reward)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, SteppedRest]:
        """Act with all arms (n, n_springs): observations, rewards, reached, over, where they are."""
        reference_m = self.reference_m(action)
        end = self.arms.settle(reference_m)
        self.n_taken += 1
        saturated = control.saturated(
            end.pressure_kpa, reference_m, self.arms.length_m, self.arms.gains, control.TOLERANCE_M
        ).any(axis=-1)
        value, reached, *_ = reward(end.pose, self.goal, self.n_taken, saturated, self._reward)
        obs = observe(end.pose, self.goal, self._scale, self._reward)
        return obs, value, reached, self.n_taken >= self._episode_length, end


class SteppedReachGym(gymnasium.Env):
    """`SteppedReach` of one arm; an info has references and tip, to find the error of where it stopped."""

    def __init__(self, folder: str, seed: int, episode_length: int):
        self._reach = SteppedReach(folder, 1, 0, seed, episode_length)
        n_springs = self._reach.arms.spec.n_springs
        self.timestep_s = self._reach.arms.model.opt.timestep
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBS_SIZE,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (n_springs,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode; its random numbers continue the last one's."""
        return self._reach.reset(np.ones(1, bool))[0].astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Hold the references of an action until the arm rests."""
        (obs,), (value,), (reached,), (over,), end = self._reach.step(action[None])
        info: dict[str, Any] = {
            "n_physics": end.physics_steps,
            "reference_m": self._reach.reference_m(action),
            "tip_mm": end.pose[0, :3],
        }
        return obs.astype(np.float32), float(value), bool(reached), bool(over), info
