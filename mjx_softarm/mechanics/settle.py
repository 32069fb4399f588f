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

import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import zero_from_primal

from mjx_softarm._support.small_matrices import eliminate, product
from mjx_softarm.mechanics.implicit import Equilibrium, Response, equilibrium_tangents
from mjx_softarm.mechanics.kinematics import DOFS_PER_LINK, Kinematics
from mjx_softarm.mechanics.statics import ArmParams, statics

MAX_ITERATIONS = 12
ACTIVE_SET_GAIN_KPA_PER_M = 1000.0
MAX_STEP = 0.5  # largest entry of a Newton step [m, rad]
SMALL_STEP = 3e-4  # [m, rad]; the next error is of its square
RESIDUAL_TOLERANCE = 2e-3  # [N, N m], against stiffnesses of 2 N m/rad and more
TRACKING_TOLERANCE_M = 1e-4


class Result(enum.IntEnum):
    """A code of how a simulation ended, an int32 in arrays, with a text for messages."""

    text: str

    def __new__(cls, code: int, text: str) -> Result:
        member = int.__new__(cls, code)
        member._value_ = code
        member.text = text
        return member


class SettleResult(Result):
    """Results of `settle`."""

    CONVERGED = 0, "forces balance, and every spring is at its reference or its chamber at a limit"
    OUT_OF_ITERATIONS = (
        1,
        "forces or springs are off by more than the tolerance after the last iteration",
    )
    NOT_CONVEX = 2, "its energy is not convex there, so it buckles, or its springs do not follow its chambers"
    NOT_FINITE = 3, "a force or a length is not a finite number"


class Settled(NamedTuple):
    """An arm at rest, or the last iterate where `result` says that none was found."""

    q: Array  # (nv,) joint coordinates [m, rad, rad]
    pressure_kpa: Array  # (n_chambers,)
    spring_m: Array  # (n_chambers,) spring lengths
    tip_position_m: Array  # (3,)
    tip_rotation: Array  # (3, 3)
    at_limit: Array  # (n_chambers,) bool, held at a pressure limit
    residual: Array  # () largest entry of grad V [N, N m]
    tracking_error_m: Array  # () largest spring error of a chamber that is not at a limit
    result: Array  # () int32, a `SettleResult`
    iterations: Array  # () int

    @property
    def settled(self) -> Array:
        """() bool, converged: residual and tracking error are finite and below tolerance."""
        return self.result == SettleResult.CONVERGED.value


class _Iterate(NamedTuple):
    q: Array  # (nv,)
    pressure: Array  # (n_chambers,) [kPa]
    at_limit: Array  # (n_chambers,) bool, the active set of the last step
    response: Response  # before the last step
    n_small: Array  # () int, small steps without a change of the active set, since the last other one
    stiffening: Array  # () joint stiffness added, in parts of it, where the energy is not convex
    iteration: Array  # ()


@jax.custom_jvp
def settle(kinematics: Kinematics, params: ArmParams, reference_m: Array) -> Settled:
    """Find the equilibrium under the sensor-space law, starting from the straight arm.

    Joint coordinates, pressures, springs and tip are differentiable in all arguments, forward and in reverse,
    by the implicit function theorem at the final active set (see `mjx_softarm.mechanics.implicit`). The other
    fields have a zero derivative, and all fields have where the arm did not settle.

    Args:
        kinematics: of either engine, `chain_kinematics(params)` or `mjx_kinematics(model)`.
        params: numbers of the arm.
        reference_m (n_chambers,): spring lengths that the law tracks.
    """
    return _solve(kinematics, params, reference_m)[0]


def _settle_jvp(primals: tuple, tangents: tuple) -> tuple[Settled, Settled]:
    found, end = _solve(*primals, n_small=2)  # the second small step only brings the response up to date
    with jax.default_matmul_precision("highest"):
        change = equilibrium_tangents(primals, tangents, end, found.settled)
    none = Settled(*(zero_from_primal(field, symbolic_zeros=True) for field in found))
    return found, none._replace(**change._asdict())


settle.defjvp(_settle_jvp, symbolic_zeros=True)


def _solve(
    kinematics: Kinematics, params: ArmParams, reference_m: Array, n_small: int = 1
) -> tuple[Settled, Equilibrium]:
    """Return the equilibrium after `n_small` small steps, and all that its derivative needs."""
    dtype = params.link_length_m.dtype
    nv, n_chambers = params.link_mass_kg.shape[0] * DOFS_PER_LINK, params.area.shape[0]
    start = _Iterate(
        q=jnp.zeros(nv, dtype),
        pressure=jnp.clip(jnp.zeros_like(params.area), params.pressure_min_kpa, params.pressure_max_kpa),
        at_limit=jnp.zeros(params.area.shape, bool),
        response=Response(jnp.zeros((nv, n_chambers), dtype), jnp.zeros((n_chambers, n_chambers), dtype)),
        n_small=jnp.array(0),
        stiffening=jnp.zeros((), dtype),
        iteration=jnp.array(0),
    )
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        end = jax.lax.while_loop(
            lambda it: (it.n_small < n_small) & (it.iteration < MAX_ITERATIONS + n_small - 1),
            lambda it: _newton_step(it, kinematics, params, reference_m),
            start,
        )
        return _report(end, kinematics, params, reference_m)


