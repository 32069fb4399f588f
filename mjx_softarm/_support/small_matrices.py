"""Many small matrices at once: products, block diagonals, elimination.

Libraries are called once for each matrix, which costs more than the arithmetic of a small one.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array

BLOCK = 3  # pivots that are eliminated at once
WRITTEN_OUT = 4  # terms of an inner product that are added one by one, which is four times as fast


def product(a: Array, b: Array) -> Array:
    """Multiply small matrices (..., n, m) and (..., m, k), as sums: faster than products when tiny."""
    if a.shape[-1] <= WRITTEN_OUT:
        return functools.reduce(
            jnp.add, [a[..., :, k, None] * b[..., k, None, :] for k in range(a.shape[-1])]
        )
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def block_diagonal(blocks: Array) -> Array:
    """Return the block-diagonal matrix (n rows, n columns) of blocks (n, rows, columns)."""
    n, rows, columns = blocks.shape
    apart = jnp.eye(n, dtype=blocks.dtype)[:, None, :, None] * blocks[:, :, None]
    return apart.reshape(n * rows, n * columns)


@jax.custom_batching.custom_vmap
def eliminate(matrix: Array, columns: Array) -> Array:
    """Multiply the inverse of a matrix (n, n) by columns (n, k): Gauss-Jordan, without pivoting.

    It is meant for symmetric positive definite matrices and for nearly such ones: the response of a settling
    arm's springs to their chambers, with rows of the identity for chambers at a limit.

    Returns:
        (n, k), all NaN if a pivot is not positive, which is so where a symmetric matrix is not positive
        definite.
    """
    return _eliminate_last(jnp.concatenate([matrix, columns], axis=1)[..., None])[..., 0]


@eliminate.def_vmap
def _eliminate_many(n: int, batched: list[bool], matrix: Array, columns: Array) -> tuple[Array, bool]:
    parts = [
        jnp.moveaxis(part, 0, -1) if own else jnp.broadcast_to(part[..., None], (*part.shape, n))
        for part, own in zip((matrix, columns), batched, strict=True)
    ]
    return jnp.moveaxis(_eliminate_last(jnp.concatenate(parts, axis=1)), -1, 0), True


@jax.custom_vjp
def solve(matrix: Array, columns: Array) -> Array:
    """Multiply the inverse of a symmetric matrix (n, n) by columns (n, k), by `eliminate`.

    Its gradient is by the columns; the matrix counts as a constant.
    """
    return eliminate(matrix, columns)


def _solve_forward(matrix: Array, columns: Array) -> tuple[Array, Array]:
    return eliminate(matrix, columns), matrix


def _solve_backward(matrix: Array, d_found: Array) -> tuple[None, Array]:
    return None, eliminate(matrix, d_found)


solve.defvjp(_solve_forward, _solve_backward)


def _eliminate_last(augmented: Array) -> Array:
    """Eliminate in matrices beside columns (n, n + k, batch); with the batch last, one instruction serves it.

    A block of columns is cleared at once, so that each number is read and written a third as often. Barriers
    keep the compiler from working out the pivots' rows again for each of the others.
    """
    n = augmented.shape[0]
    augmented = jax.lax.optimization_barrier(augmented)
    for first in range(0, n, BLOCK):
        block = slice(first, min(first + BLOCK, n))
        rows = _product_last(_inverse_last(augmented[block, block]), augmented[block])
        rows = jax.lax.optimization_barrier(rows)
        augmented = (augmented - _product_last(augmented[:, block], rows)).at[block].set(rows)
    return augmented[:, n:]


def _inverse_last(matrix: Array) -> Array:
    """Invert matrices (n, n, batch) with positive pivots; n is small, since all is written out."""
    n = matrix.shape[0]
    identity = jnp.broadcast_to(jnp.eye(n, dtype=matrix.dtype)[..., None], matrix.shape)
    rows = list(jnp.concatenate([matrix, identity], axis=1))
    for k in range(n):
        row = rows[k] / jnp.where(rows[k][k] > 0, rows[k][k], jnp.nan)
        rows = [row if other == k else rows[other] - rows[other][k] * row for other in range(n)]
    return jnp.stack(rows)[:, n:]


def _product_last(a: Array, b: Array) -> Array:
    """Multiply matrices (n, m, batch) and (m, k, batch); m is small, since all is written out."""
    return functools.reduce(jnp.add, [a[:, j, None] * b[j] for j in range(len(b))])
