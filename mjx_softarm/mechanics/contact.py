"""Contact of the arm with the wall of a pipe, as an energy of the joint coordinates.

Balls on the arm's rings stand for its body, and points for its gripper. Each adds an energy phi(d) to the
arm's potential, with d the gap between ball and wall. Its force -phi' begins at zero, grows with the square
of the depth, and from `RAMP_M` on linearly. So phi has two continuous derivatives, and the Hessian stays
symmetric. Floors and ends of containers are not part of the wall. With a sim-to-real network, the wall acts
on the simulated body, not on the corrected one.

A joint i moves all that hangs on it by a twist x_i about the origin of the base frame. With g and G the first
and second derivatives of the energy by a ball's centre p, and A_p = [1, -p x], all balls below a link give

    w = sum A_p^T g,    M = sum A_p^T G A_p - [0; g x A_p],
    dV/dq_i = x_i w,    d2V/dq_i dq_j = x_i M x_j    for a joint j of this link and i not after it.

These are the wrench and the stiffness of a load in a chain of rigid bodies, of rank six between two sections.
"""

from __future__ import annotations

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm.mechanics.kinematics import Frames
from mjx_softarm.mechanics.pipe import Contact, CrossPipe

STIFFNESS_N_PER_M = 1e4  # of a ball; in single precision, its force is then exact to 1e-3 N
RAMP_M = 3e-3  # depth over which the stiffness grows: 1 N at 0.8 mm, 5 N at 1.7 mm
JAMMED_M = 0.01  # depth that no arm in the pipe is pushed to: its force is 85 N
DEEPEST_M = 4e-3  # depth that a Newton step may predict for a ball that is not yet so deep
_LEAST_SINE = 1e-3  # of the angle between the normals of the two cylinders, where these are nearly parallel


def ball_centres(contact: Contact, frames: Frames) -> Array:
    """Return the centres (3, k, *arms) [m] of the balls in the base frame."""
    plate, dtype, arms = np.array(contact.plate), frames.plate_position.dtype, frames.plate_position.shape[2:]
    x, y, z = (np.array(contact.centre_m, dtype)[:, i].reshape(-1, *[1] * (1 + len(arms))) for i in range(3))
    axes = jnp.moveaxis(frames.plate_rotation[plate], 2, 0)  # (3 axes, k, 3, *arms)
    return jnp.moveaxis(frames.plate_position[plate] + x * axes[0] + y * axes[1] + z * axes[2], 1, 0)


def ball_forces(contact: Contact, frames: Frames) -> Array:
    """Return the force (3, k, *arms) [N] of the wall on each ball."""
    return -_derivatives(contact, ball_centres(contact, frames))[0]


def wall_terms(contact: Contact, frames: Frames) -> tuple[Array, Array, Array]:
    """Return the derivatives of the energy by the joint coordinates.

    Args:
        contact: pipe and balls.
        frames: of the joint coordinates.

    Returns:
        Gradient (nv, *arms), and the Hessian in two factors (nv, 6, *arms): the entry of joints i and j is
        the product of row i of the first and row j of the second, for i not after j.
    """
    # First and second derivatives by the centres, and the wrenches of the balls
    once = jax.lax.optimization_barrier  # the compiler would compute numbers again for each use
    centre = once(ball_centres(contact, frames))
    force, curve = once(_derivatives(contact, centre))
    wrench = jnp.concatenate([force, _cross(centre, force)])  # (6, k, *arms)

    # Change of the wrenches by each of the six unit twists: shifts, then turns about the origin
    axes, columns = _axes(centre), []
    for move in (*axes, *(_cross(axis, centre) for axis in axes)):
        push = curve[0] * move[0] + curve[1] * move[1] + curve[2] * move[2]  # G times the displacement
        columns.append(jnp.concatenate([push, _cross(centre, push) + _cross(move, force)]))
    each = once(jnp.stack([wrench, *columns]))  # (7, 6, k, *arms)

    # Sums over all balls below each link, from the tip up: the balls are in the order of their plates
    ends = np.searchsorted(contact.plate, np.arange(1, contact.plate[-1] + 2))
    own = [jnp.sum(each[:, :, first:last], axis=2) for first, last in itertools.pairwise(ends)]
    sums = list(itertools.accumulate(reversed(own)))
    below = once(jnp.stack(sums[::-1], axis=2))  # (7, 6, L, *arms)

    # Twists of the joints: a slide along its axis, a hinge about a line through its anchor
    axis = jnp.moveaxis(frames.axis, 2, 0)  # (3, L, 3 dofs)
    anchor = jnp.moveaxis(frames.anchor, 1, 0)  # (3, L)
    slide, hinges = axis[:, :, :1], axis[:, :, 1:]
    arm = jnp.broadcast_to(anchor[:, :, None], hinges.shape)
    along = jnp.concatenate([slide, _cross(arm, hinges)], axis=2)
    about = jnp.concatenate([jnp.zeros_like(slide), hinges], axis=2)
    twist = once(jnp.concatenate([along, about]))  # (6, L, 3 dofs, *arms)

    # Gradient and the factors of the Hessian
    gradient = jnp.sum(twist * below[0][:, :, None], axis=0)  # (L, 3 dofs, *arms)
    change = sum(twist[i] * below[1 + i][:, :, None] for i in range(6))  # (6, L, 3 dofs, *arms)
    nv, arms = gradient.shape[0] * gradient.shape[1], gradient.shape[2:]
    twist, change = (jnp.moveaxis(x, 0, 2).reshape(nv, 6, *arms) for x in (twist, change))
    return gradient.reshape(nv, *arms), twist, change


