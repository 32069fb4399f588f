"""The observation: pose, goal and scaled error, one function for training, twin and deployed arm.

Source: the paper's state s = (P, g, e) in R^18. A fixed affine map brings pose and goal to
the order of one; it changes only the numbers that a network sees.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.mdp.rewards import RewardConfig, scaled_error
from mjx_softarm.spec import ArmSpec

# Units are those before scaling: of pose and goal by `ObsScale`, of the error by the reward's weights.
_AXES = ("x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg")
OBS_LAYOUT = tuple(f"{part}_{axis}" for part in ("pose", "goal", "error") for axis in _AXES)
OBS_SIZE = len(OBS_LAYOUT)


class ObsScale(NamedTuple):
    """Affine map of poses and goals."""

    centre: Array  # (6,) [mm, deg]
    scale: Array  # (6,) [mm, deg]

    @classmethod
    def from_spec(cls, spec: ArmSpec) -> ObsScale:
        """Return the map that centres on the unloaded tip and scales a third of the arm, or 90 deg, to 1."""
        length_mm = 1e3 * spec.structure.n_sections * spec.geometry.section_length_m
        centre = np.array([0.0, 0.0, -length_mm, 0.0, 0.0, 0.0], np.float32)
        return cls(centre, np.array([length_mm / 3] * 3 + [90.0] * 3, np.float32))


def observe(pose: Array, goal: Array, scale: ObsScale, config: RewardConfig) -> Array:
    """Return the observation (..., 18) of pose and goal (..., 6) [mm, deg]: scaled pose, scaled goal, e."""
    xp = array_namespace(pose)
    scaled = [(value - scale.centre) / scale.scale for value in (pose, goal)]
    return xp.concat([*scaled, scaled_error(pose, goal, config)], axis=-1)
