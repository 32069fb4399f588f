"""Poses of the plates and of the joints, from MJX or from the closed-form chain.

The arm is a chain of links. Each link joins a plate to the next one by a slide along the
parent plate's -z (positive = extension) and two perpendicular hinges, x then y, half a link below;
joint coordinates are `q (3 * n_links,)`, ordered (slide [m], hinge x [rad], hinge y [rad]) link by link.
Both engines return the same `Frames`; everything downstream is shared.

Many arms come last in every shape, (..., *arms): one instruction then serves several arms. For one arm,
*arms is empty. A number that all arms share may have a 1 in their place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support.lazy import mjx
from mjx_softarm._support.small_matrices import product, products
from mjx_softarm.mechanics.params import LEVEL, ArmParams, Mount
from mjx_softarm.sensing.pose import rotation_from_quaternion

DOFS_PER_LINK = 3


class Frames(NamedTuple):
    """Poses of the arm's plates and joints in the base frame (z up)."""

    plate_position: Array  # (n_links + 1, 3, *arms) [m], the first is the base
    plate_rotation: Array  # (n_links + 1, 3, 3, *arms), columns are the plate's axes
    axis: Array  # (n_links, 3 dofs, 3, *arms), unit vectors: slide, hinge x, hinge y
    anchor: Array  # (n_links, 3, *arms) [m], the point both hinges turn about
    tip_position: Array  # (3, *arms) [m]
    tip_rotation: Array  # (3, 3, *arms)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class ChainKinematics:
    """Closed form: products of the links' rotations, sums of the links' vectors."""

    link_length_m: Array | np.ndarray  # (n_links, *arms) distance of a link's plates at rest
    mount: Mount = LEVEL

    def __call__(self, q: Array) -> Frames:
        arms = q.shape[1:]

        def of_arms(x: Array | np.ndarray, *shape: int) -> Array:
            """Return a number of the mount (*shape, *arms), from one that may be without arms."""
            x = jnp.asarray(x, q.dtype)
            if x.ndim == len(shape):
                x = x.reshape(*shape, *[1] * len(arms))
            return jnp.broadcast_to(x, (*shape, *arms))

        # Rotations of the plates: each link turns the plate above it
        slide, bend_x, bend_y = jnp.moveaxis(q.reshape(-1, DOFS_PER_LINK, *arms), 1, 0)  # (L, *arms) each
        base = of_arms(self.mount.base_rotation, 3, 3)
        local = _rotation_xy(bend_x, bend_y)  # (L, 3, 3, *arms)
        chained = jax.lax.associative_scan(products, local)
        rotation = jax.vmap(product, in_axes=(None, 0))(base, chained)
        plate_rotation = jnp.concatenate([base[None], rotation])

        # Positions: half a link and the slide to the hinges, half a link on to the next plate
        parent, child = plate_rotation[:-1], plate_rotation[1:]
        half = 0.5 * self.link_length_m
        to_anchor = -(half + slide)[:, None] * parent[:, :, 2]
        to_plate = to_anchor - half[:, None] * child[:, :, 2]
        start = of_arms(self.mount.base_position_m, 3)
        plate_position = jnp.concatenate([start[None], start + jnp.cumsum(to_plate, axis=0)])

        # Axes of the joints: the second hinge turns with the first
        cos, sin = jnp.cos(bend_x)[:, None], jnp.sin(bend_x)[:, None]
        axis_y = cos * parent[:, :, 1] + sin * parent[:, :, 2]
        axis = jnp.stack([-parent[:, :, 2], parent[:, :, 0], axis_y], axis=1)
        last = plate_rotation[-1]
        return Frames(
            plate_position,
            plate_rotation,
            axis,
            anchor=plate_position[:-1] + to_anchor,
            tip_position=plate_position[-1] + jnp.sum(last * of_arms(self.mount.tip_offset_m, 3), axis=1),
            tip_rotation=product(last, of_arms(self.mount.tip_rotation, 3, 3)),
        )


def chain_kinematics(params: ArmParams) -> ChainKinematics:
    """Return the closed-form kinematics of an arm."""
    return ChainKinematics(params.link_length_m, params.mount)


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
    return Frames(
        plate_position=jnp.concatenate([model.geom_pos[:1], position]),
        plate_rotation=jnp.concatenate([base[None], rotation]),
        axis=data.xaxis[: n_links * DOFS_PER_LINK].reshape(n_links, DOFS_PER_LINK, 3),
        anchor=anchor,
        tip_position=tip_of(data)[0],
        tip_rotation=tip_of(data)[1],
    )


def _rotation_xy(x: Array, y: Array) -> Array:
    """Return Rx(x) Ry(y), (L, 3, 3, *arms)."""
    cx, sx, cy, sy = jnp.cos(x), jnp.sin(x), jnp.cos(y), jnp.sin(y)
    zero = jnp.zeros_like(x)
    rows = [[cy, zero, sy], [sx * sy, cx, -sx * cy], [-cx * sy, sx, cx * cy]]
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)
