"""The arm's outer shape, for what draws it, collides it or measures its distance to a wall.

Rings, which hold the springs, are the widest part of a link; below the last one hangs the gripper, a palm
and two fingers, all boxes.
"""

from __future__ import annotations

import numpy as np

from mjx_softarm.spec import ArmSpec

SPRING_WIDTH_M = 0.002  # radius of a spring, outside the circle that the springs stand on


def ring_radius_m(spec: ArmSpec) -> float:
    """Outer radius of a ring."""
    return spec.geometry.spring_radius_m + SPRING_WIDTH_M


def gripper_boxes(spec: ArmSpec) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name -> half sizes (3,) and centre (3,) [m] of each box, from the middle of the gripper, z up."""
    quarter = 0.25 * spec.mass.gripper_length_m
    return {
        "palm": (np.array([0.022, 0.022, quarter]), np.array([0.0, 0.0, quarter])),
        "finger0": (np.array([0.005, 0.010, quarter]), np.array([-0.02, 0.0, -quarter])),
        "finger1": (np.array([0.005, 0.010, quarter]), np.array([0.02, 0.0, -quarter])),
    }
