"""Meshes of the arm's parts, each with its axis along z."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import Delaunay
from trimesh import creation

from mjx_softarm.mechanics.body import gripper_boxes
from mjx_softarm.spec import ArmSpec

Mesh = trimesh.Trimesh


def disc(radius_m: float, height_m: float) -> Mesh:
    """Return a flat cylinder."""
    return creation.cylinder(radius_m, height_m, sections=48)


def fold(radius_m: float) -> Mesh:
    """Return one convolution of a bellows, of height 1."""
    height = np.linspace(-0.5, 0.5, 7)
    profile = np.stack([radius_m * (0.86 + 0.14 * np.cos(2 * np.pi * height)), height], axis=-1)
    return creation.revolve(profile, sections=18)


def coil(radius_m: float, wire_m: float, pitch_m: float) -> Mesh:
    """Return one turn of a spring, of height 1; stretched to the pitch, its wire is round."""
    n, n_wire = 13, 4  # points along the turn, and around the wire
    along, about = np.meshgrid(np.linspace(0, 2 * np.pi, n), 2 * np.pi * np.arange(n_wire) / n_wire)
    out = radius_m + wire_m * np.cos(about)
    height = along / (2 * np.pi) - 0.5 + wire_m / pitch_m * np.sin(about)
    vertices = np.stack([out * np.cos(along), out * np.sin(along), height], axis=-1)  # (n_wire, n, 3)
    here = np.arange(n_wire * n).reshape(n_wire, n)
    a, c = here[:, :-1], here[:, 1:]
    b, d = (np.roll(side, -1, axis=0) for side in (a, c))
    faces = np.concatenate([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)])
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)


def workspace_hull(point_m: np.ndarray) -> Mesh:
    """Return the surface around points (m, 3) [m]; it follows hollows wider than a tenth of the extent.

    Source: Edelsbrunner, Muecke, "Three-dimensional alpha shapes", ACM Transactions on Graphics 13, 1994.
    """
    # Keep the tetrahedra with small circumscribed spheres.
    corners = Delaunay(point_m).simplices  # (tetrahedra, 4)
    edge = point_m[corners[:, 1:]] - point_m[corners[:, :1]]
    square, across = np.sum(edge**2, axis=-1), np.cross(edge[:, [1, 2, 0]], edge[:, [2, 0, 1]])
    volume = np.abs(np.sum(edge[:, 0] * across[:, 0], axis=-1))
    radius_m = np.linalg.norm(np.einsum("tk,tkx->tx", square, across), axis=-1) / np.maximum(
        2 * volume, 1e-18
    )
    corners = corners[radius_m < np.ptp(point_m, axis=0).max() / 10.0]
    # Their surface consists of the faces of one tetrahedron alone.
    faces = np.concatenate([np.delete(corners, k, axis=1) for k in range(4)])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return Mesh(point_m, faces[first[count == 1]], process=False)


def gripper(spec: ArmSpec) -> Mesh:
    """Return the gripper below the tip, in the tip's frame."""
    middle = np.array([0.0, 0.0, -spec.mass.gripper_length_m / 2])
    boxes = [
        creation.box(bounds=middle + centre_m + np.array([-half_m, half_m]))
        for half_m, centre_m in gripper_boxes(spec).values()
    ]
    return trimesh.util.concatenate(boxes)  # pyright: ignore[reportReturnType]
