"""Many small matrices at once: products, block diagonals, elimination.

A library is called once per matrix, which costs more than the arithmetic of a small matrix. Matrices of many
arms have the arms last, (n, m, *arms), so that one instruction works on several arms; *arms may be empty.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support.xla import rows_last

BLOCK = 3  # pivots that are eliminated at once
WRITTEN_OUT = 4  # largest number of terms that a product without arms adds one by one, which is faster


def product(a: Array, b: Array) -> Array:
    """Multiply small matrices (n, m, *arms) and (m, k, *arms).

    A product with arms, or with few terms, is written out term by term. On CPUs jaxlib 0.10.2 hands a sum
    over a middle axis to a library, and then some settled arms are wrong; the options of
    `mjx_softarm._support.xla.jit` prevent this.
    """
    if a.ndim > 2 or len(b) <= WRITTEN_OUT:
        return functools.reduce(jnp.add, [a[:, j, None] * b[j] for j in range(len(b))])
    return jnp.sum(a[:, :, None] * b, axis=1)


products = jax.vmap(product)  # multiplies matrices (k, n, m, *arms) and (k, m, l, *arms)


def identity(n: int, like: Array) -> Array:
    """Return the identity (n, n, 1, ..., 1) with a 1 for each axis of arms that `like` has."""
    return jnp.eye(n, dtype=like.dtype).reshape(n, n, *[1] * (like.ndim - 2))


def block_diagonal(blocks: Array) -> Array:
    """Return the block-diagonal matrix (n rows, n columns, *arms) of blocks (n, rows, columns, *arms)."""
    n, rows, columns, *arms = blocks.shape
    apart = identity(n, blocks[0])[:, None, :, None] * blocks[:, :, None]
    return apart.reshape(n * rows, n * columns, *arms)


def eliminate(matrix: Array, columns: Array) -> Array:
    """Multiply the inverse of a matrix (n, n, *arms) by columns (n, k, *arms): Gauss-Jordan, no pivoting.

    It is meant for matrices that are symmetric positive definite, or nearly: the response of a settling arm's
    springs to its chambers, with rows of the identity for chambers at a limit. All is NaN if a pivot is not
    positive, as one is where a symmetric matrix is not positive definite.
    """
    return _eliminate_one(matrix, columns) if matrix.ndim == 2 else _eliminate(matrix, columns)


def _eliminate(matrix: Array, columns: Array) -> Array:
    """Eliminate a block of columns at a time, so that each number is read and written a third as often.

    Barriers keep the compiler from computing the pivots' rows again for every other row.
    """
    n = len(matrix)
    columns = jnp.broadcast_to(columns, (*columns.shape[:2], *matrix.shape[2:]))
    augmented = jax.lax.optimization_barrier(jnp.concatenate([matrix, columns], axis=1))
    for first in range(0, n, BLOCK):
        block = slice(first, min(first + BLOCK, n))
        rows = product(_inverse_last(augmented[block, block]), augmented[block])
        rows = jax.lax.optimization_barrier(rows)
        augmented = (augmented - product(augmented[:, block], rows)).at[block].set(rows)
    return augmented[:, n:]


_eliminate_one = rows_last(_eliminate)  # `jax.vmap` of it has the arms last


def _inverse_last(matrix: Array) -> Array:
    """Invert small matrices (n, n, *arms) with positive pivots; every row is written out."""
    n = matrix.shape[0]
    beside = jnp.broadcast_to(identity(n, matrix), matrix.shape)
    rows = list(jnp.concatenate([matrix, beside], axis=1))
    for k in range(n):
        row = rows[k] / jnp.where(rows[k][k] > 0, rows[k][k], jnp.nan)
        rows = [row if other == k else rows[other] - rows[other][k] * row for other in range(n)]
    return jnp.stack(rows)[:, n:]
