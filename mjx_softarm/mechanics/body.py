"""Outer shape of the arm, for drawing, collisions and distances to a wall.

Rings, which hold the springs, are the widest part of a link; below the last one hangs the gripper, a palm
and two fingers, all boxes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm.posture import base_rotation
from mjx_softarm.sensing.estimator import Frame, backbone
from mjx_softarm.sensing.pose import quaternion_from_rotation
from mjx_softarm.spec import ArmSpec

FOLDS, COILS = 12, 20  # folds of a bellows, coils of a spring
SPRING_WIDTH_M = 0.002  # radius of a spring, outside the circle that the springs stand on


def ring_radius_m(spec: ArmSpec) -> np.ndarray:
    """Return the outer radii of the rings (n_links + 1,) [m] from the base; two sections share the larger."""
    section = np.array(spec.per_section(spec.geometry.spring_radius_m))
    of_links = np.repeat(section, spec.structure.links_per_section)
    return np.maximum(np.append(of_links[0], of_links), np.append(of_links, of_links[-1])) + SPRING_WIDTH_M


def chamber_directions(spec: ArmSpec) -> np.ndarray:
    """Return the unit vectors (n_sections, c, 2), x and y, from the axis of a section to its chambers."""
    n = spec.structure.chambers_per_section
    first = np.radians(np.add(spec.per_section(spec.geometry.first_chamber_deg), spec.section_roll_deg))
    angle = first[:, None] + 2 * np.pi * np.arange(spec.n_chambers).reshape(-1, n) / n
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def spring_directions(spec: ArmSpec) -> np.ndarray:
    """Return the unit vectors (n_sections, s, 2), x and y, from the axis of a section to its springs."""
    return chamber_directions(spec)[:, :: spec.structure.chambers_per_section // spec.springs_per_section]


def holes_m(directions: np.ndarray, radius_m: tuple[float, ...]) -> np.ndarray:
    """Return holes (n_sections, k, 2) [m] in these directions on a circle of each section's radius."""
    return np.array(radius_m)[:, None, None] * directions


def rim_points(radius_m: float, n: int = 16) -> np.ndarray:
    """Return points (n, 3) [m] on a circle about z, at equal distances, the first on +x."""
    angle = 2 * np.pi * np.arange(n) / n
    return radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=-1)


def gripper_boxes(spec: ArmSpec) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return each box by name: half sizes (3,) and centre (3,) [m] from the gripper's middle, z up."""
    quarter = 0.25 * spec.mass.gripper_length_m
    return {
        "palm": (np.array([0.022, 0.022, quarter]), np.array([0.0, 0.0, quarter])),
        "finger0": (np.array([0.005, 0.010, quarter]), np.array([-0.02, 0.0, -quarter])),
        "finger1": (np.array([0.005, 0.010, quarter]), np.array([0.02, 0.0, -quarter])),
    }


def payload_radius_m(payload_kg: float) -> float:
    """Return the radius of the ball drawn for a payload; the ball collides with nothing."""
    return 0.03 * payload_kg ** (1 / 3) + 0.01


class Copies(NamedTuple):
    """Places of the copies of one mesh."""

    position_m: np.ndarray  # (k, 3)
    quaternion: np.ndarray  # (k, 4) w, x, y, z
    scale: np.ndarray  # (k, 3) along the axes of the mesh, whose size is 1: width, width, pitch [m]


class ArmShape(NamedTuple):
    """Places of all drawn parts. Bellows and springs are ordered as in the model, each from its upper end."""

    rings: Copies  # links_per_section in each section, their radii as widths, of pitch 1; without the base's
    folds: Copies  # FOLDS in each bellows, its radius as width
    coils: Copies  # COILS in each spring, of width 1


def shape(spec: ArmSpec, spring_m: np.ndarray, tip: np.ndarray) -> ArmShape:
    """Return the shape of an arm with springs (n_springs,) [m] and its tip at a pose (6,) [mm, deg]."""
    # Frames along the axis of each section, as shares of its length: rings, folds, coils
    geometry, n_rings = spec.geometry, spec.structure.links_per_section
    spring_site_m = holes_m(spring_directions(spec), spec.per_section(geometry.spring_radius_m))
    base = Frame(np.array(spec.mounting.base_offset_m), base_rotation(spec))
    steps = [(np.arange(n) + 0.5) / n for n in (FOLDS, COILS)]
    shares = np.concatenate([(np.arange(n_rings) + 1.0) / n_rings, *steps])
    sections = backbone(base, spring_site_m, spring_m, tip, shares)
    rings, folds, coils = (
        Frame(*(part[:, rows] for part in sections))
        for rows in np.split(np.arange(len(shares)), [n_rings, n_rings + FOLDS])
    )

    # Rings stand on the axis, folds and coils beside it
    centres = rings.position_m.reshape(-1, 3)
    upright = quaternion_from_rotation(rings.rotation.reshape(-1, 3, 3))
    radius_m = ring_radius_m(spec)[1:]
    chamber_site_m = holes_m(chamber_directions(spec), spec.per_section(geometry.chamber_radius_m))
    bellows_m = 0.5 * np.array(spec.per_section(geometry.chamber_diameter_m))
    return ArmShape(
        Copies(centres, upright, np.stack([radius_m, radius_m, np.ones(len(centres))], axis=-1)),
        _beside(folds, chamber_site_m, bellows_m),
        _beside(coils, spring_site_m, np.ones(len(bellows_m))),
    )


def _beside(line: Frame, hole_m: np.ndarray, width_m: np.ndarray) -> Copies:
    """Return copies beside each section's axis (n_sections, k), through its holes (n_sections, h, 2).

    Copies of a section have the width (n_sections,) of that section.
    """
    aside = np.einsum("skij,shj->shki", line.rotation[..., :2], hole_m)
    position_m = line.position_m[:, None] + aside  # (n_sections, h, k, 3)
    n_holes, n_copies = position_m.shape[1:3]
    quaternion = np.repeat(quaternion_from_rotation(line.rotation)[:, None], n_holes, axis=1)
    pitch_m = np.linalg.norm(np.diff(position_m, axis=2), axis=-1).mean(axis=-1)
    wide_m = np.repeat(width_m, n_holes)
    scale = np.repeat(np.stack([wide_m, wide_m, pitch_m.ravel()], axis=-1), n_copies, axis=0)
    return Copies(position_m.reshape(-1, 3), quaternion.reshape(-1, 4), scale)
