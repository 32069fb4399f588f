"""Postures of an arm at rest, and the least-squares problem that finds the pressures of one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm._support.xp import array_namespace
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.pipe import CrossPipe, body_points, clearance
from mjx_softarm.mechanics.settle import settle_pressures
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_frame
from mjx_softarm.sensing.s2r import S2R, carry_body, correct
from mjx_softarm.spec import ArmSpec

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


def _posture(pressure_kpa: Array, params: ArmParams, s2r: S2R | None, spec: ArmSpec, pipe: CrossPipe | None):
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
    wall_m = jnp.full(1, _NO_WALL_M) if pipe is None else clearance(pipe, body_points(*plates, spec))
    return Posture(
        pressure_kpa=pressure_kpa,
        spring_m=settled.spring_m,
        pose=pose,
        finger_m=position_m - spec.mass.gripper_length_m * rotation[:, 2],
        rotation=rotation,
        clearance_m=jnp.min(wall_m),
        residual=settled.residual,
    ), wall_m


@xla.jit_at_first_call(static_argnames=("spec", "pipe"))
def look_many(
    pressure_kpa: Array, params: ArmParams, s2r: S2R | None, spec: ArmSpec, pipe: CrossPipe | None
) -> Posture:
    """Return the postures (n,) at pressures (n, n_chambers)."""
    return jax.vmap(lambda p: _posture(p, params, s2r, spec, pipe)[0])(pressure_kpa)


@xla.jit_at_first_call(static_argnames=("spec", "pipe"))
def solve_many(
    starts_kpa: Array,
    target: PostureTarget,
    params: ArmParams,
    s2r: S2R | None,
    spec: ArmSpec,
    pipe: CrossPipe | None,
) -> Array:
    """Return pressures (n, n_chambers) after damped Gauss-Newton steps from each of n starts."""
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa

    def errors(pressure_kpa: Array) -> tuple[Array, Array]:
        error = _errors(_posture(pressure_kpa, params, s2r, spec, pipe), target, spec)
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
        return jnp.clip(pressure - descent, low, high), *best, damping

    def solve(start):
        error, jacobian = jax.eval_shape(model, start)
        nothing = jnp.full(error.shape, jnp.inf), jnp.zeros(jacobian.shape)
        return jax.lax.fori_loop(0, N_STEPS, step, (start, start, *nothing, jnp.float32(0.05)))[1]

    return jax.vmap(solve)(starts_kpa)


def _errors(posture: tuple[Posture, Array], target: PostureTarget, spec: ArmSpec) -> Array:
    """Return the errors of a posture, each in its unit; limits count where they are violated."""
    now, wall_m = posture
    chambers = spec.chambers
    shortest, longest = map(spec.at_springs, (spec.springs.length_min_m, spec.springs.length_max_m))
    real_kpa = now.pressure_kpa + target.bias_kpa
    room_kpa = jnp.concatenate([real_kpa - chambers.pressure_min_kpa, chambers.pressure_max_kpa - real_kpa])
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


def angle_between(rotation: Any, target: Any) -> Any:
    """Return sines (..., 3) of the turn from rotations (..., 3, 3) to a target (3, 3), in gripper axes."""
    xp = array_namespace(rotation)
    turn = xp.swapaxes(rotation, -1, -2) @ target
    axes = ((2, 1), (0, 2), (1, 0))
    return 0.5 * xp.stack([turn[..., i, j] - turn[..., j, i] for i, j in axes], axis=-1)
