"""The quasi-static arm: spring references or pressures -> equilibrium under the sensor-space law.

The law of `mjx_softarm.control` has integral action, so at rest each chamber either holds its spring at
the reference or sits at a pressure limit. With V the potential of `mjx_softarm.mechanics.statics`, rest is

    grad V(q; p) = 0,    s_t(q) = reference_t  or  p_t = limit   for every chamber t,

a nonlinear complementarity problem in (q, p), solved by Newton's method on the active set: the chambers
whose p + c (reference - s) leaves the limits are held there, the others track, and one linear
system gives the step in q and p together.

Source: primal-dual active set as semismooth Newton, Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support.small_matrices import block_diagonal, eliminate, product
from mjx_softarm.mechanics.kinematics import DOFS_PER_LINK, Frames
from mjx_softarm.mechanics.statics import ArmParams, Statics, statics

MAX_ITERATIONS = 12
ACTIVE_SET_GAIN_KPA_PER_M = 1000.0
MAX_STEP = 0.5  # largest entry of a Newton step [m, rad]
SMALL_STEP = 3e-4  # [m, rad]; the next error is of its square
RESIDUAL_TOLERANCE = 2e-3  # [N, N m], against stiffnesses of 2 N m/rad and more
TRACKING_TOLERANCE_M = 1e-4


class Settled(NamedTuple):
    """An arm at rest, or the best that was found."""

    q: Array  # (nv,) joint coordinates [m, rad, rad]
    pressure_kpa: Array  # (n_chambers,)
    spring_m: Array  # (n_chambers,) spring lengths
    tip_position_m: Array  # (3,)
    tip_rotation: Array  # (3, 3)
    at_limit: Array  # (n_chambers,) bool, held at a pressure limit
    residual: Array  # () largest entry of grad V [N, N m]
    tracking_error_m: Array  # () largest spring error of a chamber that is not at a limit
    settled: Array  # () bool, both below tolerance and everything finite
    iterations: Array  # () int


class _Iterate(NamedTuple):
    q: Array
    pressure: Array
    at_limit: Array
    moving: Array
    stiffening: Array  # () of the joints, in their own stiffness, where the arm would buckle
    iteration: Array


def settle(kinematics: Callable[[Array], Frames], params: ArmParams, reference_m: Array) -> Settled:
    """Equilibrium under the sensor-space law, started from the straight arm.

    Args:
        kinematics: joint coordinates (nv,) -> Frames, of either engine.
        params: numbers of the arm.
        reference_m (n_chambers,): spring lengths that the law tracks.
    """
    dtype = params.link_length_m.dtype
    n_links = params.link_mass_kg.shape[0]
    start = _Iterate(
        q=jnp.zeros(n_links * DOFS_PER_LINK, dtype),
        pressure=jnp.clip(jnp.zeros_like(params.area), params.pressure_min_kpa, params.pressure_max_kpa),
        at_limit=jnp.zeros(params.area.shape, bool),
        moving=jnp.array(True),
        stiffening=jnp.zeros((), dtype),
        iteration=jnp.array(0),
    )
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        end = jax.lax.while_loop(
            lambda it: it.moving & (it.iteration < MAX_ITERATIONS),
            lambda it: _newton_step(it, kinematics, params, reference_m),
            start,
        )
        return _report(end, kinematics, params, reference_m)


def settle_pressures(
    kinematics: Callable[[Array], Frames], params: ArmParams, pressure_kpa: Array
) -> Settled:
    """Equilibrium at given pressures (n_chambers,), clipped to the arm's limits."""
    pressure = jnp.clip(pressure_kpa, params.pressure_min_kpa, params.pressure_max_kpa)
    pinned = params._replace(pressure_min_kpa=pressure, pressure_max_kpa=pressure)
    return settle(kinematics, pinned, params.spring_rest_m)


