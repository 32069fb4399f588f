"""The arm at rest under pressures as a differentiable function.

Rest is where the potential's gradient vanishes, grad V(q; x) = 0, so by the implicit function theorem

    dq = -H^-1 d(grad V)/dx dx,    H = d(grad V)/dq,

with the closed-form gradient and Hessian of `mjx_softarm.mechanics.statics`. This is the derivative of the equilibrium
itself, exact to rounding however many Newton steps led there, and costs one solve with a matrix that is
already there. Finite differences would need a settled arm for each of the numbers, and in single precision
would have to choose between the rounding of a small step and the curvature of a large one; differentiating
through the iterations would keep them all and would need a loop of fixed length.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm.mechanics.kinematics import chain_frames, chain_kinematics
from mjx_softarm.mechanics.settle import settle_pressures
from mjx_softarm.mechanics.statics import ArmParams, Statics, statics


@jax.custom_jvp
def rest(params: ArmParams, pressure_kpa: Array) -> Array:
    """Joint coordinates (nv,) at rest under pressures (n_chambers,) [kPa], which no limit of the arm clips.

    Differentiable in both arguments, by the implicit function theorem.
    """
    free = params._replace(
        pressure_min_kpa=jnp.full_like(pressure_kpa, -jnp.inf),
        pressure_max_kpa=jnp.full_like(pressure_kpa, jnp.inf),
    )
    kinematics = chain_kinematics(params)
    return settle_pressures(kinematics, free, pressure_kpa).q


@rest.defjvp
def _rest_jvp(primals, tangents):
    params, pressure = primals
    q = rest(params, pressure)

    def gradient(params: ArmParams, pressure: Array) -> Array:
        return statics_at(q, params, pressure).gradient

    # A factorisation of the whole, since what `ChainHessian.solve` does cannot be transposed.
    factor = jax.scipy.linalg.cho_factor(statics_at(q, params, pressure).hessian.dense(), lower=True)
    _, change = jax.jvp(gradient, primals, tangents)
    return q, -jax.scipy.linalg.cho_solve(factor, change)


def statics_at(q: Array, params: ArmParams, pressure_kpa: Array) -> Statics:
    """The potential's derivatives at joint coordinates (nv,) and pressures (n_chambers,) [kPa]."""
    return statics(chain_frames(q, params.link_length_m), q, pressure_kpa, params)
