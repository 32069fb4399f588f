"""The quasi-static arm: spring references or pressures -> equilibrium under the sensor-space law.

The law of `mjx_softarm.control` has integral action, so at rest each chamber has closed its error or is at a
pressure limit. With the potential V of `mjx_softarm.mechanics.statics` and the errors e, rest is

    grad V(q; p) = 0,    e_t(q, p) = 0  or  p_t = limit   for every chamber t,

solved by Newton's method on the active set: chambers whose p + c e leaves the limits are held there, the
others track, and one linear system gives the step in q and p together. Without an allocation, each chamber
closes the error of its spring, e = reference - s. Redundant chambers close
e = C (reference - s) - YIELD_M_PER_KPA N p, with the matrices C and N of `mjx_softarm.control`.

An arm that would buckle at constant pressures may stand under the law, whose proportional gain answers to a
spring's error at once. Where V is not convex, this gain takes part as springs about the references.

**Derivative.** By the implicit function theorem, with the arm's numbers x: as long as the set of chambers at
a limit stays, these equations differentiate to

    H dq = B dp - d_x grad V,    S dq = dreference - d_x s  or  dp = dlimit,

with H the Hessian of V, B the chambers' push per kPa and S the springs' Jacobian. With K = H^-1 B, and R with
the rows of S K where chambers track and of the identity where they are at a limit,

    dp = R^-1 r,    dq = K dp - H^-1 d_x grad V,    r = dreference - d_x s + S H^-1 d_x grad V  or  dlimit.

Where the law holds an arm that would buckle at constant pressures, V has the springs l (s - reference)^2 / 2
of the law's gain l as well, where chambers track. They are at rest, but the joints answer to them at once:

    dq = K dp + H^-1 S^T l (dreference - d_x s) - H^-1 d_x grad V,    with r less S times the last two terms.

Redundant chambers have C S in place of S, C (dreference - d_x s) in place of dreference - d_x s, and
C S K + YIELD_M_PER_KPA N in place of S K.

This is exact however many Newton steps led to the equilibrium. K comes from the last Newton step; only
derivatives by the arm's numbers need H^-1.

Source: primal-dual active set as semismooth Newton, Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero, zero_from_primal

from mjx_softarm._support import xla
from mjx_softarm._support.errors import Result
from mjx_softarm._support.small_matrices import eliminate, identity, product, products
from mjx_softarm.control import YIELD_M_PER_KPA, Allocation
from mjx_softarm.mechanics.kinematics import DOFS_PER_LINK, Frames, chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.statics import Statics, statics

MAX_ITERATIONS = 12
ACTIVE_SET_GAIN_KPA_PER_M = 1000.0  # c
MAX_STEP = 0.5  # largest entry of a Newton step [m, rad]
SMALL_STEP = 3e-4  # [m, rad]; Newton's method converges quadratically from here
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
        "its energy is not convex there, so it buckles, or its springs do not follow its chambers",
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


class PressureResponse(NamedTuple):
    """Response of joints and of the law's errors to the chambers' pressures, at the balance of forces."""

    dq_dp: Array  # (nv, n_chambers) [m/kPa, rad/kPa], K
    closed_per_kpa: Array  # (n_chambers, n_chambers) [m/kPa] decrease of each chamber's error, S K


class Evaluation(NamedTuple):
    """Forces and springs of all arms at an iterate."""

    pressure: Array  # (n_chambers, *arms) [kPa]
    frames: Frames
    statics: Statics
    law_response: Array  # (nv, n_springs, *arms) joints by references, in the last pass; zeros unless held


class Iterate(NamedTuple):
    """Numbers of all arms between two Newton steps."""

    q: Array  # (nv, *arms)
    pressure: Array  # (n_chambers, *arms) [kPa]
    at_limit: Array  # (n_chambers, *arms) bool, active set of the last step
    response: PressureResponse  # at the iterate before the last step
    n_small: Array  # (*arms,) int, number of small steps in a row with an unchanged active set
    held: Array  # (*arms,) bool, V has not been convex at some step: the law's gain takes part
    stiffening: Array  # (*arms,) added joint stiffness as a share of the arm's own, where V is not convex
    convex: Array  # (*arms,) bool, V was convex at the last step without added joint stiffness
    iteration: Array  # (*arms,) int

    def goes_on(self, n_small: Array | int) -> Array:
        """Return which arms have made fewer than `n_small` small steps in a row: (*arms,) bool."""
        return (self.n_small < n_small) & (self.iteration < MAX_ITERATIONS + n_small - 1)


_Solution = tuple[Settled, Evaluation, PressureResponse]


def arms_at_once(n_links: int) -> int | None:
    """Return how many arms of `n_links` links to settle at once on this machine; None is all of them.

    Call this where a program is built, since traced code should not ask for the machine.
    """
    if jax.default_backend() != "cpu":
        return None
    in_cache = ARMS_IN_CACHE * min(1.0, (CACHED_DOFS / (DOFS_PER_LINK * n_links)) ** 2)
    return ARMS_IN_VECTOR * max(1, round(in_cache / ARMS_IN_VECTOR))


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def settle(params: ArmParams, reference_m: Array, n_at_once: int | None = None) -> Settled:
    """Find the equilibrium under the sensor-space law, starting from the straight arm.

    Joint coordinates, pressures, springs and tip are differentiable in all arguments, forward and in reverse,
    by the implicit function theorem at the final active set. The other fields have a zero derivative, and all
    fields of an arm that did not settle.

    Args:
        params: numbers of the arm.
        reference_m (n_springs,): spring lengths that the law tracks.
        n_at_once: arms of a `jax.vmap` that settle at once, from `arms_at_once`; None is all of them.
    """
    return _solver(1, n_at_once)(reference_m, params)[0]


def _settle_jvp(n_at_once: int | None, primals: tuple, tangents: tuple) -> tuple[Settled, Settled]:
    # A second small step brings the response, which is that before the last step, up to date
    params, reference_m = primals
    solution = _solver(2, n_at_once)(reference_m, params)
    with jax.default_matmul_precision("highest"):
        return solution[0], _tangents(primals, tangents, *solution)


settle.defjvp(_settle_jvp, symbolic_zeros=True)


def settle_pressures(params: ArmParams, pressure_kpa: Array, n_at_once: int | None = None) -> Settled:
    """Find the equilibrium at given pressures (n_chambers,), clipped to the arm's limits.

    The pressures become limits that leave no room, so this is `settle`, derivatives included.
    """
    pressure = jnp.clip(pressure_kpa, params.pressure_min_kpa, params.pressure_max_kpa)
    pinned = params._replace(pressure_min_kpa=pressure, pressure_max_kpa=pressure)
    return settle(pinned, params.spring_rest_m, n_at_once)


@functools.cache
def _solver(n_small: int, n_at_once: int | None) -> Callable[..., _Solution]:
    """Return `_solve` for one arm; `jax.vmap` of it puts the arms last, in chunks of `n_at_once`."""
    return xla.rows_last(functools.partial(_solve, n_small), n_at_once)


def _solve(n_small: int, reference_m: Array, params: ArmParams) -> _Solution:
    """Return the equilibrium after `n_small` small steps and all that its derivative needs; arms are last."""
    # Start: the straight arm, its pressures as close to zero as the limits allow
    dtype = params.link_length_m.dtype
    arms = reference_m.shape[1:]
    nv = params.link_mass_kg.shape[0] * DOFS_PER_LINK
    n_chambers = params.area.shape[0]
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
    one_pass = functools.partial(_newton_pass, jnp.asarray(n_small), params, reference_m)
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        shapes = jax.eval_shape(one_pass, start)[1]
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        _, iterate, evaluation = jax.lax.while_loop(
            lambda loop: loop[0],
            lambda loop: (jnp.any(loop[1].goes_on(n_small)), *one_pass(loop[1])),
            (jnp.array(True), start, nothing),
        )
        return _report(iterate, evaluation, params, reference_m)


def _report(iterate: Iterate, evaluation: Evaluation, params: ArmParams, reference_m: Array) -> _Solution:
    """Return the last iterate as an equilibrium, with its errors and its result."""
    pressure, frames, potential, _ = evaluation
    residual = jnp.max(jnp.abs(potential.gradient), axis=0)

    # Errors of the law: at a limit, only an error counts that would take the chamber away from it
    error = _law_errors(reference_m - potential.springs.length, pressure, params.allocation)
    at_limit = (pressure <= params.pressure_min_kpa) | (pressure >= params.pressure_max_kpa)
    outward = jnp.where(pressure >= params.pressure_max_kpa, error, -error)
    off = jnp.where(at_limit, jnp.maximum(-outward, 0.0), jnp.abs(error))
    tracking = jnp.max(jnp.where(params.pinned, 0.0, off), axis=0)

    # Result, and all fields of the equilibrium; forces balance in an arm that is about to buckle, too
    good = (residual < RESIDUAL_TOLERANCE) & (tracking < TRACKING_TOLERANCE_M) & iterate.convex
    numbers = potential.gradient, error, params.law_stiffness
    finite = functools.reduce(jnp.logical_and, (jnp.all(jnp.isfinite(x), axis=0) for x in numbers))
    result = jnp.select(
        [~finite, good, ~iterate.convex],
        [SettleResult.NOT_FINITE.value, SettleResult.CONVERGED.value, SettleResult.NOT_CONVEX.value],
        SettleResult.OUT_OF_ITERATIONS.value,
    )
    settled = Settled(
        q=iterate.q,
        pressure_kpa=pressure,
        spring_m=potential.springs.length,
        tip_position_m=frames.tip_position,
        tip_rotation=frames.tip_rotation,
        at_limit=at_limit,
        residual=residual,
        tracking_error_m=tracking,
        result=result.astype(jnp.int32),
        iterations=iterate.iteration,
    )
    return settled, evaluation, iterate.response


@jax.jit  # traced once for the loop, the shapes of its results, and both values of n_small
def _newton_pass(
    n_small: Array, params: ArmParams, reference_m: Array, iterate: Iterate
) -> tuple[Iterate, Evaluation]:
    """Return the next iterate, and forces and springs at the given one.

    Arms that have ended keep their numbers. If all have, pressures are clipped to their limits, and the
    joints' response to the law's gain is solved for in the place of a Newton step.
    """
    # Forces and springs at the iterate
    goes_on = iterate.goes_on(n_small)
    held = iterate.held & ~iterate.at_limit
    is_last = ~jnp.any(goes_on)
    clipped = jnp.clip(iterate.pressure, params.pressure_min_kpa, params.pressure_max_kpa)
    pressure = jnp.where(is_last, clipped, iterate.pressure)
    frames = chain_kinematics(params)(iterate.q)
    potential = statics(frames, iterate.q, pressure, params.with_law_gain(held, reference_m))

    # Joints by the forces and by each pressure: H^-1 (-grad V) and H^-1 B. Hanging arms are seldom held
    hessian = potential.hessian.plus_diagonal(iterate.stiffening * params.joint_stiffness)
    push = potential.push_per_kpa
    columns = jnp.concatenate(
        [-potential.gradient.reshape(*push.shape[:2], 1, *push.shape[3:]), push], axis=2
    )
    gains = _gain_columns(potential, held, params)
    padding = [(0, n - n_gains) for n_gains, n in zip(gains.shape, columns.shape, strict=True)]
    columns = jnp.where(is_last, jnp.pad(gains, padding), columns)
    solved = jax.lax.cond(is_last & ~jnp.any(held), jnp.zeros_like, hessian.solve, columns)

    # Step of the arms that go on
    clipped_iterate = iterate._replace(pressure=pressure)
    stepped = _newton_step(clipped_iterate, potential, solved, params, reference_m)
    stepped = jax.tree.map(lambda new, old: jnp.where(goes_on, new, old), stepped, iterate)
    law_response = solved[:, :, : len(reference_m)].reshape(len(iterate.q), *reference_m.shape)
    return stepped, Evaluation(pressure, frames, potential, law_response)


def _newton_step(
    iterate: Iterate, potential: Statics, solved: Array, params: ArmParams, reference_m: Array
) -> Iterate:
    """Return the iterate after a step in joint coordinates and pressures together: H dq = B dp - grad V.

    `solved` (n_sections, n, 1 + n_chambers, *arms) is H^-1 [-grad V, B].
    """
    # Active set: chambers that leave the limits are held there
    error = _law_errors(reference_m - potential.springs.length, iterate.pressure, params.allocation)
    trial = iterate.pressure + ACTIVE_SET_GAIN_KPA_PER_M * error
    limit = jnp.clip(trial, params.pressure_min_kpa, params.pressure_max_kpa)
    at_limit = (trial != limit) | params.pinned  # a pinned chamber even where its error is zero

    # Pressures: each chamber closes its error or goes to its limit
    newton_step, dq_dp = solved[:, :, 0], solved[:, :, 1:]
    closing = products(potential.springs.jacobian, solved)  # by the step at constant pressures, and per kPa
    closing = closing.reshape(len(reference_m), -1, *error.shape[1:])
    closed, closed_per_kpa = closing[:, 0], closing[:, 1:]
    if params.allocation is not None:
        closing = product(params.allocation.chamber_error, closing)
        closed, closed_per_kpa = closing[:, 0], closing[:, 1:] + YIELD_M_PER_KPA * params.allocation.redundant
    rows = jnp.where(at_limit[:, None], identity(len(error), closed_per_kpa), closed_per_kpa)
    residual = jax.lax.select(at_limit, limit - iterate.pressure, error - closed)
    dp = eliminate(rows, residual[:, None])[:, 0]
    dq = (newton_step + jnp.sum(dq_dp * dp, axis=2)).reshape(iterate.q.shape)

    # Step length; where elimination gave NaN, the arm stays. If any chamber tracks, the law's gain takes part
    # from now on; if it does already, or none tracks, the joints are stiffer for a step
    largest = jnp.max(jnp.abs(dq), axis=0)
    scale = jnp.minimum(1.0, MAX_STEP / largest)
    finite = jnp.all(jnp.isfinite(dq), axis=0)  # `largest` may miss a NaN: XLA's maximum on a CPU, jax 0.12
    convex = finite & (iterate.stiffening == 0)
    small = jnp.all(at_limit == iterate.at_limit, axis=0) & (largest < SMALL_STEP) & convex
    return Iterate(
        q=jnp.where(finite, iterate.q + scale * dq, iterate.q),
        pressure=jnp.where(finite, iterate.pressure + scale * dp, iterate.pressure),
        at_limit=at_limit,
        response=PressureResponse(dq_dp.reshape(iterate.response.dq_dp.shape), closed_per_kpa),
        n_small=jnp.where(small, iterate.n_small + 1, 0),
        held=iterate.held | ~finite,
        stiffening=jnp.where(
            finite | ~(iterate.held | jnp.all(at_limit, axis=0)), 0.0, 4.0 * iterate.stiffening + 4.0
        ),
        convex=convex,
        iteration=iterate.iteration + 1,
    )


def _law_errors(spring_error_m: Array, pressure_kpa: Array, allocation: Allocation | None) -> Array:
    """Return the error e of each chamber (n_chambers, *arms) [m], as `control.allocated_error` for one arm.

    `spring_error_m` (n_springs, *arms) [m] are references less lengths of the springs.
    """
    if allocation is None:
        return spring_error_m
    of_springs = product(allocation.chamber_error, spring_error_m[:, None])[:, 0]
    return of_springs - YIELD_M_PER_KPA * product(allocation.redundant, pressure_kpa[:, None])[:, 0]


def _gain_columns(potential: Statics, held: Array, params: ArmParams) -> Array:
    """Return forces (n_sections, n, n_springs, *arms) on the joints by references, through the law's gains.

    H^-1 times these forces is `Evaluation.law_response`. The gains of the chambers that are `held`,
    (n_chambers, *arms) bool, take part, and the potential includes them. Redundant chambers are not held.
    """
    springs = potential.springs
    held_stiffness = jnp.zeros_like(springs.length)
    if params.allocation is None:
        held_stiffness = jnp.where(held, params.law_stiffness, 0.0)
    return springs.forces(held_stiffness)


def _tangents(
    primals: tuple, tangents: tuple, settled: Settled, evaluation: Evaluation, response: PressureResponse
) -> Settled:
    """Return the derivative of an equilibrium along tangents of params and reference_m.

    Tangents are `SymbolicZero` where nothing changes. An arm that did not settle has a zero derivative.
    """
    # Derivatives at fixed joint coordinates and pressures
    params, reference = primals
    params_dot, reference_dot = tangents
    q, pressure_kpa, at_limit, converged = settled.q, settled.pressure_kpa, settled.at_limit, settled.settled
    _, frames, potential, law_response = evaluation
    explicit = _explicit_tangents(params, params_dot, q, pressure_kpa)

    # Inverse of the chambers' equations
    dq_dp = _masked(response.dq_dp, converged)
    unit = jnp.eye(len(at_limit), dtype=q.dtype)
    rows = jnp.where(at_limit[:, None], unit, _masked(response.closed_per_kpa, converged))
    inverse = _masked(eliminate(rows, unit), converged)

    # Right-hand side of each chamber's equation
    at_high = pressure_kpa >= params.pressure_max_kpa
    low_dot = _array(params_dot.pressure_min_kpa, params.pressure_min_kpa)
    high_dot = _array(params_dot.pressure_max_kpa, params.pressure_max_kpa)
    tracking_dot = _array(reference_dot, reference)
    if explicit is not None:
        tracking_dot = tracking_dot - explicit.spring_m
    # Joints at constant pressures; the law's gain, where it holds the arm, answers to references at once
    dq_held = jnp.sum(_masked(law_response, converged) * tracking_dot, axis=-1)
    if explicit is not None:
        every = jnp.eye(len(q), dtype=q.dtype).reshape(params.n_sections, -1, len(q))
        compliance = _masked(potential.hessian.solve(every), converged).reshape(len(q), -1)  # H^-1
        dq_held = dq_held - jnp.sum(compliance * explicit.gradient, axis=-1)
    tracking_dot = tracking_dot - _along(potential.springs.jacobian, dq_held)
    if params.allocation is not None:
        tracking_dot = params.allocation.chamber_error @ tracking_dot
    limit_dot = jax.lax.select(at_high, high_dot, low_dot)
    right = jax.lax.select(at_limit, limit_dot, tracking_dot)

    # Pressures and joints, then springs and tip
    dp = jnp.sum(inverse * right, axis=-1)
    dq = jnp.sum(dq_dp * dp, axis=-1) + dq_held
    tip_dot, rotation_dot = _tip_tangents(frames, dq)
    spring_dot = _along(potential.springs.jacobian, dq)
    if explicit is not None:
        spring_dot = spring_dot + explicit.spring_m
        tip_dot, rotation_dot = tip_dot + explicit.tip_position_m, rotation_dot + explicit.tip_rotation
    none = Settled(*(zero_from_primal(field, symbolic_zeros=True) for field in settled))
    return none._replace(
        q=_masked(dq, converged),
        pressure_kpa=_masked(dp, converged),
        spring_m=_masked(spring_dot, converged),
        tip_position_m=_masked(tip_dot, converged),
        tip_rotation=_masked(rotation_dot, converged),
    )


class _Explicit(NamedTuple):
    """Derivatives by the arm's numbers at fixed joint coordinates and pressures."""

    gradient: Array  # (nv,) of V's gradient
    spring_m: Array  # (n_springs,)
    tip_position_m: Array  # (3,)
    tip_rotation: Array  # (3, 3)


