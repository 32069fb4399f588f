"""Potential energy of the arm in closed form: gradient, Hessian, and lengths of the tendons.

At given pressures p the arm is conservative. With l the chamber lengths and s the spring lengths,

    V(q) = gravity + backbone + sum k (l - l0)^2 / 2 + sum k_s (s - s0)^2 / 2 - sum p W(l),

where W' = area_m2 + area_slope_m (l - L) is a chamber's effective area and L the section's length: p W is the
work of the air. A tendon runs from ring to ring, so a segment depends on the three joints of its link
alone, and a length on the joints of its section. Only gravity couples sections.

A chamber that is bonded to every ring of its n links is n springs in series that share no force, each of
stiffness n k and rest length l0 / n. A share b of it, `bonded_share`, adds to a free chamber's energy

    b [sum_i n k (l_i - l0 / n)^2 / 2 - k (l - l0)^2 / 2]  =  b n k / 2  sum_i (l_i - l / n)^2,

with the lengths l_i of its segments, whose sum is l. So b = 1 is a bonded chamber, exactly, and any b leaves
sections of like segments as they are. Segment i pulls with k (l - l0) + b k (n l_i - l).

Many arms come last in every shape, (..., *arms), as in `mjx_softarm.mechanics.kinematics`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support.small_matrices import block_diagonal, products
from mjx_softarm.mechanics.chain_hessian import ChainHessian
from mjx_softarm.mechanics.kinematics import DOFS_PER_LINK, Frames
from mjx_softarm.mechanics.params import ArmParams

GRAVITY_M_S2 = 9.81


class Tendons(NamedTuple):
    """Lengths of t tendons a section with first and second derivatives, by the joints that they depend on."""

    length: Array  # (n_sections, t, *arms) [m]
    segment: Array  # (n_sections, t, links per section, *arms) [m] lengths from ring to ring
    jacobian: Array  # (n_sections, t, n, *arms) by the n joints of a section
    link_hessian: Array  # (3 dofs, 3 dofs, t, n_links, *arms) by the joints of a link

    def changed(self, dq: Array) -> Tendons:
        """Return the change of lengths and Jacobians along joint velocities (nv, *arms); others are zero."""
        n_sections, arms = len(self.length), dq.shape[1:]
        along = dq.reshape(n_sections, 1, -1, *arms)
        of_joint = jnp.moveaxis(dq.reshape(-1, DOFS_PER_LINK, *arms), 1, 0)[:, None, None]
        turned = jnp.sum(self.link_hessian * of_joint, axis=0)  # (3 dofs, t, n_links, *arms)
        zeros = jnp.zeros_like(self.link_hessian)
        stretch = self.jacobian * along
        segment = _by_link(stretch, self.segment.shape[2]).sum(axis=3)
        return Tendons(jnp.sum(stretch, axis=2), segment, _by_section(turned, n_sections), zeros)


class Lines(NamedTuple):
    """Lengths and Jacobians of the chambers, or of the springs."""

    length: Array  # (n_chambers or n_springs, *arms) [m]
    jacobian: Array  # (n_sections, c or s, n, *arms) by the n joints of a section

    def forces(self, tension: Array) -> Array:
        """Return each one's force (n_sections, n, c or s of all sections, *arms) on each section's joints."""
        n_sections, _, n, *arms = self.jacobian.shape
        pull = self.jacobian * tension.reshape(n_sections, -1, 1, *arms)
        return block_diagonal(jnp.swapaxes(pull, 1, 2)).reshape(n_sections, n, -1, *arms)


class Statics(NamedTuple):
    """Derivatives of the potential at given joint coordinates and pressures."""

    gradient: Array  # (nv, *arms) [N, N m]
    hessian: ChainHessian
    chambers: Lines
    springs: Lines
    area: Array  # (n_chambers, *arms) [N/kPa] effective areas

    def changed(self, moved: tuple[Array, Array]) -> Array:
        """Return the change of the gradient along joint velocities (nv, *arms) and rates of the pressures."""
        dq, dp = moved
        force = (self.area * dp).reshape(*self.chambers.jacobian.shape[:2], 1, *dp.shape[1:])
        return self.hessian.times(dq) - jnp.sum(force * self.chambers.jacobian, axis=1).reshape(dq.shape)

    @property
    def push_per_kpa(self) -> Array:
        """(n_sections, n, n_chambers, *arms) generalised force of each chamber on each section's joints."""
        return self.chambers.forces(self.area)