def settle_pressures(kinematics: Kinematics, params: ArmParams, pressure_kpa: Array) -> Settled:
    """Find the equilibrium at given pressures (n_chambers,), clipped to the arm's limits.

    The pressures are limits that leave no room, so this is `settle`, derivatives included.
    """
    pressure = jnp.clip(pressure_kpa, params.pressure_min_kpa, params.pressure_max_kpa)
    pinned = params._replace(pressure_min_kpa=pressure, pressure_max_kpa=pressure)
    return settle(kinematics, pinned, params.spring_rest_m)


def _active_set(pressure: Array, error_m: Array, params: ArmParams) -> tuple[Array, Array]:
    """Return the chambers to be held at a limit (n,) bool, and each one's limit (n,) [kPa]."""
    trial = pressure + ACTIVE_SET_GAIN_KPA_PER_M * error_m
    limit = jnp.clip(trial, params.pressure_min_kpa, params.pressure_max_kpa)
    return (trial != limit) | params.pinned, limit  # pinned ones even where the error happens to be zero


def _newton_step(it: _Iterate, kinematics: Kinematics, params: ArmParams, reference_m: Array) -> _Iterate:
    # Forces, springs and the active set at the iterate
    here = statics(kinematics(it.q), it.q, it.pressure, params)
    error = reference_m - here.springs.length
    at_limit, limit = _active_set(it.pressure, error, params)

    # Joints: H dq = B dp - grad V, so that dq = newton_step + dq_dp dp
    hessian = here.hessian.plus_diagonal(it.stiffening * params.joint_stiffness)
    gradient = here.gradient.reshape(params.n_sections, -1, 1)
    solved = hessian.solve(jnp.concatenate([-gradient, here.push_per_kpa], axis=-1))
    newton_step, dq_dp = solved[..., 0], solved[..., 1:]

    # Pressures: each chamber closes its spring's error or goes to its limit
    spring_response = product(here.springs.jacobian, solved).reshape(len(error), -1)
    newton_spring, dspring_dp = spring_response[:, 0], spring_response[:, 1:]
    rows = jnp.where(at_limit[:, None], jnp.eye(len(error), dtype=dspring_dp.dtype), dspring_dp)
    residual = jax.lax.select(at_limit, limit - it.pressure, error - newton_spring)
    dp = eliminate(rows, residual[:, None])[:, 0]
    dq = (newton_step + jnp.sum(dq_dp * dp, axis=-1)).reshape(-1)

    # Step length; where the energy is not convex, or springs do not follow chambers: no step, stiffer joints
    largest = jnp.max(jnp.abs(dq))
    scale = jnp.minimum(1.0, MAX_STEP / largest)
    convex = jnp.all(jnp.isfinite(dq))  # XLA's maximum passes over some NaN, with jax 0.12 on a CPU
    small = jnp.all(at_limit == it.at_limit) & (largest < SMALL_STEP) & (it.stiffening == 0)
    return _Iterate(
        q=jax.lax.select(convex, it.q + scale * dq, it.q),
        pressure=jax.lax.select(convex, it.pressure + scale * dp, it.pressure),
        at_limit=at_limit,
        response=Response(dq_dp.reshape(-1, len(error)), dspring_dp),
        n_small=jnp.where(small, it.n_small + 1, 0),
        stiffening=jnp.where(convex, 0.0, 4.0 * it.stiffening + 4.0),
        iteration=it.iteration + 1,
    )


def _report(
    it: _Iterate, kinematics: Kinematics, params: ArmParams, reference_m: Array
) -> tuple[Settled, Equilibrium]:
    # Forces and springs at the end
    pressure = jnp.clip(it.pressure, params.pressure_min_kpa, params.pressure_max_kpa)
    frames = kinematics(it.q)
    here = statics(frames, it.q, pressure, params)
    residual = jnp.max(jnp.abs(here.gradient))

    # Errors of the law: of a chamber at a limit only those that would take it away from the limit
    error = reference_m - here.springs.length
    at_limit = (pressure <= params.pressure_min_kpa) | (pressure >= params.pressure_max_kpa)
    outward = jnp.where(pressure >= params.pressure_max_kpa, error, -error)
    off = jnp.where(at_limit, jnp.maximum(-outward, 0.0), jnp.abs(error))
    tracking = jnp.max(jnp.where(params.pinned, 0.0, off))

    good = (residual < RESIDUAL_TOLERANCE) & (tracking < TRACKING_TOLERANCE_M)
    finite = jnp.all(jnp.isfinite(here.gradient)) & jnp.all(jnp.isfinite(error))
    result = jnp.select(
        [~finite, good, it.stiffening > 0],
        [SettleResult.NOT_FINITE.value, SettleResult.CONVERGED.value, SettleResult.NOT_CONVEX.value],
        SettleResult.OUT_OF_ITERATIONS.value,
    )
    found = Settled(
        q=it.q,
        pressure_kpa=pressure,
        spring_m=here.springs.length,
        tip_position_m=frames.tip_position,
        tip_rotation=frames.tip_rotation,
        at_limit=at_limit,
        residual=residual,
        tracking_error_m=tracking,
        result=result.astype(jnp.int32),
        iterations=it.iteration,
    )
    return found, Equilibrium(it.q, pressure, at_limit, frames, here, it.response)
