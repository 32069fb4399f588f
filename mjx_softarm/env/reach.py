"""One arm that reaches for poses: a brax environment with the paper's state, action and reward.

The sensor-space law turns an action into pressures; the arm goes to its equilibrium at once, or moves.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm import control
from mjx_softarm._support import draws
from mjx_softarm._support.lazy import brax_envs, put
from mjx_softarm.env.config import EnvConfig
from mjx_softarm.env.state import ArmState, State, motion_params, nominal_share
from mjx_softarm.mdp import observation as obs
from mjx_softarm.mdp import rewards
from mjx_softarm.mdp.actions import ActionMap
from mjx_softarm.mechanics import mjx_rest
from mjx_softarm.mechanics.kinematics import DOFS_PER_LINK, chain_kinematics
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.motion import midpoint, mjx_step
from mjx_softarm.mechanics.motion.state import Motion, MotionEnd, MotionResult, MovingArm, n_earlier
from mjx_softarm.mechanics.params import PAYLOAD, ArmParams
from mjx_softarm.mechanics.pipe import body_clearance
from mjx_softarm.mechanics.settle import Settled, SettleResult, arms_at_once, settle
from mjx_softarm.mechanics.workspace import Pool, Seed, sample_evenly, sample_workspace
from mjx_softarm.pneumatics import Actuators, Regulator
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.sensing.s2r import S2R, carry_body, correct
from mjx_softarm.spec import ArmSpec

PAYLOAD_SHARE = 2  # index of the payload in the numbers of `ReachEnv.sample_noise`
POOL_SEED = 0  # of the poses that starts and goals are drawn from; not that of held-out ones
CLEARANCE_MARGIN_MM = 10.0  # clearance of the body to the wall from which there is no cost


class PosePool:
    """Poses of the workspace, a share of them uniform in volume; they are settled at the first use.

    A compiled function that takes them as an argument is compiled while they settle, and is the same program
    for all pools of one size. `observed` maps poses and spring lengths to the poses that are observed.
    """

    def __init__(self, spec: ArmSpec, config: EnvConfig, observed: Callable[[Array, Array], Array]):
        self._spec, self._config, self._observed = spec, config, observed
        self._given = ContextVar[Pool | None]("pool", default=None)
        sizes = DOFS_PER_LINK * spec.n_links, spec.n_chambers, spec.n_springs, 6
        shapes: Any = (jax.ShapeDtypeStruct((config.n_poses, size), jnp.float32) for size in sizes)
        self.shapes = Pool(*shapes)  # stand-ins for arrays

    def __call__(self) -> Pool:
        """Return the poses."""
        return self._given.get() or self._settled

    @functools.cached_property
    def _settled(self) -> Pool:
        with ThreadPoolExecutor(1) as elsewhere:  # the first use may be in a function that is traced
            return elsewhere.submit(self.draw, POOL_SEED).result()

    @contextlib.contextmanager
    def given(self, pool: Pool) -> Iterator[None]:
        """Use other poses, such as an argument of a traced function, within this context."""
        before = self._given.set(pool)
        try:
            yield
        finally:
            self._given.reset(before)

    def draw(self, seed: Seed) -> Pool:
        """Draw as many poses as the pool has, onto the device."""
        n_even = round(self._config.even_share * self._config.n_poses)
        counts = (self._config.n_poses - n_even, False), (n_even, True)
        parts = [self.sample(n, seed, evenly) for n, evenly in counts if n]
        return jax.device_put(jax.tree.map(lambda *part: np.concatenate(part), *parts))

    def sample(self, n: int, seed: Seed, evenly: bool = False) -> Pool:
        """Draw n poses, as they are observed, as NumPy arrays: JAX would compile each operation on them."""
        pool = (sample_evenly if evenly else sample_workspace)(self._spec, n, seed)
        return pool._replace(pose=np.float32(self._observed(pool.pose, pool.spring_m)))


class ReachEnv(brax_envs.Env):
    """A soft arm that reaches for poses of its workspace; brax's registry has it as "soft_arm".

    A pose is the tip's x, y, z [mm] and yaw, pitch, roll [deg] in the base frame, z up. For the paper's arm:

    Observation (18,), without unit, in the order of `mjx_softarm.mdp.observation.OBS_LAYOUT`:
        0-5    pose of the tip relative to the straight arm, in thirds of its length and units of 90 deg
        6-11   pose of the goal, scaled in this way, too
        12-17  error w (pose - goal), by the reward's weights per mm and per degree, angles wrapped
        With `observation="payload"` the payload follows, as a share of the largest; with "motion" the 39
        numbers of `mjx_softarm.mdp.observation.observe_motion`

    Action (n_springs,), each in [-1, 1]: sensor readings that the sensor-space law is to reach, from the
        reading of the shortest to that of the longest spring (`mjx_softarm.mdp.actions`)
    Reward (), without unit: `mjx_softarm.mdp.rewards.reward`
    Done (): 1 where the goal is reached with no chamber saturated, or where the simulation failed

    Info:
        valid () bool            the simulation succeeded; do not learn from other steps
        blocked (n_chambers,)    bool, chamber is at a pressure limit with its error not closed
        saturated () bool        a chamber is blocked
        clearance_mm ()          least distance of the body to the pipe's wall; infinite without a pipe
        path_mm (n_ticks, 3)     in motion: position of the tip at the start of each control period

    Metrics, each () float32:
        tip_error_mm             distance of the tip to the goal
        reached                  1 where the goal is reached
        saturated_chambers       number of blocked chambers
        unsettled                1 where the step is not valid
        invalid_REASON           1 for this code of `SettleResult`, or in motion of `MotionResult`
        reward_TERM              terms of the reward: goal, error, steps, saturation, distance, clearance

    With a sim-to-real network, poses and body are those it predicts of the real arm, P_S2R.
    """

    def __init__(self, spec: ArmSpec | None = None, config: EnvConfig | None = None, s2r: S2R | None = None):
        self.config, self.s2r = config or EnvConfig(), s2r
        self.spec = self.config.arm(spec or ArmSpec.default(), corrected=s2r is not None)

        # Parameters, law, actions and observations
        self.params = jax.device_put(ArmParams.from_spec(self.spec))
        self.scale = obs.ObsScale.from_spec(self.spec)
        self.gains = control.Gains.from_spec(self.spec)
        actuators = self.spec.actuators.per_chamber(self.spec.n_chambers)
        self.actuators: Actuators = jax.device_put(jax.tree.map(np.float32, actuators))
        sensor, *limits = ActionMap.from_spec(self.spec)
        self.action_map = ActionMap(sensor, *jax.device_put([np.float32(limit) for limit in limits]))
        self.pipe = self.config.pipe

        # Simulation, and the poses that starts and goals are drawn from
        self.uses_mjx = self.config.engine != "chain"
        self.n_at_once = arms_at_once(self.spec.n_links)
        self.model, self._data = put(build_model(self.spec)) if self.uses_mjx else (None, None)
        self._results = MotionResult if self.config.in_motion else SettleResult
        self._failures = {f"invalid_{r.name.lower()}": r.value for r in self._results if r.value != 0}
        self.poses = PosePool(self.spec, self.config, self._observed_pose)
        self.sample_pool = self.poses.sample

    @property
    def pool(self) -> Pool:
        """Poses that starts and goals are drawn from, settled at the first use."""
        return self.poses()

    @property
    def observation_size(self) -> int:
        return len(obs.layouts(self.spec)[self.config.observation])

    @property
    def payload_max_kg(self) -> float:
        """Largest payload of an episode on top of the specification's."""
        given_kg = self.config.randomisation.payload_max_kg
        if given_kg is not None:
            return given_kg
        return self.spec.mass.largest_payload_kg if self.config.observation == "payload" else 0.0

    @property
    def n_ticks(self) -> int:
        """Control periods of an action in motion."""
        return round(self.config.dynamic_step_s * self.spec.control.rate_hz)

    @property
    def action_size(self) -> int:
        return self.spec.n_springs

    @property
    def backend(self) -> str:
        return self.config.engine

    def _observed_pose(self, pose: Array, spring_m: Array) -> Array:
        """Return the pose, corrected if there is a sim-to-real network."""
        if self.s2r is None:
            return pose
        with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
            return correct(self.s2r, pose, spring_m)

    def reference_m(self, action: Array) -> Array:
        """Return the spring lengths (..., n_springs) [m] that an action in [-1, 1] asks for."""
        return self.action_map.lengths(action)

    def action_of(self, length_m: Array) -> Array:
        """Return the action in [-1, 1] that asks for spring lengths (..., n_springs) [m]."""
        return self.action_map.from_lengths(length_m)

    def reset(self, rng: Array) -> State:
        """Start an episode: an arm of the randomisation, at a random pose, with a random goal."""
        return self.reset_from(self.sample_noise(rng, 1)[0])

    def sample_noise(self, rng: Array, n: int) -> Array:
        """Draw the numbers from 0 to 1 that fix n episodes, a row each.

        They are start, goal, payload, the stiffness of each chamber, and `share` of `motion_params`.
        """
        moving = jnp.tile(nominal_share(self.actuators), (n, 1))
        if self.config.in_motion:
            moving = draws.uniform(jax.random.fold_in(rng, 1), moving.shape)
        return jnp.concatenate([draws.uniform(rng, (n, 3 + self.spec.n_chambers)), moving], axis=1)

    def reset_from(self, noise: Array) -> State:
        """Start the episode that a row of `sample_noise` fixes."""
        # Start and goal, and the arm of this episode
        start_row, goal_row = (self.config.n_poses * noise[:2]).astype(jnp.int32)
        pool = self.pool
        start = jax.tree.map(lambda x: x[start_row], pool)
        goal = pool.pose[goal_row]
        spread = self.config.randomisation
        stiffness, moving = jnp.split(noise[3:], [self.spec.n_chambers])
        factor = 1.0 + spread.stiffness_spread * (2.0 * stiffness - 1.0)
        arm = ArmState(
            payload_kg=self.params.tool_mass_kg[PAYLOAD] + self.payload_max_kg * noise[PAYLOAD_SHARE],
            chamber_stiffness=self.params.stiffened(factor).chamber_stiffness,
            moving=motion_params(self.actuators, spread, moving),
            motion=self._resting(start),
            pose=start.pose,
            spring_m=start.spring_m,
            pressure_kpa=start.pressure_kpa,
            sensed=None,
            goal=goal,
            n_steps=jnp.zeros((), jnp.int32),
        )
        arm = arm._replace(sensed=self._sensed(arm, arm, self.action_of(arm.spring_m)))

        # Metrics and info of an episode without a step
        zero = jnp.zeros(())
        names = ("tip_error_mm", "reached", "saturated_chambers", "unsettled", *self._failures)
        metrics = dict.fromkeys(names, zero)
        terms = rewards.reward(arm.pose, goal, arm.n_steps, jnp.array(False), self.config.reward)[2]
        metrics |= {f"reward_{name}": zero for name in terms}
        info = {"saturated": jnp.array(False), "blocked": jnp.zeros(self.spec.n_chambers, bool)}
        info |= {"valid": jnp.array(True), "clearance_mm": self._clearance_mm(start.q, start.pose)}
        if self.config.in_motion:
            info["path_mm"] = jnp.zeros((self.n_ticks, 3))
        return State(arm, self.observe(arm.pose, goal, arm.sensed), zero, zero, metrics, info)

    def _resting(self, start: Pool) -> Motion:
        """Return the state of an arm at rest at a row of a pool."""
        equilibrium = start.q, start.pressure_kpa, start.spring_m
        if not self.config.in_motion:
            return Motion.at_rest(*equilibrium)
        spread, actuators = self.config.randomisation, self.spec.actuators
        factor = 1.0 + spread.regulator_spread if isinstance(actuators, Regulator) else 1.0
        longest_s = factor * float(np.max(actuators.delay_s)) + spread.delay_max_s  # of all episodes
        n_waiting = n_earlier(longest_s, 1.0 / self.spec.control.rate_hz)
        return Motion.at_rest(*equilibrium, n_waiting, self.actuators.rest_offset_kpa)

    def step(self, state: State, action: Array) -> State:
        """Move to the references of `action` (n_springs,) in [-1, 1]; `done` is 1 where the goal is reached.

        An arm that did not settle, or is not finite, keeps its last pose, earns nothing and ends its episode;
        `info["valid"]` is then false, and the transition must not be learned from.
        """
        # Move; a NaN in the action would ask for a length of 0
        arm: ArmState = state.pipeline_state
        reference_m = self.reference_m(action)
        motion, end = self._move(arm, reference_m)
        result = jnp.where(jnp.all(jnp.isfinite(action)), end.result, self._results.NOT_FINITE.value)
        valid = result == 0

        # Next state; where the simulation failed, the arm keeps its last one
        next_arm = arm._replace(
            motion=motion,
            pose=self._observed_pose(pose_from_frame(end.tip_position_m, end.tip_rotation), end.spring_m),
            spring_m=end.spring_m,
            pressure_kpa=end.pressure_kpa,
            n_steps=arm.n_steps + 1,
        )
        next_arm = next_arm._replace(sensed=self._sensed(next_arm, end, action))
        arm = jax.tree.map(lambda new, old: jnp.where(valid, new, old), next_arm, arm)

        # Saturation, by the law's integral: in motion a pressure may be at a limit for a moment
        held_kpa = arm.motion.law.integral_kpa
        off = control.saturated(held_kpa, reference_m, arm.spring_m, self.gains, control.TOLERANCE_M)
        blocked = off & valid  # (n_chambers,)
        saturated = jnp.any(blocked)

        # Reward
        way = self._way(arm, end, valid)
        cost, config = self.clearance_cost(way["clearance_mm"]), self.config.reward
        value, reached, terms = rewards.reward(arm.pose, arm.goal, arm.n_steps, saturated, config, cost)

        metrics = {
            "tip_error_mm": jnp.linalg.norm(arm.pose[:3] - arm.goal[:3]),
            "reached": reached & valid,
            "saturated_chambers": jnp.sum(blocked),
            "unsettled": ~valid,
            **{name: result == code for name, code in self._failures.items()},
            **{f"reward_{name}": jnp.where(valid, term, 0.0) for name, term in terms.items()},
        }
        metrics = {name: jnp.asarray(x, jnp.float32) for name, x in metrics.items()}
        info = {"saturated": saturated, "blocked": blocked, "valid": valid, **way}
        return state.replace(
            pipeline_state=arm,
            obs=self.observe(arm.pose, arm.goal, arm.sensed),
            reward=jnp.where(valid, value, 0.0),
            done=((reached & self.config.goal_ends) | ~valid).astype(jnp.float32),
            metrics=state.metrics | metrics,
            info=state.info | info,
        )

    def _move(self, arm: ArmState, reference_m: Array) -> tuple[Motion, Settled | MotionEnd]:
        """Move to spring lengths (n_springs,); return the motion and the observables at its end."""
        params, config = self.params_of(arm), self.config
        if config.in_motion:
            moving = MovingArm(self.model, self._data, params, arm.moving)
            times_s = config.dynamic_step_s, 1.0 / self.spec.control.rate_hz, config.simulation_step_s
            arguments = moving, arm.motion, reference_m, self.gains, *times_s
            if config.engine == "mjx":
                return midpoint.advance(*arguments, self.n_at_once)
            return mjx_step.advance(*arguments)
        end = settle(params, reference_m, self.n_at_once)
        if config.engine == "mjx":
            end = mjx_rest.measured(self.model, self._data, params, end)
        return Motion.at_rest(end.q, end.pressure_kpa, end.spring_m), end

    def _way(self, arm: ArmState, end: Settled | MotionEnd, valid: Array) -> dict[str, Array]:
        """Return `clearance_mm` and, in motion, `path_mm` of `info`."""
        clearance_mm = self._clearance_mm(arm.motion.q, arm.pose)
        if not isinstance(end, MotionEnd):
            return {"clearance_mm": clearance_mm}
        path = end.path
        tips = pose_from_frame(path.tip_position_m, path.tip_rotation)
        pose = self._observed_pose(tips, path.spring_m)  # (n_ticks, 6)
        way_mm = self._body_clearance_mm(path.plate_position_m, path.plate_rotation, pose)  # start included
        least_mm = jnp.min(way_mm[1:], initial=clearance_mm)
        return {"path_mm": pose[:, :3], "clearance_mm": jnp.where(valid, least_mm, clearance_mm)}

    def _clearance_mm(self, q: Array, pose: Array) -> Array:
        """Return the clearance () at joint coordinates (nv,), with the tip at a pose (6,)."""
        if self.pipe is None:  # spares the tracing of the kinematics
            return jnp.asarray(jnp.inf, pose.dtype)
        frames = chain_kinematics(self.params)(q)
        return self._body_clearance_mm(frames.plate_position, frames.plate_rotation, pose)

    def _body_clearance_mm(self, position_m: Array, rotation: Array, pose: Array) -> Array:
        """Return clearances (...) of bodies with plates (..., n_links + 1), tips at poses (..., 6)."""
        if self.pipe is None:
            return jnp.full(pose.shape[:-1], jnp.inf, pose.dtype)
        if self.s2r is not None:
            position_m, rotation = carry_body(position_m, rotation, pose)
        return 1e3 * body_clearance(self.pipe, position_m, rotation, self.spec)

    def clearance_cost(self, clearance_mm: Array) -> Array:
        """Return the cost (...) of clearances (...) [mm] of the body to the pipe's wall."""
        within_mm = jnp.maximum(CLEARANCE_MARGIN_MM - clearance_mm, 0.0)
        return self.config.clearance_cost_per_mm * within_mm

    def observe(self, pose: Array, goal: Array, sensed: Array | None = None) -> Array:
        """Return the observation (..., O) of pose and goal (..., 6) [mm, deg] and of `ArmState.sensed`."""
        observed = obs.observe(pose, goal, self.scale, self.config.reward)
        return observed if sensed is None else jnp.concatenate([observed, sensed], axis=-1)

    def _sensed(self, arm: ArmState, end: ArmState | Settled | MotionEnd, action: Array) -> Array | None:
        """Return `ArmState.sensed`; without a motion before it, rates are zero."""
        if self.config.observation == "pose":
            return None
        if self.config.observation == "payload":
            return obs.observe_payload(arm.payload_kg, self.spec)
        last_m, tip_mm, last_mm = end.spring_m, jnp.zeros(3), jnp.zeros(3)
        if isinstance(end, MotionEnd):
            before = max(self.n_ticks - obs.rate_ticks(self.spec.control.rate_hz), 0)
            last_m, tip_mm = end.path.spring_m[before], 1e3 * end.tip_position_m
            last_mm = 1e3 * end.path.tip_position_m[before]
        held_kpa = arm.motion.law.integral_kpa
        return obs.observe_motion(arm.spring_m, last_m, tip_mm, last_mm, held_kpa, action, self.spec)

    def params_of(self, arm: ArmState) -> ArmParams:
        """Return the parameters of an arm in its episode."""
        return self.params._replace(
            tool_mass_kg=self.params.tool_mass_kg.at[PAYLOAD].set(arm.payload_kg),
            chamber_stiffness=arm.chamber_stiffness,
        )


brax_envs.register_environment("soft_arm", ReachEnv)