@jax.jit  # traced once for all of its callers
def statics(frames: Frames, q: Array, pressure_kpa: Array, params: ArmParams) -> Statics:
    """Return gradient and Hessian of V(q) at joint coordinates q (nv, *arms) with these frames.

    The pressures (n_chambers, *arms) [kPa] are fixed.
    """
    return statics_of(all_tendons(frames, params), frames, q, pressure_kpa, params)


def all_tendons(frames: Frames, params: ArmParams) -> Tendons:
    """Return the tendons of each section: its chambers, then its springs."""
    sites = params.chamber_site_m, params.spring_site_m
    arms = jnp.broadcast_shapes(*(site.shape[3:] for site in sites))
    both = [jnp.broadcast_to(site, (*site.shape[:3], *arms)) for site in sites]
    return tendons(frames, jnp.concatenate(both, axis=1))  # one call: fewer and larger operations


def chambers_and_springs(both: Tendons, params: ArmParams) -> tuple[Lines, Lines]:
    """Return the chambers and the springs among the tendons of `all_tendons`."""
    n, arms = params.chamber_site_m.shape[1], both.length.shape[2:]
    parts = ((both.length[:, part], both.jacobian[:, part]) for part in (slice(None, n), slice(n, None)))
    chambers, springs = (Lines(length.reshape(-1, *arms), jacobian) for length, jacobian in parts)
    return chambers, springs


def statics_of(both: Tendons, frames: Frames, q: Array, pressure_kpa: Array, params: ArmParams) -> Statics:
    """Return gradient and Hessian of V(q) as `statics`, with the tendons of `all_tendons` given."""
    # Tension of each tendon, and its slope by the tendon's length: (n_sections, c + s, *arms)
    chambers, springs = chambers_and_springs(both, params)
    area = params.area + params.area_slope * (chambers.length - params.free_length_m)
    tension = joined(
        params.chamber_stiffness * (chambers.length - params.chamber_rest_m) - area * pressure_kpa,
        params.spring_stiffness * (springs.length - params.spring_rest_m),
        params.n_sections,
    )
    of_chambers = params.chamber_stiffness - params.area_slope * pressure_kpa
    of_springs = jnp.broadcast_to(params.spring_stiffness, springs.length.shape)
    slope = joined(of_chambers, of_springs, params.n_sections)

    # Gradient and Hessian: gravity, joints, tendons and bonds
    weight, hessian = _gravity(frames, params)
    pull = jnp.sum(tension[:, :, None] * both.jacobian, axis=1)  # (n_sections, n, *arms)
    own = hessian.own + _bending(tension, both.link_hessian) + stretching(slope, both.jacobian)
    if params.bonded_share is not None:
        bond_pull, bond_hessian = _bonds(both, params.bonded_share, params)
        pull, own = pull + bond_pull, own + bond_hessian
    gradient = weight + params.joint_stiffness * q + pull.reshape(q.shape)
    hessian = hessian._replace(own=own).plus_diagonal(params.joint_stiffness)
    return Statics(gradient, hessian, chambers, springs, area)


def _bonds(both: Tendons, share: Array, params: ArmParams) -> tuple[Array, Array]:
    """Return gradient (n_sections, n, *arms) and Hessian (n_sections, n, n, *arms) of the bonds' energy."""
    # Stiffness of each bond, and the pull of each segment beyond that of its chamber
    c, links = params.chamber_site_m.shape[1], both.segment.shape[2]
    length, segment, jacobian = (x[:, :c] for x in (both.length, both.segment, both.jacobian))
    stiffness = share * params.chamber_stiffness
    stiffness = stiffness.reshape(-1, c, *stiffness.shape[1:])
    tension = stiffness[:, :, None] * (links * segment - length[:, :, None])  # (n_sections, c, links, *arms)

    # Each segment's own second derivatives, less the chambers' as a whole
    by_link = _by_link(jacobian, links)
    per_link = jnp.sum(tension[:, :, :, None] * by_link, axis=1)  # (n_sections, links, 3 dofs, *arms)
    curve = jnp.moveaxis(both.link_hessian[:, :, :c], 3, 0)  # (n_links, 3 dofs, 3 dofs, c, *arms)
    curve = curve.reshape(-1, links, *curve.shape[1:])
    pulls = jnp.moveaxis(tension, 1, 2)[:, :, None, None]
    steep = jnp.moveaxis(by_link * (links * stiffness)[:, :, None, None], 1, 3)  # (n_sections, links, 3, c)
    flat = jnp.moveaxis(by_link, 1, 3)
    own = jnp.sum(pulls * curve + steep[:, :, :, None] * flat[:, :, None], axis=4)
    whole = stretching(-stiffness, jacobian)
    return per_link.reshape(len(length), -1, *tension.shape[3:]), jax.vmap(block_diagonal)(own) + whole


