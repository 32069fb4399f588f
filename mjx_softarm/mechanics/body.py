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
from mjx_softarm.spec import N_CHAMBERS_PER_SECTION, ArmSpec

FOLDS, COILS = 12, 20  # folds of a bellows, coils of a spring
SPRING_WIDTH_M = 0.002  # radius of a spring, outside the circle that the springs stand on


def ring_radius_m(spec: ArmSpec) -> float:
    """Return the outer radius of a ring."""
    return spec.geometry.spring_radius_m + SPRING_WIDTH_M


def hole_directions(spec: ArmSpec) -> np.ndarray:
    """Return the unit vector (n, 2), x and y, from the axis of its section to each chamber and its spring."""
    roll_deg = np.repeat(spec.section_roll_deg, N_CHAMBERS_PER_SECTION)
    first = np.radians(spec.geometry.first_chamber_deg + roll_deg)
    angle = first + 2 * np.pi * np.arange(spec.n_chambers) / N_CHAMBERS_PER_SECTION
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


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
    pitch_m: np.ndarray  # (k,) length of a copy along its own z; the mesh has length 1

    @property
    def scales(self) -> np.ndarray:
        """Scales (k, 3) along the axes of the mesh."""
        return np.stack([np.ones_like(self.pitch_m)] * 2 + [self.pitch_m], axis=-1)


class ArmShape(NamedTuple):
    """Places of all drawn parts. Bellows and springs are ordered as in the model, each from its upper end."""

    rings: Copies  # links_per_section in each section; the ring at the base is not among them
    folds: Copies  # FOLDS in each bellows
    coils: Copies  # COILS in each spring


def shape(spec: ArmSpec, spring_m: np.ndarray, tip: np.ndarray) -> ArmShape:
    """Return the shape of an arm with springs (n,) [m] and its tip at a pose (6,) [mm, deg]."""
    # Frames along the axis of each section, as shares of its length: rings, folds, coils
    geometry, directions = spec.geometry, hole_directions(spec)
    n_rings = spec.structure.links_per_section
    steps = [(np.arange(n) + 0.5) / n for n in (FOLDS, COILS)]
    at = np.concatenate([(np.arange(n_rings) + 1.0) / n_rings, *steps])
    site_m = (geometry.spring_radius_m * directions).reshape(spec.structure.n_sections, -1, 2)
    base = Frame(np.array(spec.mounting.base_offset_m), base_rotation(spec))
    sections = backbone(base, site_m, spring_m, tip, at)
    rings, folds, coils = (
        Frame(*(part[:, rows] for part in sections))
        for rows in np.split(np.arange(len(at)), [n_rings, n_rings + FOLDS])
    )

    # Rings stand on the axis, folds and coils beside it
    centres = rings.position_m.reshape(-1, 3)
    return ArmShape(
        Copies(centres, quaternion_from_rotation(rings.rotation.reshape(-1, 3, 3)), np.ones(len(centres))),
        _beside(folds, geometry.chamber_radius_m * directions),
        _beside(coils, geometry.spring_radius_m * directions),
    )


def _beside(line: Frame, hole_m: np.ndarray) -> Copies:
    """Return copies beside each section's axis (n_sections, k), through its holes (n, 2)."""
    hole = hole_m.reshape(-1, N_CHAMBERS_PER_SECTION, 2)
    aside = np.einsum("skij,shj->shki", line.rotation[..., :2], hole)
    position_m = line.position_m[:, None] + aside  # (n_sections, 3, k, 3)
    pitch_m = np.linalg.norm(np.diff(position_m, axis=2), axis=-1).mean(axis=-1)
    n_copies = position_m.shape[2]
    quaternion = np.repeat(quaternion_from_rotation(line.rotation)[:, None], N_CHAMBERS_PER_SECTION, axis=1)
    return Copies(position_m.reshape(-1, 3), quaternion.reshape(-1, 4), np.repeat(pitch_m.ravel(), n_copies))