def _explicit_tangents(
    params: ArmParams, params_dot: ArmParams, q: Array, pressure_kpa: Array
) -> _Explicit | None:
    """Differentiate along the arm's numbers, pressure limits aside; None where none of them changes."""
    # Numbers that change; all others stay constants of the differentiated function
    numbers, structure = jax.tree.flatten(_without_limits(params))
    directions = jax.tree.leaves(_without_limits(params_dot))
    changing = [k for k, direction in enumerate(directions) if not isinstance(direction, SymbolicZero)]
    if not changing:
        return None

    def observables(*values: Array) -> _Explicit:
        merged = list(numbers)
        for k, value in zip(changing, values, strict=True):
            merged[k] = value
        arm = jax.tree.unflatten(structure, merged)
        frames = chain_kinematics(arm)(q)
        potential = statics(frames, q, pressure_kpa, arm)
        return _Explicit(
            potential.gradient, potential.springs.length, frames.tip_position, frames.tip_rotation
        )

    return jax.jvp(observables, [numbers[k] for k in changing], [directions[k] for k in changing])[1]


def _without_limits(params: ArmParams) -> ArmParams:
    """Return parameters without the numbers that V does not contain."""
    return params._replace(pressure_min_kpa=None, pressure_max_kpa=None, allocation=None)  # type: ignore