def _by_link(of_joints: Array, links: int) -> Array:
    """Return numbers (n_sections, t, n, *arms) of joints as (n_sections, t, links, 3 dofs, *arms)."""
    n_sections, t, _, *arms = of_joints.shape
    return of_joints.reshape(n_sections, t, links, DOFS_PER_LINK, *arms)


def joined(of_chambers: Array, of_springs: Array, n_sections: int) -> Array:
    """Join numbers (n_chambers, *arms) and (n_springs, *arms) by section: (n_sections, c + s, *arms)."""
    parts = (x.reshape(n_sections, -1, *x.shape[1:]) for x in (of_chambers, of_springs))
    return jnp.concatenate(list(parts), axis=1)


def _bending(tension: Array, link_hessian: Array) -> Array:
    """Sum tensions (n_sections, t, *arms) times second derivatives of lengths: (n_sections, n, n, *arms)."""
    n_sections, _, *arms = tension.shape
    per_section = link_hessian.shape[3] // n_sections
    per_link = jnp.repeat(jnp.swapaxes(tension, 0, 1), per_section, axis=1)  # (t, n_links, *arms)
    links = jnp.sum(per_link * link_hessian, axis=2)  # (3 dofs, 3 dofs, n_links, *arms)
    blocks = jnp.moveaxis(links, 2, 0).reshape(n_sections, per_section, *links.shape[:2], *arms)
    return jax.vmap(block_diagonal)(blocks)


def stretching(slope: Array, jacobian: Array) -> Array:
    """Return sum_t slope_t dl_t dl_t^T over the tendons of each section: (n_sections, n, n, *arms).

    Slopes (n_sections, t, *arms) are derivatives of the tensions by the lengths, the Jacobian
    (n_sections, t, n, *arms) those of the lengths by the joints.
    """
    return products(jnp.swapaxes(jacobian, 1, 2), slope[:, :, None] * jacobian)


def tendons(frames: Frames, site_m: Array) -> Tendons:
    """Return lengths of tendons through holes in the rings, with derivatives.

    `site_m` (n_sections, t, 2, *arms) are x and y of each tendon's hole in every ring of its section. Vectors
    are lists of three components (t, n_links, *arms): one instruction serves many links.
    """
    # Segments of the tendons from the upper to the lower ring of each link
    (n_sections, t), n_links, arms = site_m.shape[:2], frames.axis.shape[0], frames.axis.shape[3:]
    per_section = n_links // n_sections
    x, y = jnp.swapaxes(jnp.repeat(site_m, per_section, axis=0), 0, 2)  # (t, n_links, *arms) each
    plate, ring = jnp.moveaxis(frames.plate_position, 0, 1), jnp.moveaxis(frames.plate_rotation, 0, 2)
    upper = [plate[i, :-1] + ring[i, 0, :-1] * x + ring[i, 1, :-1] * y for i in range(3)]
    lower = [plate[i, 1:] + ring[i, 0, 1:] * x + ring[i, 1, 1:] * y for i in range(3)]
    segment = [low - up for low, up in zip(lower, upper, strict=True)]
    length = jnp.sqrt(_dot(segment, segment))
    unit = [component / length for component in segment]

    # Motion of the lower hole by each joint of its link, and the length's derivative
    anchor, axes = jnp.swapaxes(frames.anchor, 0, 1), jnp.moveaxis(frames.axis, 0, 2)  # (3 dofs, 3, n_links)
    lever = [low - at for low, at in zip(lower, anchor, strict=True)]
    hole_motion = [list(axes[0]), *(_cross(hinge, lever) for hinge in axes[1:])]
    dlength_dq = [_dot(unit, motion) for motion in hole_motion]

    def second(i: int, j: int) -> Array:
        """Return the second derivative of the length by the i-th joint of a link and one not before it."""
        curve = (_dot(hole_motion[i], hole_motion[j]) - dlength_dq[i] * dlength_dq[j]) / length
        return curve if i == 0 else curve + _dot(unit, _cross(axes[i], hole_motion[j]))

    # Sums over the links of each section
    dofs = range(DOFS_PER_LINK)
    upper_half = {(i, j): second(i, j) for i in dofs for j in dofs[i:]}
    whole = length.reshape(t, n_sections, per_section, *arms).sum(2)
    return Tendons(
        length=jnp.swapaxes(whole, 0, 1),
        segment=jnp.swapaxes(length.reshape(t, n_sections, per_section, *arms), 0, 1),
        jacobian=_by_section(jnp.stack(dlength_dq), n_sections),
        link_hessian=jnp.stack([jnp.stack([upper_half[min(i, j), max(i, j)] for j in dofs]) for i in dofs]),
    )


