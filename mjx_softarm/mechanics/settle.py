"""The quasi-static arm: spring references or pressures -> equilibrium under the sensor-space law.

The law of `mjx_softarm.control` has integral action, so at rest each chamber has closed its error or is at a
pressure limit. With the potential V of `mjx_softarm.mechanics.statics` and the errors e of
`mjx_softarm.mechanics.newton`, rest is

    grad V(q; p) = 0,    e_t(q, p) = 0  or  p_t = limit   for every chamber t,

solved by Newton's method on the active set: chambers whose p + c e leaves the limits are held there, the
others track, and one linear system gives the step in q and p together.

An arm that would buckle at constant pressures may stand under the law, whose proportional gain answers to a
spring's error at once. Where V is not convex, this gain takes part as springs about the references.

Source: primal-dual active set as semismooth Newton, Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import zero_from_primal

from mjx_softarm._support import xla
from mjx_softarm._support.errors import Result
from mjx_softarm.mechanics.contact import is_jammed
from mjx_softarm.mechanics.implicit import Equilibrium, PressureResponse, equilibrium_tangents
from mjx_softarm.mechanics.kinematics import DOFS_PER_LINK, Kinematics
from mjx_softarm.mechanics.newton import End, Iterate, law_errors, newton_pass
from mjx_softarm.mechanics.params import ArmParams

RESIDUAL_TOLERANCE = 2e-3  # [N, N m], against stiffnesses of 2 N m/rad and more
TRACKING_TOLERANCE_M = 1e-4
ARMS_IN_CACHE, CACHED_DOFS = 128, 36  # arms whose numbers a CPU's cache holds, and their joint coordinates
ARMS_IN_VECTOR = 16  # arms that one CPU instruction serves


class SettleResult(Result):
    """Results of `settle`."""

    CONVERGED = 0, "forces balance, and every spring is at its reference or its chamber at a limit"
    OUT_OF_ITERATIONS = 1, "forces or springs are off by more than the tolerance after the last iteration"
    NOT_CONVEX = (
        2,
        "its energy is not convex there, so it buckles or is stuck beyond an edge of a wall, or its springs "
        "do not follow its chambers",
    )
    NOT_FINITE = 3, "a force or a length is not a finite number"
    UNBALANCED = 4, "MJX's own forces do not balance at the equilibrium of the closed form"


class Settled(NamedTuple):
    """Equilibrium of an arm, or the last iterate where `result` is not `CONVERGED`."""

    q: Array  # (nv,) joint coordinates [m, rad, rad]
    pressure_kpa: Array  # (n_chambers,)
    spring_m: Array  # (n_springs,) spring lengths
    tip_position_m: Array  # (3,)
    tip_rotation: Array  # (3, 3)
    at_limit: Array  # (n_chambers,) bool, held at a pressure limit
    residual: Array  # () largest entry of grad V [N, N m]
    tracking_error_m: Array  # () largest error e of a chamber that is not at a limit
    result: Array  # () int32, a `SettleResult`
    iterations: Array  # () int

    @property
    def settled(self) -> Array:
        """() bool, converged: residual and tracking error are finite and below tolerance."""
        return self.result == SettleResult.CONVERGED.value


_Solution = tuple[Settled, Equilibrium]


def arms_at_once(n_links: int) -> int | None:
    """Return how many arms of `n_links` links to settle at once on this machine; None is all of them.

    Call this where a program is built, since traced code should not ask for the machine.
    """
    if jax.default_backend() != "cpu":
        return None
    in_cache = ARMS_IN_CACHE * min(1.0, (CACHED_DOFS / (DOFS_PER_LINK * n_links)) ** 2)
    return ARMS_IN_VECTOR * max(1, round(in_cache / ARMS_IN_VECTOR))


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def settle(
    kinematics: Kinematics, params: ArmParams, reference_m: Array, n_at_once: int | None = None
) -> Settled:
    """Find the equilibrium under the sensor-space law, starting from the straight arm.

    Joint coordinates, pressures, springs and tip are differentiable in all arguments, forward and in reverse,
    by the implicit function theorem at the final active set (see `mjx_softarm.mechanics.implicit`). The other
    fields have a zero derivative. An arm that did not settle has a zero derivative in every field.

    Args:
        kinematics: of either engine, `chain_kinematics(params)` or `MjxKinematics(model)`.
        params: numbers of the arm.
        reference_m (n_springs,): spring lengths that the law tracks.
        n_at_once: arms of a `jax.vmap` that settle at once, from `arms_at_once`; None is all of them.
    """
    return _solver(1, n_at_once)(kinematics, params, reference_m)[0]


def _settle_jvp(n_at_once: int | None, primals: tuple, tangents: tuple) -> tuple[Settled, Settled]:
    # A second small step brings the response, which is that before the last step, up to date
    found, end = _solver(2, n_at_once)(*primals)
    with jax.default_matmul_precision("highest"):
        change = equilibrium_tangents(primals, tangents, end, found.settled)
    none = Settled(*(zero_from_primal(field, symbolic_zeros=True) for field in found))
    return found, none._replace(**change._asdict())


settle.defjvp(_settle_jvp, symbolic_zeros=True)


def settle_pressures(
    kinematics: Kinematics, params: ArmParams, pressure_kpa: Array, n_at_once: int | None = None
) -> Settled:
    """Find the equilibrium at given pressures (n_chambers,), clipped to the arm's limits.

    The pressures become limits that leave no room, so this is `settle`, derivatives included.
    """
    pressure = jnp.clip(pressure_kpa, params.pressure_min_kpa, params.pressure_max_kpa)
    pinned = params._replace(pressure_min_kpa=pressure, pressure_max_kpa=pressure)
    return settle(kinematics, pinned, params.spring_rest_m, n_at_once)


@functools.cache
def _solver(n_small: int, n_at_once: int | None) -> Callable[..., _Solution]:
    """Return `_solve` for one arm; `jax.vmap` of it puts the arms last, in chunks of `n_at_once`."""
    solve = jax.custom_batching.custom_vmap(functools.partial(_solve, n_small))

    def many(n: int, batched: list[Any], *arguments: Any) -> tuple[Any, Any]:
        if n_at_once and n_at_once < n:
            found = xla.in_chunks(solve, n, -(-n // n_at_once), batched, arguments)
        else:
            found = _solve_arms_last(n_small, n, batched, *arguments)
        return found, jax.tree.map(lambda _: True, found)

    solve.def_vmap(many)
    return solve


def _solve_arms_last(
    n_small: int, n: int, batched: list[Any], kinematics: Kinematics, params: ArmParams, reference_m: Array
) -> _Solution:
    """Return the solutions of n arms; `batched` is true for arrays that have the arms as first axis."""

    def arms_last(x: Any, own: bool) -> Array:
        return jnp.moveaxis(x, 0, -1) if own else jnp.asarray(x)[..., None]

    kinematics_own, params_own, reference_own = batched
    if kinematics.arms_last:
        kinematics = jax.tree.map(arms_last, kinematics, kinematics_own)
    else:
        axes = jax.tree.map(lambda own: 0 if own else None, kinematics_own)
        each = jax.vmap(lambda engine, q: engine(q), in_axes=(axes, -1), out_axes=-1)
        kinematics = jax.tree_util.Partial(each, kinematics)  # pyright: ignore[reportAssignmentType]
    reference_m = jnp.broadcast_to(arms_last(reference_m, reference_own), (reference_m.shape[-1], n))
    found = _solve(n_small, kinematics, jax.tree.map(arms_last, params, params_own), reference_m)
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), found)


def _solve(n_small: int, kinematics: Kinematics, params: ArmParams, reference_m: Array) -> _Solution:
    """Return the equilibrium after `n_small` small steps and all that its derivative needs; arms are last."""
    # Start: the straight arm, its pressures as close to zero as the limits allow
    dtype, arms = params.link_length_m.dtype, reference_m.shape[1:]
    nv, n_chambers = params.link_mass_kg.shape[0] * DOFS_PER_LINK, params.area.shape[0]
    zeros = functools.partial(jnp.zeros, dtype=dtype)
    start = Iterate(
        q=zeros((nv, *arms)),
        pressure=jnp.clip(zeros((n_chambers, *arms)), params.pressure_min_kpa, params.pressure_max_kpa),
        at_limit=jnp.zeros((n_chambers, *arms), bool),
        response=PressureResponse(zeros((nv, n_chambers, *arms)), zeros((n_chambers, n_chambers, *arms))),
        n_small=jnp.zeros(arms, int),
        held=jnp.zeros(arms, bool),
        stiffening=jnp.zeros(arms, dtype),
        convex=jnp.ones(arms, bool),
        iteration=jnp.zeros(arms, int),
    )

    # Iterate until no arm goes on, and once more: the last pass evaluates all arms where they have ended. A
    # second program for the end would take as long to compile as the loop
    one_pass = functools.partial(newton_pass, jnp.asarray(n_small), kinematics, params, reference_m)
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        shapes = jax.eval_shape(one_pass, start)[1]
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        _, it, end = jax.lax.while_loop(
            lambda loop: loop[0],
            lambda loop: (jnp.any(loop[1].goes_on(n_small, params)), *one_pass(loop[1])),
            (jnp.array(True), start, nothing),
        )
        return _report(it, end, params, reference_m)


def _report(it: Iterate, end: End, params: ArmParams, reference_m: Array) -> _Solution:
    """Return the last iterate as an equilibrium, with its errors and its result."""
    pressure, frames, here, by_law = end
    residual = jnp.max(jnp.abs(here.gradient), axis=0)

    # Errors of the law: at a limit, only an error counts that would take the chamber away from it
    error = law_errors(reference_m - here.springs.length, pressure, params.allocation)
    at_limit = (pressure <= params.pressure_min_kpa) | (pressure >= params.pressure_max_kpa)
    outward = jnp.where(pressure >= params.pressure_max_kpa, error, -error)
    off = jnp.where(at_limit, jnp.maximum(-outward, 0.0), jnp.abs(error))
    tracking = jnp.max(jnp.where(params.pinned, 0.0, off), axis=0)

    # Result, and all fields of the equilibrium; forces balance in an arm that is about to buckle, too
    convex = it.convex if params.contact is None else it.convex & ~is_jammed(params.contact, frames)
    good = (residual < RESIDUAL_TOLERANCE) & (tracking < TRACKING_TOLERANCE_M) & convex
    numbers = here.gradient, error, params.law_stiffness
    finite = functools.reduce(jnp.logical_and, (jnp.all(jnp.isfinite(x), axis=0) for x in numbers))
    result = jnp.select(
        [~finite, good, ~convex],
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
    return found, Equilibrium(it.q, pressure, at_limit, frames, here, it.response, by_law)
