"""The scripted expert: chamber pressures that bring the finger tips to waypoints.

For each waypoint the expert seeks an equilibrium of the arm with the finger tips there, the body inside the
pipe, and chambers and springs away from their limits. Weaker terms keep the body clear of the wall, and the
pressures close to the previous posture's. This is a least-squares problem in the pressures, with one-sided
errors for the limits. A damped Gauss-Newton method solves it from many starts, some of them near the previous
posture. The expert takes a solution whose straight path in pressures from there is clear, and of several the
nearest. Where there is no solution, it tries again with the gripper's orientation weighted less.

With a sim-to-real network, poses and body are the real arm's, P_S2R; see `carry_body`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.xp import array_namespace
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.pipe import CrossPipe, body_points, clearance
from mjx_softarm.mechanics.settle import RESIDUAL_TOLERANCE, settle_pressures
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_frame
from mjx_softarm.sensing.s2r import S2R, carry_body, correct
from mjx_softarm.spec import ArmSpec
from train.demos.waypoints import Waypoint

N_POOL = 4096  # random pressures, of which those clear of the wall are kept
N_STARTS = 32  # starts of the solver
_BATCH = 128  # postures computed in one call
N_JITTERED, JITTER_KPA = 8, 3.0  # starts around the previous posture, and their spread
WAY = (0.25, 0.5, 0.75)  # shares of the path from the previous posture at which clearance is checked
WAY_CLEAR_M = 0.01  # more clearance than this on the path counts the same
TOLERANCE_M, TOLERANCE_RAD = 5e-4, 0.01  # errors at which a waypoint counts as met
EASED = 0.2  # weight of the orientation in a second try: its error may then be 5 times larger
LIMIT_SHARE = 0.8  # share of a margin that must be kept: one-sided errors end a little inside of it
N_STEPS = 25  # steps of the solver
MARGIN_M, SPRING_MARGIN_M = 0.004, 1e-3  # clearance of the body, distance of the springs to their limits
MARGIN_KPA = 1.5  # distance of the chambers to their limits
COMFORT_M, COMFORT_KPA = 0.02, 6.0  # clearance and distance of the chambers above which more is no better

# Units of the least-squares errors.
_POSITION_M, _TURN_RAD, _LIMIT_KPA, _LIMIT_M = 1e-4, 1e-3, 0.1, 1e-4
_COMFORT_M, _COMFORT_KPA, _NEAR_KPA = 0.01, 3.0, 20.0
_NO_WALL_M = 1.0  # clearance where there is no pipe


class Posture(NamedTuple):
    """An arm at rest; each field may have leading axes."""

    pressure_kpa: Any  # (n_chambers,)
    spring_m: Any  # (n_springs,) references to hold
    pose: Any  # (6,) [mm, deg] pose of the tip, the real arm's where there is a network
    finger_m: Any  # (3,) finger tips
    rotation: Any  # (3, 3) orientation of the gripper
    clearance_m: Any  # () clearance of the body
    residual: Any  # () residual of the equilibrium [N, N m]


class PostureTarget(NamedTuple):
    """A posture to find."""

    finger_m: Any  # (3,) finger tips
    rotation: Any  # (3, 3) orientation of the gripper
    turn: Any  # (3,) 1 for each axis of the gripper whose rotation is fixed, else 0
    bias_kpa: Any  # (n_chambers,) real arm's pressures less the simulated arm's
    near_kpa: Any  # (n_chambers,) pressures of the previous posture


def angle_between(rotation: Any, target: Any) -> Any:
    """Return sines (..., 3) of the turn from rotations (..., 3, 3) to a target (3, 3), in gripper axes."""
    xp = array_namespace(rotation)
    turn = xp.swapaxes(rotation, -1, -2) @ target
    axes = ((2, 1), (0, 2), (1, 0))
    return 0.5 * xp.stack([turn[..., i, j] - turn[..., j, i] for i, j in axes], axis=-1)


class ExpertError(InputError):
    """A waypoint that cannot be met; the message names it, the best errors and the limits."""


class Expert:
    """Solver for one arm, in one pipe or in open space."""

    def __init__(self, spec: ArmSpec, s2r: S2R | None = None, pipe: CrossPipe | None = None):
        self.spec, self.pipe = spec, pipe
        self._limits_kpa = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
        springs = spec.springs
        self._lengths_m = tuple(map(spec.at_springs, (springs.length_min_m, springs.length_max_m)))
        arm = {"params": ArmParams.from_spec(spec), "s2r": s2r}
        self._look = functools.partial(xla.jit(self._postures), **arm)
        self._solve = functools.partial(xla.jit(self._solutions), **arm)
        self._rng = np.random.default_rng(0)
        pool = self.look(random_pressures(spec, N_POOL, self._rng))
        self._pool = jax.tree.map(lambda x: x[self._slack(pool).min(axis=-1) >= 0.0], pool)

    def _posture(self, pressure_kpa: Array, params: ArmParams, s2r: S2R | None) -> tuple[Posture, Array]:
        """Return a posture, and the clearance (k,) [m] of each point of the body; differentiable."""
        with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
            settled = settle_pressures(params.without_pressure_limits(), pressure_kpa)
            frames = chain_kinematics(params)(settled.q)
            plates = frames.plate_position, frames.plate_rotation
            pose = pose_from_frame(frames.tip_position, frames.tip_rotation)
            if s2r is not None:
                pose = correct(s2r, pose, settled.spring_m)
                plates = carry_body(*plates, pose)
            position_m, rotation = frame_from_pose(pose)
        body_m = body_points(*plates, self.spec)
        wall_m = jnp.full(1, _NO_WALL_M) if self.pipe is None else clearance(self.pipe, body_m)
        return Posture(
            pressure_kpa=pressure_kpa,
            spring_m=settled.spring_m,
            pose=pose,
            finger_m=position_m - self.spec.mass.gripper_length_m * rotation[:, 2],
            rotation=rotation,
            clearance_m=jnp.min(wall_m),
            residual=settled.residual,
        ), wall_m

    def _postures(self, pressure_kpa: Array, params: ArmParams, s2r: S2R | None) -> Posture:
        """Return the postures (n,) at pressures (n, n_chambers)."""
        return jax.vmap(lambda p: self._posture(p, params, s2r)[0])(pressure_kpa)

    def _solutions(
        self, starts_kpa: Array, target: PostureTarget, params: ArmParams, s2r: S2R | None
    ) -> Array:
        """Return pressures (n, n_chambers) after damped Gauss-Newton steps from each of n starts."""

        def errors(pressure_kpa: Array) -> tuple[Array, Array]:
            error = self._errors(*self._posture(pressure_kpa, params, s2r), target)
            return error, error

        def model(pressure_kpa: Array) -> tuple[Array, Array]:
            jacobian, error = jax.jacfwd(errors, has_aux=True)(pressure_kpa)
            return error, jacobian

        def step(_, state: Sequence[Array]):
            # Keep the trial where it is better, and then trust the linear model more.
            trial, *best, damping = state
            tried = (trial, *model(trial))
            better = jnp.sum(tried[1] ** 2) < jnp.sum(best[1] ** 2)  # false where the trial is NaN
            best = [jnp.where(better, new, old) for new, old in zip(tried, best, strict=True)]
            damping = jnp.clip(damping * jnp.where(better, 0.2, 10.0), 1e-6, 1e6)
            # Take the damped Gauss-Newton step from the best pressures so far.
            pressure, error, jacobian = best
            hessian = jacobian.T @ jacobian
            descent = jnp.linalg.solve(hessian + damping * jnp.diag(jnp.diag(hessian)), jacobian.T @ error)
            return jnp.clip(pressure - descent, *self._limits_kpa), *best, damping

        def solve(start: Array) -> Array:
            error, jacobian = jax.eval_shape(model, start)
            nothing = jnp.full(error.shape, jnp.inf), jnp.zeros(jacobian.shape)
            return jax.lax.fori_loop(0, N_STEPS, step, (start, start, *nothing, jnp.float32(0.05)))[1]

        return jax.vmap(solve)(starts_kpa)

    def _errors(self, now: Posture, wall_m: Array, target: PostureTarget) -> Array:
        """Return the errors of a posture, each in its unit; limits count where they are violated."""
        (low, high), (shortest, longest) = self._limits_kpa, self._lengths_m
        real_kpa = now.pressure_kpa + target.bias_kpa
        room_kpa = jnp.concatenate([real_kpa - low, high - real_kpa])
        room_m = jnp.concatenate([now.spring_m - shortest, longest - now.spring_m])
        within = [
            (room_kpa - MARGIN_KPA) / _LIMIT_KPA,
            (room_kpa - COMFORT_KPA) / _COMFORT_KPA,
            (room_m - SPRING_MARGIN_M) / _LIMIT_M,
            (wall_m - MARGIN_M) / _LIMIT_M,
            (wall_m - COMFORT_M) / _COMFORT_M,
        ]
        return jnp.concatenate(
            [
                (now.finger_m - target.finger_m) / _POSITION_M,
                target.turn * angle_between(now.rotation, target.rotation) / _TURN_RAD,
                *(jnp.minimum(value, 0.0) for value in within),
                (now.pressure_kpa - target.near_kpa) / _NEAR_KPA,
            ]
        )

    def look(self, pressure_kpa: np.ndarray) -> Posture:
        """Return the postures (n,) at pressures (n, n_chambers)."""
        return xla.in_batches(self._look, _BATCH, pressure_kpa)

    def plan(self, waypoints: Sequence[Waypoint]) -> Posture:
        """Return postures (n,) at waypoints, each near its predecessor; see `reach`."""
        postures, before = [], np.zeros(self.spec.n_chambers)
        for waypoint in waypoints:
            postures.append(self.reach(waypoint.name, self.target(waypoint), before))
            before = postures[-1].pressure_kpa
        return jax.tree.map(lambda *x: np.stack(x), *postures)

    def target(self, waypoint: Waypoint) -> PostureTarget:
        """Return the target of a waypoint, for the arm as simulated."""
        zero = np.zeros(self.spec.n_chambers)
        return PostureTarget(np.asarray(waypoint.finger_m), np.eye(3), np.array(waypoint.turn), zero, zero)

    def reach(self, name: str, target: PostureTarget, before_kpa: np.ndarray) -> Posture:
        """Return the posture that meets a target, near the one at `before_kpa` (n_chambers,).

        Raises ExpertError if there is none; `name` is in its message.
        """
        target = jax.tree.map(np.float32, target._replace(near_kpa=before_kpa))
        starts = np.float32(self._starts(target))
        # Solve from all starts. If no solution meets the target, ease the orientation and solve again.
        for weight in (1.0, EASED) if target.turn.any() else (1.0,):
            eased = target._replace(turn=np.float32(weight) * target.turn)
            postures = self.look(np.asarray(self._solve(starts, eased)))
            slack = self._slack(postures, eased)
            met = np.flatnonzero((slack >= 0.0).all(axis=-1))
            if len(met):
                break
        else:
            raise ExpertError(self._why(name, target, postures, slack))
        # Of the solutions, take those with the clearest path, and of these the nearest.
        way = [postures.pressure_kpa[met] * share + before_kpa * (1.0 - share) for share in WAY]
        clear_m = self.look(np.concatenate(way)).clearance_m.reshape(len(WAY), -1).min(axis=0)
        far_kpa = np.linalg.norm(postures.pressure_kpa[met] - before_kpa, axis=-1)
        best = met[np.lexsort([far_kpa, -np.minimum(clear_m, WAY_CLEAR_M)])[0]]
        return jax.tree.map(lambda x: x[best], postures)

    def _starts(self, target: PostureTarget) -> np.ndarray:
        """Return pressures (N_STARTS, n_chambers): around the previous posture, and from the pool."""
        low, high = self._limits_kpa
        jitter = JITTER_KPA * self._rng.standard_normal((N_JITTERED, len(target.near_kpa)))
        jitter[0] = 0.0
        near = np.clip(target.near_kpa + jitter, low, high)
        off_m = np.linalg.norm(self._pool.finger_m - target.finger_m, axis=-1)
        far = np.linalg.norm(self._pool.pressure_kpa - target.near_kpa, axis=-1) / (high - low)
        chosen = np.argsort(off_m + 0.02 * far)[: N_STARTS - N_JITTERED]
        return np.concatenate([near, self._pool.pressure_kpa[chosen]])

    def _room_kpa(self, postures: Posture, target: PostureTarget) -> np.ndarray:
        """Return the distance (n, n_chambers) of the real arm's pressures to the nearest limit."""
        (low, high), real_kpa = self._limits_kpa, postures.pressure_kpa + target.bias_kpa
        return np.minimum(real_kpa - low, high - real_kpa)

    def _slack(self, postures: Posture, target: PostureTarget | None = None) -> np.ndarray:
        """Return the slack (n, demands) of each demand, in units of its tolerance.

        Demands are equilibrium and clearance and, with a target, pressures, springs, position, orientation.
        """
        shortest, longest = self._lengths_m
        margin_m = np.minimum(postures.spring_m - shortest, longest - postures.spring_m)
        clearance = postures.clearance_m / MARGIN_M - LIMIT_SHARE
        demands = [1.0 - postures.residual / RESIDUAL_TOLERANCE, clearance]
        if target is not None:
            off_m, turn_rad = _off(postures, target)
            demands += [
                self._room_kpa(postures, target).min(axis=-1) / MARGIN_KPA - LIMIT_SHARE,
                margin_m.min(axis=-1) / SPRING_MARGIN_M - LIMIT_SHARE,
                1.0 - off_m / TOLERANCE_M,
                1.0 - turn_rad / TOLERANCE_RAD,
            ]
        return np.nan_to_num(np.stack(demands, axis=-1), nan=-np.inf)

    def _why(self, name: str, target: PostureTarget, postures: Posture, slack: np.ndarray) -> str:
        """Return the message of an error: the best solution, and what was expected of it."""
        best = int(np.argmax(np.minimum(slack, 0.0).sum(axis=-1)))
        off_m, turn_rad = (value[best] for value in _off(postures, target))
        low, high = self._limits_kpa
        chamber = int(np.argmin(self._room_kpa(postures, target)[best]))
        kpa = (postures.pressure_kpa[best] + target.bias_kpa)[chamber]
        finger = ", ".join(f"{1e3 * value:.0f}" for value in target.finger_m)
        turned = f" and turned by {np.degrees(turn_rad):.1f} deg" if target.turn.any() else ""
        wall = "" if self.pipe is None else f", {1e3 * postures.clearance_m[best]:.1f} mm from the wall"
        expected = f", {np.degrees(TOLERANCE_RAD / EASED):.1f} deg" if target.turn.any() else ""
        expected += "" if self.pipe is None else f", {1e3 * MARGIN_M:g} mm from the wall"
        return (
            f"waypoint {name!r} at {finger} mm: got at best "
            f"{1e3 * off_m:.1f} mm off{turned}{wall}, chamber {chamber} at {kpa:.1f} kPa; expected "
            f"at most {1e3 * TOLERANCE_M:g} mm{expected}, {low + MARGIN_KPA:g} to {high - MARGIN_KPA:g} kPa"
        )


def _off(postures: Posture, target: PostureTarget) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of the finger tips (n,) [m] and of the gripper's orientation (n,) [rad]."""
    angle = target.turn * angle_between(postures.rotation, target.rotation)
    return np.linalg.norm(postures.finger_m - target.finger_m, axis=-1), np.linalg.norm(angle, axis=-1)
