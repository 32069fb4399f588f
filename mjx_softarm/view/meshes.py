"""Meshes of the arm's parts, each with its axis along z."""

from __future__ import annotations

import numpy as np
import trimesh
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


def coil(radius_m: float, wire_m: float, pitch_m: float, n: int = 13, n_wire: int = 4) -> Mesh:
    """Return one turn of a spring, of height 1; its wire is round where that is stretched to the pitch."""
    along, about = np.meshgrid(np.linspace(0, 2 * np.pi, n), 2 * np.pi * np.arange(n_wire) / n_wire)
    out = radius_m + wire_m * np.cos(about)
    height = along / (2 * np.pi) - 0.5 + wire_m / pitch_m * np.sin(about)
    vertices = np.stack([out * np.cos(along), out * np.sin(along), height], axis=-1)  # (n_wire, n, 3)
    here = np.arange(n_wire * n).reshape(n_wire, n)
    a, c = here[:, :-1], here[:, 1:]
    b, d = (np.roll(side, -1, axis=0) for side in (a, c))
    faces = np.concatenate([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)])
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)


def gripper(spec: ArmSpec) -> Mesh:
    """Return the gripper below the tip, in the tip's frame."""
    middle = np.array([0.0, 0.0, -spec.mass.gripper_length_m / 2])
    boxes = [
        creation.box(bounds=middle + centre_m + np.array([-half_m, half_m]))
        for half_m, centre_m in gripper_boxes(spec).values()
    ]
    return trimesh.util.concatenate(boxes)  # pyright: ignore[reportReturnType]
