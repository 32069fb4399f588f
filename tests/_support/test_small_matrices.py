"""Elimination in small matrices against LAPACK, and its gradient."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from mjx_softarm._support.small_matrices import solve_approximate_gradient as solve


def test_solutions_and_gradients_of_symmetric_systems():
    rng = np.random.default_rng(0)
    factor, columns = rng.normal(size=(4, 7, 7)), np.float32(rng.normal(size=(4, 7, 2)))
    matrix = np.float32(factor @ np.swapaxes(factor, 1, 2) + 3.0 * np.eye(7))

    @functools.partial(jax.jit, static_argnums=0)
    def solved(solver, matrix, columns):
        def cost(matrix, columns):
            found = jax.vmap(solver)(matrix, columns)
            return jnp.sum(jnp.sin(found)), found

        slopes, found = jax.grad(cost, argnums=(0, 1), has_aux=True)(matrix, columns)
        return found, *slopes

    (found, constant, got), (expected, _, slope) = (
        solved(f, matrix, columns) for f in (solve, jnp.linalg.solve)
    )
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(got, slope, atol=1e-4)
    np.testing.assert_array_equal(constant, 0.0)  # the matrix counts as a constant