def _active_set(pressure: Array, error_m: Array, params: ArmParams) -> tuple[Array, Array]:
    """Which chambers sit at a limit (n,), and the limit they sit at [kPa]."""
    trial = pressure + ACTIVE_SET_GAIN_KPA_PER_M * error_m
    limit = jnp.clip(trial, params.pressure_min_kpa, params.pressure_max_kpa)
    pinned = params.pressure_min_kpa == params.pressure_max_kpa  # even where the error happens to be zero
    return (trial != limit) | pinned, limit


def _newton_step(it: _Iterate, kinematics, params: ArmParams, reference_m: Array) -> _Iterate:
    now: Statics = statics(kinematics(it.q), it.q, it.pressure, params)
    error = reference_m - now.springs.length
    at_limit, limit = _active_set(it.pressure, error, params)
    hessian = now.hessian.plus_diagonal(it.stiffening * params.joint_stiffness)
    n_sections, n_chambers = params.n_sections, reference_m.shape[0]
    push = now.chambers.jacobian * now.area.reshape(n_sections, -1, 1)  # force per kPa
    columns = block_diagonal(jnp.swapaxes(push, 1, 2)).reshape(n_sections, -1, n_chambers)
    solved = hessian.solve(jnp.concatenate([now.gradient.reshape(n_sections, -1, 1), columns], axis=-1))
    fall, gain = solved[..., 0], solved[..., 1:]  # dq = gain dp - fall
    moved = product(now.springs.jacobian, solved).reshape(n_chambers, -1)
    track = moved[:, 1:]  # (n, n) spring lengths per kPa
    rows = jnp.where(at_limit[:, None], jnp.eye(n_chambers, dtype=track.dtype), track)
    wanted = jnp.where(at_limit, limit - it.pressure, error + moved[:, 0])
    dp = eliminate(rows, wanted[:, None])[:, 0]
    dq = (jnp.sum(gain * dp, axis=-1) - fall).reshape(-1)
    largest = jnp.max(jnp.abs(dq))
    scale = jnp.minimum(1.0, MAX_STEP / largest)
    same = jnp.all(at_limit == it.at_limit)
    # No step where the energy is not convex, or springs do not follow chambers: stay, stiffen the joints.
    convex = jnp.isfinite(largest)
    return _Iterate(
        q=jax.lax.select(convex, it.q + scale * dq, it.q),
        pressure=jax.lax.select(convex, it.pressure + scale * dp, it.pressure),
        at_limit=at_limit,
        moving=~(same & (largest < SMALL_STEP) & (it.stiffening == 0)),
        stiffening=jnp.where(convex, 0.0, 4.0 * it.stiffening + 4.0),
        iteration=it.iteration + 1,
    )


def _report(it: _Iterate, kinematics, params: ArmParams, reference_m: Array) -> Settled:
    pressure = jnp.clip(it.pressure, params.pressure_min_kpa, params.pressure_max_kpa)
    frames = kinematics(it.q)
    now: Statics = statics(frames, it.q, pressure, params)
    error = reference_m - now.springs.length
    at_limit = (pressure <= params.pressure_min_kpa) | (pressure >= params.pressure_max_kpa)
    residual = jnp.max(jnp.abs(now.gradient))
    outward = jnp.where(pressure >= params.pressure_max_kpa, error, -error)
    pinned = params.pressure_min_kpa == params.pressure_max_kpa
    off = jnp.where(pinned, 0.0, jnp.where(at_limit, jnp.maximum(-outward, 0.0), jnp.abs(error)))
    tracking = jnp.max(off)
    return Settled(
        q=it.q,
        pressure_kpa=pressure,
        spring_m=now.springs.length,
        tip_position_m=frames.plate_position[-1],
        tip_rotation=frames.plate_rotation[-1],
        at_limit=at_limit,
        residual=residual,
        tracking_error_m=tracking,
        settled=(residual < RESIDUAL_TOLERANCE) & (tracking < TRACKING_TOLERANCE_M),
        iterations=it.iteration,
    )