def _by_section(of_joints: Array, n_sections: int) -> Array:
    """Return numbers (3 dofs, t, n_links, *arms) of tendons and joints as (n_sections, t, n, *arms)."""
    _, t, n_links, *arms = of_joints.shape
    apart = of_joints.reshape(DOFS_PER_LINK, t, n_sections, n_links // n_sections, *arms)
    return jnp.swapaxes(jnp.moveaxis(apart, 0, 3), 0, 1).reshape(n_sections, t, -1, *arms)


def _dot(a: Sequence[Array] | Array, b: Sequence[Array] | Array) -> Array:
    """Return the inner products of vectors whose components come first."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Sequence[Array] | Array, b: Sequence[Array] | Array) -> list[Array]:
    """Return the components of the cross products of vectors whose components come first."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _gravity(frames: Frames, params: ArmParams) -> tuple[Array, ChainHessian]:
    """Return gradient (nv, *arms) and Hessian of the weights' potential.

    With M and c the mass and the centre of mass of all that hangs on a joint, and w = M a for a slide,
    w = M a x (c - o) for a hinge: the gradient is g w_z; the second derivative by an earlier hinge i and
    a joint j is g (a_i x w_j)_z, and none by an earlier slide.
    """
    # Mass and moment of all that hangs on each link, from the tip up
    arms, n_sections = frames.axis.shape[3:], params.n_sections
    last = frames.plate_rotation[-1]
    tool = frames.plate_position[-1] - params.tool_offset_m[:, None] * last[:, 2]  # (2, 3, *arms)
    links = jax.lax.cumsum(params.link_mass_kg[:, None] * frames.anchor, reverse=True)  # (L, 3, *arms)
    moment = links + jnp.sum(params.tool_mass_kg[:, None] * tool, axis=0)
    mass = jax.lax.cumsum(params.link_mass_kg, reverse=True) + jnp.sum(params.tool_mass_kg, axis=0)
    hung = moment - mass[:, None] * frames.anchor

    # Joint by joint: w, and the axis of a hinge
    slide, hinges = (jnp.moveaxis(axes, 2, 0) for axes in (frames.axis[:, :1], frames.axis[:, 1:]))
    turn = _cross(hinges, jnp.moveaxis(hung[:, None], 2, 0))  # (L, 2 hinges, *arms) each

    def by_section(of_slides: Array, of_hinges: Array) -> Array:
        """Join numbers of the joints of each link (L, 1, *arms), (L, 2, *arms): (n_sections, n, *arms)."""
        return jnp.concatenate([of_slides, of_hinges], axis=1).reshape(n_sections, -1, *arms)

    w = [GRAVITY_M_S2 * by_section(mass[:, None] * slide[i], turn[i]) for i in range(3)]
    axis = [by_section(jnp.zeros_like(slide[i]), hinges[i]) for i in range(2)]  # a slide turns nothing

    # Second derivatives in two factors
    above, below = jnp.stack([axis[0], -axis[1]], axis=2), jnp.stack([w[1], w[0]], axis=2)
    gradient = w[2].reshape(-1, *arms)
    return gradient, ChainHessian.of_factors(above, below)