def step_share(contact: Contact, before: Frames, after: Frames) -> Array:
    """Return the share (*arms) of a step that no wall stops: from 0 to 1.

    A whole step may carry balls far beyond the wall, whose forces then spoil the next step.
    """
    gaps = [_gaps(contact, ball_centres(contact, frames)) for frames in (before, after)]
    room, left = (gap + DEEPEST_M for gap in gaps)
    stops = (room > 0.0) & (left < 0.0)
    share = jnp.where(stops, room / jnp.where(stops, room - left, 1.0), 1.0)
    return jnp.min(share, axis=0)


def is_jammed(contact: Contact, frames: Frames) -> Array:
    """Return whether (*arms) bool a ball is so deep in the wall that the arm is stuck beyond an edge."""
    return jnp.any(_gaps(contact, ball_centres(contact, frames)) < -JAMMED_M, axis=0)


def _gaps(contact: Contact, centre: Array) -> Array:
    """Return the least gaps (k, *arms) [m] of balls with these centres (3, k, *arms) [m]."""
    radius = np.array(contact.radius_m, centre.dtype).reshape(-1, *[1] * (centre.ndim - 2))
    return pipe_distance(contact.pipe, centre) - radius


def _derivatives(contact: Contact, centre: Array) -> tuple[Array, list[Array]]:
    """Return g (3, k, *arms) and the three rows (3, k, *arms) of G at centres (3, k, *arms).

    Forward mode twice: XLA on CPUs takes forty times as long for forward over reverse.
    """
    axes, energy = _axes(centre), functools.partial(_energy, contact)
    rows: list[list[Array]] = [[], [], []]
    for i, axis in enumerate(axes):
        slope = functools.partial(lambda axis, at: jax.jvp(energy, (at,), (axis,))[1], axis)
        rows[i] = [rows[j][i] for j in range(i)] + [jax.jvp(slope, (centre,), (a,))[1] for a in axes[i:]]
    force = jnp.stack([jax.jvp(energy, (centre,), (axis,))[1] for axis in axes])
    return force, [jnp.stack(row) for row in rows]


def _axes(centre: Array) -> list[Array]:
    """Return the three unit displacements (3, k, *arms) of centres (3, k, *arms)."""
    return [jnp.zeros_like(centre).at[i].set(1.0) for i in range(3)]


def _energy(contact: Contact, centre: Array) -> Array:
    """Return the energies (k, *arms) [J] of balls with these centres (3, k, *arms) [m]."""
    return _phi(_gaps(contact, centre))


def _phi(gap: Array) -> Array:
    """Return the energy [J] of a ball at a gap [m]."""
    depth = jnp.maximum(-gap, 0.0)
    ramp = depth**3 / (6.0 * RAMP_M)
    beyond = 0.5 * depth * (depth - RAMP_M) + RAMP_M**2 / 6.0
    return STIFFNESS_N_PER_M * jnp.where(depth < RAMP_M, ramp, beyond)


def pipe_distance(pipe: CrossPipe, centre: Array) -> Array:
    """Return the distance (k, *arms) [m] of points (3, k, *arms) to the wall, positive inside the pipe.

    Where both cylinders hold a point, the wall is locally a wedge between their tangent planes. The distance
    to a wedge has a continuous gradient, which `mjx_softarm.mechanics.pipe.clearance` has not.
    """
    x, y, z = centre
    vertical, horizontal = (_norm(a, y) for a in (x, z - pipe.centre_z_m))
    inside = pipe.radius_m - vertical, pipe.radius_m - horizontal
    deep, shallow = jnp.maximum(*inside), jnp.minimum(*inside)
    cosine = y * y / jnp.maximum(vertical * horizontal, 1e-9)  # between the normals
    past = jnp.maximum(shallow - cosine * deep, 0.0)
    sine = jnp.sqrt(jnp.maximum(1.0 - cosine**2, _LEAST_SINE**2))
    return jnp.where(deep > 0.0, _norm(jnp.maximum(deep, 0.0), past / sine), deep)


def _norm(a: Array, b: Array) -> Array:
    """Return the length of (a, b), whose derivatives are zero at the origin."""
    square = a * a + b * b
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products (3, ...) of vectors whose components come first."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
