"""Many small matrices at once: products, block diagonals, elimination.

Libraries are called once for each matrix, which costs more than the arithmetic of a small one.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def product(a: Array, b: Array) -> Array:
    """a b of small matrices (..., n, m) and (..., m, k), as sums: faster than products when tiny."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def block_diagonal(blocks: Array) -> Array:
    """The block-diagonal matrix (n rows, n columns) of blocks (n, rows, columns)."""
    n, rows, columns = blocks.shape
    apart = jnp.eye(n, dtype=blocks.dtype)[:, None, :, None] * blocks[:, :, None]
    return apart.reshape(n * rows, n * columns)


@jax.custom_batching.custom_vmap
def eliminate(matrix: Array, columns: Array) -> Array:
    """The inverse of a matrix (n, n) times columns (n, k), by Gauss-Jordan elimination without pivoting.

    Right for symmetric positive definite matrices, and for what is close to such: of a settling arm, how the
    springs that track answer to their chambers, and rows of the identity for the others.

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


def _eliminate_last(augmented: Array) -> Array:
    """Of matrices beside columns (n, n + k, batch): the batch is last: one instruction serves many."""
    n = augmented.shape[0]
    rows = jnp.arange(n)[:, None]

    def step(k: Array, augmented: Array) -> Array:
        row = jax.lax.dynamic_index_in_dim(augmented, k, 0, keepdims=False)
        column = jax.lax.dynamic_index_in_dim(augmented, k, 1, keepdims=False)
        pivot = jax.lax.dynamic_index_in_dim(row, k, 0, keepdims=False)
        row = row / jnp.where(pivot > 0, pivot, jnp.nan)
        others = jnp.where(rows == k, 0, column)
        return jax.lax.dynamic_update_index_in_dim(augmented - others[:, None] * row, row, k, 0)

    return jax.lax.fori_loop(0, n, step, augmented)[:, n:]
