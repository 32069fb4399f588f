"""Derivative of the equilibrium by the implicit function theorem, at its final active set.

An equilibrium (q, p) of `mjx_softarm.mechanics.settle` solves, for every chamber t,

    grad V(q; p, x) = 0,    s_t(q; x) = reference_t  if t tracks,  p_t = limit_t  if t is at a limit,

with the arm's numbers x. As long as the set of chambers at a limit stays, these equations differentiate to

    H dq = B dp - d_x grad V,    S dq = dreference - d_x s  or  dp = dlimit,

with H the Hessian of V, B the chambers' push per kPa and S the springs' Jacobian. With K = H^-1 B, and R with
the rows of S K where chambers track and of the identity where they are at a limit,

    dp = R^-1 r,    dq = K dp - H^-1 d_x grad V,    r = dreference - d_x s + S H^-1 d_x grad V  or  dlimit.

Where the law holds an arm that would buckle at constant pressures, V has the springs l (s - reference)^2 / 2
of the law's gain l as well, where chambers track. They are at rest, but the joints answer to them at once:

    dq = K dp + H^-1 S^T l (dreference - d_x s) - H^-1 d_x grad V,    with r less S times the last two terms.

Redundant chambers close the errors of `mjx_softarm.mechanics.settle`: C S in place of S,
C (dreference - d_x s) in place of dreference - d_x s, and C S K + YIELD_M_PER_KPA N in place of S K.

This is exact however many Newton steps led to the equilibrium. K comes from the last Newton step; only
derivatives by the arm's numbers need H^-1.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero

from mjx_softarm._support.small_matrices import block_diagonal, eliminate
from mjx_softarm.mechanics.kinematics import DOFS_PER_LINK, Frames, chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.statics import Statics, statics


class PressureResponse(NamedTuple):
    """Response of joints and of the law's errors to the chambers' pressures, at the balance of forces."""

    dq_dp: Array  # (nv, n_chambers) [m/kPa, rad/kPa], K
    closed_per_kpa: Array  # (n_chambers, n_chambers) [m/kPa] decrease of each chamber's error, S K


class Equilibrium(NamedTuple):
    """Equilibrium with all that its derivative needs."""

    q: Array  # (nv,)
    pressure_kpa: Array  # (n_chambers,)
    at_limit: Array  # (n_chambers,) bool, the active set
    frames: Frames
    statics: Statics
    response: PressureResponse
    law_response: Array  # (nv, n_springs) joints by references, zeros unless the law holds the arm


def gain_columns(potential: Statics, held: Array, params: ArmParams) -> Array:
    """Return forces (n_sections, n, n_springs, *arms) on the joints by references, through the law's gains.

    H^-1 times these forces is `Equilibrium.law_response`. The gains of the chambers that are `held`,
    (n_chambers, *arms) bool, take part, and the potential includes them. Redundant chambers are not held.
    """
    n_sections, _, n, *arms = potential.springs.jacobian.shape
    if params.allocation is not None:
        return jnp.zeros((n_sections, n, *potential.springs.length.shape), potential.gradient.dtype)
    gain = jnp.where(held, params.law_stiffness, 0.0).reshape(n_sections, -1, 1, *arms)
    columns = block_diagonal(jnp.swapaxes(gain * potential.springs.jacobian, 1, 2))
    return columns.reshape(n_sections, n, -1, *arms)


def equilibrium_tangents(
    primals: tuple, tangents: tuple, equilibrium: Equilibrium, settled: Array
) -> dict[str, Array]:
    """Return the derivatives of an equilibrium along a direction, by the names of the fields of `Settled`.

    Primals are params and reference_m of `settle`; tangents have their structure, with `SymbolicZero` where
    nothing changes. An arm that did not settle, () bool, has a zero derivative.
    """
    # Derivatives at fixed joint coordinates and pressures
    params, reference = primals
    params_dot, reference_dot = tangents
    q, pressure_kpa, at_limit, frames, potential, response, law_response = equilibrium
    explicit = _explicit_tangents(params, params_dot, q, pressure_kpa)

    # Inverse of the chambers' equations
    dq_dp = _masked(response.dq_dp, settled)
    identity = jnp.eye(len(at_limit), dtype=q.dtype)
    rows = jnp.where(at_limit[:, None], identity, _masked(response.closed_per_kpa, settled))
    inverse = _masked(eliminate(rows, identity), settled)

    # Right-hand side of each chamber's equation
    at_high = pressure_kpa >= params.pressure_max_kpa
    low_dot = _array(params_dot.pressure_min_kpa, params.pressure_min_kpa)
    high_dot = _array(params_dot.pressure_max_kpa, params.pressure_max_kpa)
    tracking_dot = _array(reference_dot, reference)
    if explicit is not None:
        tracking_dot = tracking_dot - explicit.spring_m
    # Joints at constant pressures; the law's gain, where it holds the arm, answers to references at once
    dq_held = jnp.sum(_masked(law_response, settled) * tracking_dot, axis=-1)
    if explicit is not None:
        every = jnp.eye(len(q), dtype=q.dtype).reshape(params.n_sections, -1, len(q))
        compliance = _masked(potential.hessian.solve(every), settled).reshape(len(q), -1)  # H^-1
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
    tangents_of = {
        "q": dq,
        "pressure_kpa": dp,
        "spring_m": spring_dot,
        "tip_position_m": tip_dot,
        "tip_rotation": rotation_dot,
    }
    return {name: _masked(x, settled) for name, x in tangents_of.items()}


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


def _masked(x: Array, settled: Array) -> Array:
    """Return x, zeros for an arm that did not settle."""
    return jax.lax.select(settled, x, jnp.zeros_like(x))


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
