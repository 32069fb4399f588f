"""Posture of an arm: which way it points from its base, hanging, upright or in between. NumPy alone.

Gravity pulls towards -z of the base frame. The arm's own base is turned in that frame by
`mounting.base_turn_deg`: not at all for an arm that hangs, by 180 degrees about x for one that stands. A
calibration fits the small turn of a base that was not mounted exactly, so an arm close to hanging hangs.
"""

from __future__ import annotations

import numpy as np

from mjx_softarm.sensing.pose import pose_from_frame, rotation_about, rotation_vector
from mjx_softarm.spec import ArmSpec, SpecError

HANGING_DEG = 30.0  # largest angle from the vertical of an arm that hangs
MOST_PITCH_DEG = 75.0  # at 90 degrees yaw and roll are one angle, and a straight arm is seen most


def base_rotation(spec: ArmSpec) -> np.ndarray:
    """Return the axes (3, 3) of the arm's own base in the base frame."""
    return rotation_about(np.radians(spec.mounting.base_turn_deg))


def hangs(spec: ArmSpec) -> bool:
    """Return whether the straight arm hangs, within `HANGING_DEG`."""
    return bool(base_rotation(spec)[2, 2] > np.cos(np.radians(HANGING_DEG)))


def posture(spec: ArmSpec) -> np.ndarray:
    """Return the axes (3, 3) of the straight arm in the base frame: the identity for an arm that hangs."""
    return np.eye(3) if hangs(spec) else base_rotation(spec)


def turned_poses(spec: ArmSpec, position_mm: np.ndarray) -> np.ndarray:
    """Return poses (..., 6) [mm, deg] of tips along the arm's axis, at places (..., 3) as if it hung."""
    turn = posture(spec)
    angles_deg = pose_from_frame(np.zeros(3), turn)[3:] + 0.0  # without a negative zero
    place_mm = position_mm @ turn.T
    return np.concatenate([place_mm, np.broadcast_to(angles_deg, place_mm.shape)], axis=-1)


def straight_pose(spec: ArmSpec) -> np.ndarray:
    """Return the pose (6,) [mm, deg] of the tip of the straight, unloaded arm."""
    return turned_poses(spec, np.array([0.0, 0.0, -1e3 * spec.length_m]))


def check_posture(spec: ArmSpec) -> None:
    """Check that yaw and roll of the straight arm's tip are two angles.

    Raises:
        SpecError: its pitch is near 90 degrees. The message has the numbers of the same arm, described with
            its base turned about its own axis.
    """
    turn = base_rotation(spec)
    pitch_deg = float(pose_from_frame(np.zeros(3), turn)[4])
    if abs(pitch_deg) <= MOST_PITCH_DEG:
        return

    # The same arm with the base's x axis horizontal; its chambers go back by as much
    roll = np.arctan2(turn[2, 0], turn[2, 1])
    other = np.degrees(rotation_vector(turn @ rotation_about(np.array([0.0, 0.0, -roll]))))
    raise SpecError(
        f"{spec.name}: mounting.base_turn_deg: got {spec.mounting.base_turn_deg}, a pitch of {pitch_deg:.0f} "
        f"deg of the straight arm's tip, expected {MOST_PITCH_DEG:g} at most, since yaw and roll are one "
        f"at 90 deg: the same arm has [{', '.join(f'{angle:.6g}' for angle in other + 0.0)}], and "
        f"{np.degrees(roll) + 0.0:g} more in geometry.first_chamber_deg"
    )
