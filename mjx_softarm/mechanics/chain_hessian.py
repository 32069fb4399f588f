"""The Hessian of a chain of sections, and systems with it, each solved at a cost linear in the sections.

Tendons couple the joints of one section; only gravity couples joints of different sections. The second
derivative of gravity by a joint i and a joint j further down is a product of two numbers of i with two
numbers of j (see `mjx_softarm.mechanics.statics`), so the block between two sections has rank two. Block
elimination from the tip to the base keeps that form: the sections below act on a section as a reaction of
this rank, as in the articulated-body algorithm for rigid chains.

Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 7 (articulated bodies).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support.small_matrices import eliminate, identity, product, products


class ChainHessian(NamedTuple):
    """A symmetric matrix in blocks; the block of sections s < t is `above[s] @ below[t].T`.

    Matrices of many arms have the arms last; *arms may be empty.
    """

    own: Array  # (n_sections, n, n, *arms) blocks of each section's n joints
    above: Array  # (n_sections, n, rank, *arms)
    below: Array  # (n_sections, n, rank, *arms)

    @classmethod
    def of_factors(cls, above: Array, below: Array) -> ChainHessian:
        """Return the matrix whose entry (i, j) is row i of `above` times row j of `below`, for i not after j.

        Both factors are (n_sections, n, rank, *arms).
        """
        earlier_first = products(above, jnp.swapaxes(below, 1, 2))
        n = earlier_first.shape[1]
        upper = jnp.tri(n, dtype=bool).T.reshape(n, n, *[1] * (above.ndim - 3))
        own = jnp.where(upper, earlier_first, jnp.swapaxes(earlier_first, 1, 2))
        return cls(own, above, below)

    def plus(self, other: ChainHessian, times: float) -> ChainHessian:
        """Return the sum with a multiple of another matrix."""
        above = jnp.concatenate([self.above, other.above], axis=2)
        below = jnp.concatenate([self.below, times * other.below], axis=2)
        return ChainHessian(self.own + times * other.own, above, below)

    def times(self, x: Array) -> Array:
        """Return the product with a vector (nv, *arms)."""
        column = x.reshape(*self.own.shape[:2], 1, *x.shape[1:])
        up, down = (products(jnp.swapaxes(far, 1, 2), column) for far in (self.below, self.above))
        up = jax.lax.cumsum(up, reverse=True) - up  # of all sections further down: (n_sections, rank, 1)
        down = jnp.cumsum(down, axis=0) - down  # of all sections further up
        far = products(self.above, up) + products(self.below, down)
        return (products(self.own, column) + far).reshape(x.shape)

    def plus_diagonal(self, added: Array) -> ChainHessian:
        """Return the matrix with `added` (nv, *arms) on its diagonal."""
        n_sections, n = self.own.shape[:2]
        diagonal = added.reshape(n_sections, n, 1, *added.shape[1:]) * identity(n, self.own[0])
        return self._replace(own=self.own + diagonal)

    def solve(self, columns: Array) -> Array:
        """Return the inverse times columns (n_sections, n, k, *arms); NaN if not positive definite."""
        # From the tip to the base: eliminate each section, and add its reaction to those above
        (k, *arms), rank = columns.shape[2:], self.above.shape[2]
        reaction = jnp.zeros((rank, rank, *arms), columns.dtype)  # reaction of all sections further down
        pull = jnp.zeros((rank, k, *arms), columns.dtype)  # reaction of their columns
        reduced = []
        for own, above, below, column in reversed(list(zip(*self, columns, strict=True))):
            acted = product(above, reaction)
            right = jnp.concatenate([below - acted, column - product(above, pull)], axis=1)
            solved = eliminate(own - product(acted, jnp.swapaxes(above, 0, 1)), right)
            passed_on = product(jnp.swapaxes(below - acted, 0, 1), solved)
            reaction, pull = reaction + passed_on[:, :rank], pull + passed_on[:, rank:]
            reduced.append(solved)
        # From the base to the tip: substitute
        motion = jnp.zeros_like(pull)  # motion of all sections further up
        solution = []
        for above, solved in zip(self.above, reversed(reduced), strict=True):
            solution.append(solved[:, rank:] - product(solved[:, :rank], motion))
            motion = motion + product(jnp.swapaxes(above, 0, 1), solution[-1])
        return jnp.stack(solution)


@jax.custom_vjp
def solve_approximate_gradient(matrix: ChainHessian, columns: Array) -> Array:
    """Return `matrix.solve(columns)`, whose gradient is by the columns alone, as of a constant matrix."""
    return matrix.solve(columns)


solve_approximate_gradient.defvjp(
    lambda matrix, columns: (matrix.solve(columns), matrix),
    lambda matrix, d_solution: (None, matrix.solve(d_solution)),
)
