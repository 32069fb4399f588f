"""Elimination in small matrices against NumPy, and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_softarm._support.small_matrices import solve


def test_solutions_and_gradients_of_symmetric_systems():
    rng = np.random.default_rng(0)
    factor, columns = rng.normal(size=(4, 7, 7)), np.float32(rng.normal(size=(4, 7, 2)))
    matrix = np.float32(factor @ np.swapaxes(factor, 1, 2) + 3.0 * np.eye(7))

    def cost(solver, factor, columns):  # of a symmetric matrix, however the factor changes
        matrix = factor @ jnp.swapaxes(factor, 1, 2) + 3.0 * jnp.eye(7)
        return jnp.sum(jnp.sin(jax.vmap(solver)(matrix, columns)))

    np.testing.assert_allclose(jax.vmap(solve)(matrix, columns), np.linalg.solve(matrix, columns), atol=1e-5)
    got, expected = (
        jax.grad(cost, argnums=(1, 2))(solver, np.float32(factor), columns)
        for solver in (solve, jnp.linalg.solve)
    )
    for ours, true in zip(got, expected, strict=True):
        np.testing.assert_allclose(ours, true, atol=1e-4)
