"""The Hessian of a chain of sections, and systems with it solved at a cost that is linear in the sections.

The joints of one section are coupled by the tendons that run through it, those of different sections by
gravity alone: its second derivative by a joint i and one j further down is a product of two numbers of i with
two of j (see `mjx_softarm.statics`), so the block between two sections has rank two. Block elimination from
the tip to the base keeps that form: what hangs below a section acts on it as a reaction of rank two, as in
the articulated-body algorithm for rigid chains.

Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 7 (articulated bodies).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

RANK = 2  # of what couples two sections


class ChainHessian(NamedTuple):
    """A symmetric matrix in blocks; between sections s < t stands `above[s] @ below[t].T`."""

    own: Array  # (n_sections, n, n) of each section's n joints
    above: Array  # (n_sections, n, 2)
    below: Array  # (n_sections, n, 2)

    def dense(self) -> Array:
        """All of it, (nv, nv)."""
        n_sections, n, _ = self.own.shape
        section = jnp.repeat(jnp.arange(n_sections), n)
        above, below = (x.reshape(-1, RANK) for x in (self.above, self.below))
        further_down = section[:, None] < section
        far = jnp.where(further_down, above @ below.T, 0)
        return block_diagonal(self.own) + far + far.T

    def plus_diagonal(self, added: Array) -> ChainHessian:
        """The matrix with `added` (nv,) on its diagonal."""
        n_sections, n, _ = self.own.shape
        return self._replace(own=self.own + added.reshape(n_sections, n, 1) * jnp.eye(n, dtype=added.dtype))

    def solve(self, columns: Array) -> Array:
        """The inverse times columns (n_sections, n, k), in the same form; NaN if not positive definite."""
        reaction = jnp.zeros((RANK, RANK), columns.dtype)  # of all that is further down
        pull = jnp.zeros((RANK, columns.shape[-1]), columns.dtype)  # likewise, of its columns
        reduced = []
        for own, above, below, column in reversed(list(zip(*self, columns, strict=True))):
            acted = product(above, reaction)
            right = jnp.concatenate([below - acted, column - product(above, pull)], axis=1)
            solved = eliminate(own - product(acted, above.T), right)
            passed_on = product((below - acted).T, solved)
            reaction, pull = reaction + passed_on[:, :RANK], pull + passed_on[:, RANK:]
            reduced.append(solved)
        motion = jnp.zeros_like(pull)  # of all that is further up
        found = []
        for above, solved in zip(self.above, reversed(reduced), strict=True):
            found.append(solved[:, RANK:] - product(solved[:, :RANK], motion))
            motion = motion + product(above.T, found[-1])
        return jnp.stack(found)


def product(a: Array, b: Array) -> Array:
    """a b of small matrices (..., n, m) and (..., m, k), as sums: a matrix product is slow for tiny ones."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def block_diagonal(blocks: Array) -> Array:
    """The block-diagonal matrix (n rows, n columns) of blocks (n, rows, columns)."""
    n, rows, columns = blocks.shape
    apart = jnp.eye(n, dtype=blocks.dtype)[:, None, :, None] * blocks[:, :, None]
    return apart.reshape(n * rows, n * columns)


@jax.custom_batching.custom_vmap
def eliminate(matrix: Array, columns: Array) -> Array:
    """The inverse of a matrix (n, n) times columns (n, k), by Gauss-Jordan elimination without pivoting.

    Made for many small matrices at once. Those of an arm are positive definite, or nearly symmetric and
    positive, and need no pivoting.

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
