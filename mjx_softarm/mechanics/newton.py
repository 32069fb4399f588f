"""A step of Newton's method towards the equilibrium of `mjx_softarm.mechanics.settle`, many arms last.

Without an allocation, each chamber closes the error of its spring, e = reference - s. Redundant chambers
close e = C (reference - s) - YIELD_M_PER_KPA N p, with the matrices C and N of `mjx_softarm.control`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support.small_matrices import eliminate, identity, product, products
from mjx_softarm.control import YIELD_M_PER_KPA, Allocation
from mjx_softarm.mechanics.contact import step_share
from mjx_softarm.mechanics.implicit import PressureResponse, gain_columns
from mjx_softarm.mechanics.kinematics import Frames, Kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.statics import Statics, statics

MAX_ITERATIONS = 12
MAX_ITERATIONS_IN_CONTACT = 36  # balls come to the wall one after another
ACTIVE_SET_GAIN_KPA_PER_M = 1000.0  # c
MAX_STEP = 0.5  # largest entry of a Newton step [m, rad]
SMALL_STEP = 3e-4  # [m, rad]; Newton's method converges quadratically from here


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

    def goes_on(self, n_small: Array | int, params: ArmParams) -> Array:
        """Return which arms have made fewer than `n_small` small steps in a row: (*arms,) bool."""
        most = MAX_ITERATIONS if params.contact is None else MAX_ITERATIONS_IN_CONTACT
        return (self.n_small < n_small) & (self.iteration < most + n_small - 1)


class End(NamedTuple):
    """Forces and springs of all arms at an iterate."""

    pressure: Array  # (n_chambers, *arms) [kPa]
    frames: Frames
    statics: Statics
    law_response: Array  # (nv, n_springs, *arms) that of `Equilibrium`, in the last pass


@jax.jit  # traced once for the loop, the shapes of its results, and both values of n_small
def newton_pass(
    n_small: Array, kinematics: Kinematics, params: ArmParams, reference_m: Array, it: Iterate
) -> tuple[Iterate, End]:
    """Return the next iterate, and forces and springs at the given one.

    Arms that have ended keep their numbers. If all have, pressures are clipped to their limits, and the
    joints' response to the law's gain is solved for in the place of a Newton step.
    """
    # Forces and springs at the iterate
    goes_on, held = it.goes_on(n_small, params), it.held & ~it.at_limit
    is_last = ~jnp.any(goes_on)
    clipped = jnp.clip(it.pressure, params.pressure_min_kpa, params.pressure_max_kpa)
    pressure = jnp.where(is_last, clipped, it.pressure)
    frames = kinematics(it.q)
    here = statics(frames, it.q, pressure, params.answering(held, reference_m))

    # Joints by the forces and by each pressure: H^-1 (-grad V) and H^-1 B. Hanging arms are seldom held
    hessian = here.hessian.plus_diagonal(it.stiffening * params.joint_stiffness)
    push = here.push_per_kpa
    columns = jnp.concatenate([-here.gradient.reshape(*push.shape[:2], 1, *push.shape[3:]), push], axis=2)
    gains = gain_columns(here, held, params)
    padding = [(0, n - own) for own, n in zip(gains.shape, columns.shape, strict=True)]
    columns = jnp.where(is_last, jnp.pad(gains, padding), columns)
    solved = jax.lax.cond(is_last & ~jnp.any(held), jnp.zeros_like, hessian.solve, columns)

    # Step of the arms that go on
    at = it._replace(pressure=pressure)
    moved = _newton_step(at, kinematics, frames, here, solved, params, reference_m)
    moved = jax.tree.map(lambda new, old: jnp.where(goes_on, new, old), moved, it)
    by_law = solved[:, :, : len(reference_m)].reshape(len(it.q), *reference_m.shape)
    return moved, End(pressure, frames, here, by_law)


def _newton_step(
    it: Iterate,
    kinematics: Kinematics,
    frames: Frames,
    here: Statics,
    solved: Array,
    params: ArmParams,
    reference_m: Array,
) -> Iterate:
    """Return the iterate after a step in joint coordinates and pressures together: H dq = B dp - grad V.

    Args:
        it: iterate.
        kinematics: of either engine.
        frames: at the iterate.
        here: forces and springs at the iterate.
        solved (n_sections, n, 1 + n_chambers, *arms): H^-1 [-grad V, B].
        params: numbers of the arm.
        reference_m (n_springs, *arms): spring lengths that the law tracks.
    """
    # Active set: chambers that leave the limits are held there
    error = law_errors(reference_m - here.springs.length, it.pressure, params.allocation)
    trial = it.pressure + ACTIVE_SET_GAIN_KPA_PER_M * error
    limit = jnp.clip(trial, params.pressure_min_kpa, params.pressure_max_kpa)
    at_limit = (trial != limit) | params.pinned  # a pinned chamber even where its error is zero

    # Pressures: each chamber closes its error or goes to its limit
    newton_step, dq_dp = solved[:, :, 0], solved[:, :, 1:]
    spring_response = products(here.springs.jacobian, solved).reshape(len(reference_m), -1, *error.shape[1:])
    closed, closed_per_kpa = closed_errors(spring_response[:, 0], spring_response[:, 1:], params.allocation)
    rows = jnp.where(at_limit[:, None], identity(len(error), closed_per_kpa), closed_per_kpa)
    residual = jax.lax.select(at_limit, limit - it.pressure, error - closed)
    dp = eliminate(rows, residual[:, None])[:, 0]
    dq = (newton_step + jnp.sum(dq_dp * dp, axis=2)).reshape(it.q.shape)

    # Step length; where elimination gave NaN, the arm stays. If any chamber tracks, the law's gain takes part
    # from now on; if it does already, or none tracks, the joints are stiffer for a step
    largest = jnp.max(jnp.abs(dq), axis=0)
    scale = jnp.minimum(1.0, MAX_STEP / largest)
    if params.contact is not None:
        scale = scale * step_share(params.contact, frames, kinematics(it.q + scale * dq))
    finite = jnp.all(jnp.isfinite(dq), axis=0)  # `largest` may miss a NaN: XLA's maximum on a CPU, jax 0.12
    convex = finite & (it.stiffening == 0)
    small = jnp.all(at_limit == it.at_limit, axis=0) & (largest < _small_step(params)) & convex
    return Iterate(
        q=jnp.where(finite, it.q + scale * dq, it.q),
        pressure=jnp.where(finite, it.pressure + scale * dp, it.pressure),
        at_limit=at_limit,
        response=PressureResponse(dq_dp.reshape(it.response.dq_dp.shape), closed_per_kpa),
        n_small=jnp.where(small, it.n_small + 1, 0),
        held=it.held | ~finite,
        stiffening=jnp.where(finite | ~(it.held | jnp.all(at_limit, axis=0)), 0.0, 4.0 * it.stiffening + 4.0),
        convex=convex,
        iteration=it.iteration + 1,
    )


def _small_step(params: ArmParams) -> float:
    """Return the largest entry of a small step; a wall's stiffness changes within less than a millimetre."""
    return SMALL_STEP if params.contact is None else 0.1 * SMALL_STEP


