"""Systems with a chain's Hessian, and small matrices, against NumPy's; what is not positive says so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm._support.small_matrices import eliminate
from mjx_softarm.mechanics.chain_hessian import ChainHessian, solve_approximate_gradient

N_ARMS, N, K = 5, 6, 4
alone, each = jax.jit(eliminate), jax.jit(jax.vmap(eliminate))


@pytest.fixture(autouse=True)
def _strict():
    with jax.numpy_dtype_promotion("strict"):
        yield


def chain(n_sections, seed=0, coupling=0.3):
    """`N_ARMS` random positive definite matrices, and columns for them."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N_ARMS, n_sections, N, N))
    own = root @ root.swapaxes(-1, -2) + 5.0 * np.eye(N)
    above, below = coupling * rng.normal(size=(2, N_ARMS, n_sections, N, 2))
    columns = rng.normal(size=(N_ARMS, n_sections, N, K))
    return ChainHessian(*map(np.float32, (own, above, below))), np.float32(columns)


def arms_last(tree):
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), tree)


def dense(hessian):
    """The matrices by their definition, entry by entry."""
    n_arms, n_sections = hessian.own.shape[:2]
    full = np.zeros((n_arms, n_sections, N, n_sections, N))
    for s in range(n_sections):
        full[:, s, :, s] = hessian.own[:, s]
        for t in range(s + 1, n_sections):
            far = hessian.above[:, s] @ hessian.below[:, t].swapaxes(-1, -2)
            full[:, s, :, t], full[:, t, :, s] = far, far.swapaxes(-1, -2)
    return full.reshape(n_arms, n_sections * N, n_sections * N)


@pytest.mark.parametrize("n_sections", [1, 3])
def test_a_system_with_the_hessian_is_that_with_the_dense_matrix(n_sections):
    hessian, columns = chain(n_sections)
    assert np.linalg.eigvalsh(dense(hessian)).min() > 0
    unit = np.eye(N * n_sections, dtype=np.float32)
    rows = jax.jit(jax.vmap(jax.vmap(ChainHessian.times, (None, 0)), (0, None)))(hessian, unit)
    np.testing.assert_allclose(rows, dense(hessian), atol=1e-6)
    found = jax.jit(jax.vmap(ChainHessian.solve))(hessian, columns)
    wanted = np.linalg.solve(dense(hessian), columns.reshape(N_ARMS, -1, K).astype(float))
    np.testing.assert_allclose(found, wanted.reshape(found.shape), atol=1e-5 * np.abs(wanted).max())
    at_once = jax.jit(ChainHessian.solve)(arms_last(hessian), arms_last(columns))
    np.testing.assert_allclose(at_once, arms_last(found), atol=1e-6 * np.abs(wanted).max())


def test_an_approximate_gradient_is_by_the_columns_alone():
    hessian, columns = chain(2)

    def cost(matrix, columns):
        return jnp.sum(jnp.sin(solve_approximate_gradient(matrix, columns)))

    constant, slope = jax.jit(jax.vmap(jax.grad(cost, argnums=(0, 1))))(hessian, columns)
    matrix, shape = dense(hessian), (N_ARMS, -1, K)
    found = np.linalg.solve(matrix, columns.reshape(shape).astype(float))
    expected = np.linalg.solve(matrix, np.cos(found))
    np.testing.assert_allclose(slope.reshape(shape), expected, atol=1e-5 * np.abs(expected).max())
    assert all((x == 0.0).all() for x in jax.tree.leaves(constant))


def test_a_matrix_that_is_not_positive_definite_gives_nan_and_its_neighbours_do_not():
    hessian, columns = chain(3)
    coupled = hessian.above.copy()
    coupled[2] *= 30.0  # its blocks stay positive definite, the whole does not
    hessian = hessian._replace(above=coupled)
    lowest = np.linalg.eigvalsh(dense(hessian))[:, 0]
    assert lowest[2] < 0 < np.delete(lowest, 2).min()
    found = jax.jit(jax.vmap(ChainHessian.solve))(hessian, columns)
    np.testing.assert_array_equal(np.isfinite(found).all((1, 2, 3)), lowest > 0)
    assert np.isnan(found[2]).all()


@pytest.mark.parametrize("n", [1, 3, 7])
def test_elimination_of_rows_of_which_some_are_the_identity_s(n):
    rng = np.random.default_rng(n)
    matrix = np.float32(2.0 * np.eye(n) + 0.3 * rng.normal(size=(8, n, n)))  # not symmetric
    given = rng.uniform(size=(8, n)) < 0.5
    matrix = np.where(given[..., None], np.eye(n, dtype=np.float32), matrix)
    columns = np.float32(rng.normal(size=(8, n, 3)))
    found = np.asarray(each(matrix, columns))
    np.testing.assert_allclose(found, np.linalg.solve(matrix, columns), atol=1e-5)
    np.testing.assert_array_equal(found[given], columns[given])
    at_once = alone(arms_last(matrix), arms_last(columns))
    np.testing.assert_allclose(at_once, arms_last(found), atol=1e-6)
    shared = jax.jit(jax.vmap(eliminate, in_axes=(None, 0)))(matrix[0], columns)
    np.testing.assert_allclose(shared, np.linalg.solve(matrix[0], columns), atol=1e-5)
