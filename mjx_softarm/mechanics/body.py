"""The arm's outer shape, for what draws it, collides it or measures its distance to a wall.

Rings, which hold the springs, are the widest part of a link; below the last one hangs the gripper, a palm
and two fingers, all boxes.
"""

from __future__ import annotations

import numpy as np

from mjx_softarm.spec import N_CHAMBERS_PER_SECTION, ArmSpec

SPRING_WIDTH_M = 0.002  # radius of a spring, outside the circle that the springs stand on


def ring_radius_m(spec: ArmSpec) -> float:
    """Return the outer radius of a ring."""
    return spec.geometry.spring_radius_m + SPRING_WIDTH_M


def hole_directions(spec: ArmSpec) -> np.ndarray:
    """Return the direction (n, 2) of each chamber, and of its spring, from its section's axis: x and y."""
    first = np.radians(spec.geometry.first_chamber_deg)
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