def law_errors(spring_error_m: Array, pressure_kpa: Array, allocation: Allocation | None) -> Array:
    """Return the error e of each chamber (n_chambers, *arms) [m].

    Args:
        spring_error_m (n_springs, *arms) [m]: references less lengths of the springs.
        pressure_kpa (n_chambers, *arms) [kPa]: pressures.
        allocation: matrices (..., *arms) of an arm with redundant chambers.
    """
    if allocation is None:
        return spring_error_m
    of_springs = product(allocation.chamber_error, spring_error_m[:, None])[:, 0]
    return of_springs - YIELD_M_PER_KPA * product(allocation.redundant, pressure_kpa[:, None])[:, 0]


def closed_errors(
    newton_spring_m: Array, spring_per_kpa: Array, allocation: Allocation | None
) -> tuple[Array, Array]:
    """Return by how much a Newton step, and each pressure, lessens the error of each chamber.

    Args:
        newton_spring_m (n_springs, *arms) [m]: lengthening of the springs by the step at constant pressures.
        spring_per_kpa (n_springs, n_chambers, *arms) [m/kPa]: response of the springs to the pressures.
        allocation: matrices (..., *arms) of an arm with redundant chambers.

    Returns:
        (n_chambers, *arms) [m] and (n_chambers, n_chambers, *arms) [m/kPa].
    """
    if allocation is None:
        return newton_spring_m, spring_per_kpa
    newton = product(allocation.chamber_error, newton_spring_m[:, None])[:, 0]
    per_kpa = product(allocation.chamber_error, spring_per_kpa)
    return newton, per_kpa + YIELD_M_PER_KPA * allocation.redundant
