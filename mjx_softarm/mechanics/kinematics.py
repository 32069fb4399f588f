"""Poses of the plates and of the joints, of the closed-form chain; `frames_of` reads them from MJX's data.

The arm is a chain of links. Each link joins a plate to the next one by a slide along the
parent plate's -z (positive = extension) and two perpendicular hinges half a link below. The first link
turns about x and then y, the next one about y and then x, and so on: in the same order, the hinges' small
twists would add up, and an arm bent sideways would turn about its length.
Joint coordinates are `q (3 * n_links,)`, ordered (slide [m], first hinge [rad], second hinge [rad]) link
by link.

Many arms come last in every shape, (..., *arms): one instruction then serves several arms. For one arm,
*arms is empty. A number that all arms share may have a 1 in their place.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support.lazy import mjx
from mjx_softarm._support.small_matrices import product, products
from mjx_softarm.mechanics.params import ArmParams, Mount
from mjx_softarm.sensing.pose import rotation_from_quaternion

DOFS_PER_LINK = 3


class Frames(NamedTuple):
    """Poses of the arm's plates and joints in the base frame (z up)."""

    plate_position: Array  # (n_links + 1, 3, *arms) [m], the first is the base
    plate_rotation: Array  # (n_links + 1, 3, 3, *arms), columns are the plate's axes
    axis: Array  # (n_links, 3 dofs, 3, *arms), unit vectors: slide, first and second hinge
    anchor: Array  # (n_links, 3, *arms) [m], the point both hinges turn about
    tip_position: Array  # (3, *arms) [m]
    tip_rotation: Array  # (3, 3, *arms)


def chain_kinematics(params: ArmParams) -> Callable[[Array], Frames]:
    """Return the closed form of an arm: a function from joint coordinates (nv, *arms) to its frames.

    It multiplies the links' rotations and adds the links' vectors. With arms, each number of `params` has
    the axes of the arms at its end, too.
    """
    return functools.partial(_chain_frames, params.link_length_m, params.mount)


def _chain_frames(link_length_m: Array, mount: Mount, q: Array) -> Frames:
    """Return the frames at q (nv, *arms) of a chain whose plates are link_length_m (n_links, *arms) apart."""
    # Rotations of the plates: each link turns the plate above it
    arms = q.shape[1:]
    slide, first, second = jnp.moveaxis(q.reshape(-1, DOFS_PER_LINK, *arms), 1, 0)  # (L, *arms) each
    y_first = np.arange(len(slide)).reshape(-1, *[1] * len(arms)) % 2 == 1
    base = jnp.broadcast_to(mount.base_rotation, (3, 3, *arms))
    local = _rotation(first, second, y_first)  # (L, 3, 3, *arms)
    chained = jax.lax.associative_scan(products, local)
    rotation = jax.vmap(product, in_axes=(None, 0))(base, chained)
    plate_rotation = jnp.concatenate([base[None], rotation])

    # Positions: half a link and the slide to the hinges, half a link on to the next plate
    parent, child = plate_rotation[:-1], plate_rotation[1:]
    half = 0.5 * link_length_m
    to_anchor = -(half + slide)[:, None] * parent[:, :, 2]
    to_plate = to_anchor - half[:, None] * child[:, :, 2]
    start = jnp.broadcast_to(mount.base_position_m, (3, *arms))
    plate_position = jnp.concatenate([start[None], start + jnp.cumsum(to_plate, axis=0)])

    # Axes of the joints: the second hinge turns with the first
    x, y, z = jnp.moveaxis(parent, 2, 0)  # (L, 3, *arms) each
    swapped = y_first[:, None]
    cos, sin = jnp.cos(first)[:, None], jnp.sin(first)[:, None]
    axis_2 = cos * jnp.where(swapped, x, y) + jnp.where(swapped, -sin, sin) * z
    last = plate_rotation[-1]
    return Frames(
        plate_position,
        plate_rotation,
        axis=jnp.stack([-z, jnp.where(swapped, y, x), axis_2], axis=1),
        anchor=plate_position[:-1] + to_anchor,
        tip_position=plate_position[-1] + jnp.sum(last * mount.tip_offset_m, axis=1),
        tip_rotation=product(last, jnp.broadcast_to(mount.tip_rotation, (3, 3, *arms))),
    )


def tip_of(data: mjx.Data) -> tuple[Array, Array]:
    """Return the tip's position (3,) [m] and rotation (3, 3) from MJX's data; its site is the last."""
    return data.site_xpos[-1], data.site_xmat[-1].reshape(3, 3)


def frames_of(model: mjx.Model, data: mjx.Data) -> Frames:
    """Return the frames of one arm from MJX's data after its kinematics.

    The model is from `mjx_softarm.mechanics.mjcf`: its bodies are the world, links and tools.
    """
    # A body's origin is its hinges' anchor; its plate hangs half a link below
    n_links = len(data.qpos) // DOFS_PER_LINK
    links = slice(1, n_links + 1)  # the world comes first
    rotation = data.xmat[links].reshape(n_links, 3, 3)
    anchor = data.xpos[links]
    half = -model.geom_pos[links, 2:]  # (n_links, 1) place of each link's ring; the base's ring comes first
    position = anchor - half * rotation[:, :, 2]
    base = rotation_from_quaternion(model.body_quat[1])
    tip_position, tip_rotation = tip_of(data)
    return Frames(
        plate_position=jnp.concatenate([model.geom_pos[:1], position]),
        plate_rotation=jnp.concatenate([base[None], rotation]),
        axis=data.xaxis[: n_links * DOFS_PER_LINK].reshape(n_links, DOFS_PER_LINK, 3),
        anchor=anchor,
        tip_position=tip_position,
        tip_rotation=tip_rotation,
    )


def _rotation(first: Array, second: Array, y_first: np.ndarray) -> Array:
    """Return Rx(first) Ry(second), or Ry(first) Rx(second) where `y_first`, (L, 3, 3, *arms)."""
    c1, s1, c2, s2 = jnp.cos(first), jnp.sin(first), jnp.cos(second), jnp.sin(second)
    zero = jnp.zeros_like(first)
    xy = [[c2, zero, s2], [s1 * s2, c1, -s1 * c2], [-c1 * s2, s1, c1 * c2]]
    yx = [[c1, s1 * s2, s1 * c2], [zero, c2, -s2], [-s1, c1 * s2, c1 * c2]]
    rows = [
        [jnp.where(y_first, b, a) for a, b in zip(*both, strict=True)] for both in zip(xy, yx, strict=True)
    ]
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)
