"""Cross-shaped pipe: its walls, its containers, and the clearance of the arm's body.

Two cylinders of one diameter cross below the arm's base: a vertical one, which the arm enters from above,
and a horizontal one along x. Positions are in the base frame (z up, the arm hangs towards -z). Functions take
one point or many, in NumPy or JAX. The distance to the wall ignores that the pipe ends at its outlets.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.mechanics.body import gripper_boxes, rim_points, ring_radius_m
from mjx_softarm.spec import ArmSpec

# Objects that the arm picks and places. Source: the paper's section on confined scenarios.
BALL_KG = 0.035  # a sponge ball
APPLE_KG = 0.220
RIM_POINTS = 16  # points of a ring; its rim is at most 1 - cos(pi / 16) = 1.9 % of its radius beyond them


@dataclass(frozen=True)
class CrossPipe:
    """Cross-shaped pipe in the base frame; its axes cross at x = y = 0."""

    diameter_mm: float

    # The same in all pipes
    centre_z_m = -0.55
    branch_m = 0.3  # from the centre to the outlets left, right and at the bottom
    top_z_m = 0.0  # the outlet that the arm enters, level with its base
    reach_m = 0.06  # depth of the containers in a branch; the nominal arm reaches 5 mm further
    drop_m = 0.05  # height of a branch's axis over the left and the right container

    def __post_init__(self) -> None:
        if not 0.0 < self.radius_m < self.branch_m - self.reach_m:
            raise ValueError(
                f"diameter_mm: got {self.diameter_mm!r}, expected more than 0 and less than "
                f"{2e3 * (self.branch_m - self.reach_m):g}, so that the branches hold their containers"
            )

    @property
    def radius_m(self) -> float:
        return 0.5e-3 * self.diameter_mm

    def containers(self) -> dict[str, np.ndarray]:
        """Return the finger tips' positions (3,) [m] in the left (-x), right and bottom container."""
        far, side_z = self.radius_m + self.reach_m, self.centre_z_m - self.drop_m
        return {
            "left": np.array([-far, 0.0, side_z]),
            "right": np.array([far, 0.0, side_z]),
            "bottom": np.array([0.0, 0.0, self.centre_z_m - far]),
        }


PIPES = {f"pipe{diameter_mm:g}": CrossPipe(diameter_mm) for diameter_mm in (300.0, 250.0, 200.0)}


def clearance(pipe: CrossPipe, position_m: Array) -> Array:
    """Return the distance (...) [m] to the wall from positions (..., 3) [m], positive inside.

    Near the edge where the pipes meet, it is a lower bound.
    """
    xp = array_namespace(position_m)
    x, y, z = (position_m[..., k] for k in range(3))
    vertical, horizontal = (_norm(xp, a, y) for a in (x, z - pipe.centre_z_m))
    return pipe.radius_m - xp.minimum(vertical, horizontal)


def _norm(xp, a: Array, b: Array) -> Array:
    """Return the length of (a, b), whose gradient is zero at the origin."""
    square = a * a + b * b
    return xp.sqrt(xp.where(square > 0.0, square, 1.0)) * (square > 0.0)


def body_points(plate_position: Array, plate_rotation: Array, spec: ArmSpec) -> Array:
    """Return points (..., RIM_POINTS * (L + 1) + 24, 3) [m] on all rims, then the corners of the gripper.

    Plates have positions (..., L + 1, 3) [m] and rotations (..., L + 1, 3, 3) from base to tip, as in
    `mjx_softarm.mechanics.kinematics.Frames`; the points are in their frame.
    """
    xp = array_namespace(plate_position, plate_rotation)
    circle = ring_radius_m(spec)[:, None, None] * rim_points(1.0, RIM_POINTS)  # (L + 1, RIM_POINTS, 3)
    rims = plate_position[..., None, :] + _turned(plate_rotation, circle)
    corners = plate_position[..., -1:, :] + _turned(plate_rotation[..., -1, :, :], _gripper(spec))
    return xp.concat([rims.reshape(*rims.shape[:-3], -1, 3), corners], axis=-2)


def _gripper(spec: ArmSpec) -> np.ndarray:
    """Return the corners (24, 3) of the gripper's boxes in the last plate's frame."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    middle = np.array([0.0, 0.0, -0.5 * spec.mass.gripper_length_m])
    return np.concatenate([middle + centre + signs * half for half, centre in gripper_boxes(spec).values()])


def _turned(rotation: Array, point: np.ndarray) -> Array:
    """Turn points (..., k, 3) by (..., 3, 3): (..., k, 3); no matrix product, which a GPU would round."""
    return (rotation[..., None, :, :] * point[..., None, :].astype(rotation.dtype)).sum(axis=-1)


def body_clearance(pipe: CrossPipe, plate_position: Array, plate_rotation: Array, spec: ArmSpec) -> Array:
    """Return the least `clearance` (...) [m] of the `body_points`."""
    return clearance(pipe, body_points(plate_position, plate_rotation, spec)).min(axis=-1)
