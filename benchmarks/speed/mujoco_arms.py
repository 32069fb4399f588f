"""Arms without this project's solver: C MuJoCo stepped in time under the control law until each arm rests.

It takes seconds of simulated time. Stopping earlier is cheaper but ends further from the equilibrium, so each
rate has the error of the arms' resting place beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import gymnasium
import mujoco
import numpy as np
from mujoco import rollout

from mjx_softarm import control
from mjx_softarm.mechanics.mjcf import build_spec, spring_lengths
from mjx_softarm.spec import ArmSpec

REST_S, REST_M = 0.5, 1e-4
LONGEST_S = 12.0  # an arm that still moves after this is taken as it is


class SteppedRest(NamedTuple):
    """Arms after holding references."""

    tip_m: np.ndarray  # (n, 3)
    physics_steps: int  # of all arms together


class RestDetector:
    """Detector of n settled arms: no spring has moved by more than `REST_M` within `REST_S`."""

    def __init__(self, n: int, spec: ArmSpec):
        self._longest = round(LONGEST_S * spec.control.rate_hz)
        self._past_m = np.empty((round(REST_S * spec.control.rate_hz) + 1, n, spec.n_springs))
        self._tick = 0

    def settled(self, length_m: np.ndarray, arms: np.ndarray) -> np.ndarray:
        """Take the springs (k, n_springs) of some arms after a period; return which arms are done (k,)."""
        self._past_m[self._tick % len(self._past_m), arms] = length_m
        self._tick += 1
        if self._tick >= self._longest:
            return np.ones(len(length_m), bool)
        if self._tick < len(self._past_m):
            return np.zeros(len(length_m), bool)
        return np.ptp(self._past_m[:, arms], axis=0).max(axis=-1) <= REST_M


class SteppedArms:
    """Arms side by side in MuJoCo's threaded rollout, straight and without pressure at first.

    With 0 threads a single arm is stepped without rollout and sensors, which is faster for one. A rollout
    reads springs and tips by sensors, one time step late.
    """

    def __init__(self, spec: ArmSpec, n: int, n_threads: int):
        mjspec = build_spec(spec)
        for spring in range(spec.n_springs if n_threads else 0):
            kind, tendon = mujoco.mjtSensor.mjSENS_TENDONPOS, mujoco.mjtObj.mjOBJ_TENDON
            mjspec.add_sensor(type=kind, objtype=tendon, objname=f"spring{spring}")
        if n_threads:
            kind, site = mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtObj.mjOBJ_SITE
            mjspec.add_sensor(type=kind, objtype=site, objname="tip")
        self._model = model = mjspec.compile()
        self._data = [mujoco.MjData(model) for _ in range(max(1, n_threads))]
        self._rollout = rollout.Rollout(nthread=n_threads) if n_threads else None
        self._gains, self._period_s = control.Gains.from_spec(spec), 1.0 / spec.control.rate_hz
        self._n_steps = round(self._period_s / model.opt.timestep)
        self._n, self._spec, self.timestep_s = n, spec, model.opt.timestep

        # Straight arms
        mujoco.mj_fwdPosition(model, self._data[0])
        straight_m = np.asarray(spring_lengths(self._data[0], spec.n_chambers, spec.n_springs))
        self._state = np.zeros((n, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        self.length_m, self.tip_m = np.tile(straight_m, (n, 1)), np.zeros((n, 3))
        law = control.LawState.at_rest(np.zeros((n, spec.n_chambers)), self.length_m)
        self._law = control.LawState(*(np.array(memory) for memory in law))

    def settle(self, reference_m: np.ndarray) -> SteppedRest:
        """Hold references (n, n_springs) until each arm rests."""
        rest, moving, n_physics = RestDetector(self._n, self._spec), np.arange(self._n), 0
        while len(moving):
            self.tick(reference_m[moving], moving)
            n_physics += len(moving) * self._n_steps
            moving = moving[~rest.settled(self.length_m[moving], moving)]
        return SteppedRest(self.tip_m.copy(), n_physics)

    def tick(self, reference_m: np.ndarray, arms: np.ndarray | slice = slice(None)) -> None:
        """Run the law towards references (k, n_springs), and a control period, of some arms or all."""
        law = control.LawState(*(memory[arms] for memory in self._law))
        pressure_kpa, law = control.pressures(
            reference_m, self.length_m[arms], law, self._gains, self._period_s
        )
        for memory, new in zip(self._law, law, strict=True):
            memory[arms] = new
        if self._rollout is None:
            data = self._data[0]
            data.ctrl[:] = pressure_kpa[0]
            mujoco.mj_step(self._model, data, self._n_steps)
            self.length_m[0] = spring_lengths(data, self._spec.n_chambers, self._spec.n_springs)
            self.tip_m[0] = data.site("tip").xpos
            return
        state, sensed = self._rollout.rollout(
            self._model, self._data, self._state[arms], pressure_kpa[:, None], nstep=self._n_steps
        )
        self._state[arms] = state[:, -1]
        self.length_m[arms], self.tip_m[arms] = np.split(sensed[:, -1], [self._spec.n_springs], axis=1)


class SteppedEnv(gymnasium.Env):
    """One arm. An action is its references [m], an observation its tip [m] at rest; episodes have no end."""

    def __init__(self):
        spec = ArmSpec.default()
        self._arms = SteppedArms(spec, 1, n_threads=0)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
        self.action_space = gymnasium.spaces.Box(0.0, np.inf, (spec.n_springs,))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Leave the arm where it is."""
        return self._arms.tip_m[0].astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Hold references until the arm rests; there is no reward."""
        rest = self._arms.settle(action[None])
        return rest.tip_m[0].astype(np.float32), 0.0, False, False, {"n_physics": rest.physics_steps}
