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

import jax.numpy as jnp
from jax import Array

from mjx_softarm._support.small_matrices import block_diagonal, eliminate, identity, product


class ChainHessian(NamedTuple):
    """A symmetric matrix in blocks; the block of sections s < t is `above[s] @ below[t].T`.

    Matrices of many arms have the arms last; *arms may be empty.
    """

    own: Array  # (n_sections, n, n, *arms) blocks of each section's n joints
    above: Array  # (n_sections, n, rank, *arms)
    below: Array  # (n_sections, n, rank, *arms)

    def dense(self) -> Array:
        """Return the whole matrix (nv, nv) of one arm."""
        n_sections, n, _ = self.own.shape
        section = jnp.repeat(jnp.arange(n_sections), n)
        above, below = (x.reshape(section.size, -1) for x in (self.above, self.below))
        further_down = section[:, None] < section
        far = jnp.where(further_down, product(above, below.T), 0)
        return block_diagonal(self.own) + far + far.T

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
        found = []
        for above, solved in zip(self.above, reversed(reduced), strict=True):
            found.append(solved[:, rank:] - product(solved[:, :rank], motion))
            motion = motion + product(jnp.swapaxes(above, 0, 1), found[-1])
        return jnp.stack(found)