def _array(tangent: Array | SymbolicZero, primal: Array) -> Array:
    """Return a tangent, zeros for a symbolic zero."""
    return jnp.zeros_like(primal) if isinstance(tangent, SymbolicZero) else tangent


def _masked(x: Array, converged: Array) -> Array:
    """Return x, zeros for an arm that did not settle."""
    return jax.lax.select(converged, x, jnp.zeros_like(x))


def _along(jacobian: Array, dq: Array) -> Array:
    """Multiply the springs' Jacobian (n_sections, s, n) by joint coordinates (nv,): (n_springs,)."""
    return jnp.sum(jacobian * dq.reshape(jacobian.shape[0], 1, -1), axis=-1).reshape(-1)


def _tip_tangents(frames: Frames, dq: Array) -> tuple[Array, Array]:
    """Return the tip's velocity (3,) and its rotation's derivative (3, 3) for joint velocities (nv,)."""
    joint = frames.axis * dq.reshape(-1, DOFS_PER_LINK, 1)
    turn = joint[:, 1] + joint[:, 2]  # (n_links, 3)
    lever = frames.tip_position - frames.anchor
    velocity = jnp.sum(joint[:, 0] + jnp.cross(turn, lever), axis=0)
    rotation = jnp.cross(jnp.sum(turn, axis=0)[:, None], frames.tip_rotation, axis=0)
    return velocity, rotation
