"""Elimination in small matrices against NumPy, and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_softarm._support.small_matrices import solve_approximate_gradient as solve


def test_solutions_and_gradients_of_symmetric_systems():
    rng = np.random.default_rng(0)
    factor, columns = rng.normal(size=(4, 7, 7)), np.float32(rng.normal(size=(4, 7, 2)))
    matrix = np.float32(factor @ np.swapaxes(factor, 1, 2) + 3.0 * np.eye(7))

    def cost(solver, matrix, columns):
        return jnp.sum(jnp.sin(jax.vmap(solver)(matrix, columns)))

    np.testing.assert_allclose(jax.vmap(solve)(matrix, columns), np.linalg.solve(matrix, columns), atol=1e-5)
    (constant, got), (_, expected) = (
        jax.grad(cost, argnums=(1, 2))(solver, matrix, columns) for solver in (solve, jnp.linalg.solve)
    )
    np.testing.assert_allclose(got, expected, atol=1e-4)
    np.testing.assert_array_equal(constant, 0.0)  # the matrix counts as a constant
