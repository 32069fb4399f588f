"""The arm's shape for a picture, from what a log holds: spring lengths and the tip pose believed in.

Each section bends with constant curvature, as its springs tell. Gravity and the sim-to-real network bring the
tip elsewhere; that difference is spread over the arm, growing from base to tip. NumPy only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm.mechanics.body import hole_directions
from mjx_softarm.sensing.estimator import Frame, constant_curvature
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_frame, quaternion_from_pose, share_of_turn
from mjx_softarm.spec import N_CHAMBERS_PER_SECTION, ArmSpec

FOLDS, COILS = 12, 20  # of a bellows, and of a spring


class Copies(NamedTuple):
    """Places of the copies of one mesh."""

    position_m: np.ndarray  # (k, 3)
    quaternion: np.ndarray  # (k, 4) w, x, y, z
    pitch_m: np.ndarray  # (k,) length along its own z, in which a mesh that is to be stretched has 1

    @property
    def scales(self) -> np.ndarray:
        """(k, 3) along the mesh's axes."""
        return np.stack([np.ones_like(self.pitch_m)] * 2 + [self.pitch_m], axis=-1)


class Shape(NamedTuple):
    """Places of all parts. Bellows and springs are numbered as in the model, each from its upper end."""

    rings: Copies  # links_per_section to a section, below the base's own
    folds: Copies  # FOLDS to a bellows
    coils: Copies  # COILS to a spring


def shape(spec: ArmSpec, spring_m: np.ndarray, tip: np.ndarray) -> Shape:
    """Return the shape of an arm with springs (n,) [m] and its tip at a pose (6,) [mm, deg]."""
    geometry, directions = spec.geometry, hole_directions(spec)
    n_rings = spec.structure.links_per_section
    steps = [(np.arange(n) + 0.5) / n for n in (FOLDS, COILS)]
    at = np.concatenate([(np.arange(n_rings) + 1.0) / n_rings, *steps])
    sections = _carried(_even(geometry.spring_radius_m * directions, spring_m, at), tip, at)
    rings, folds, coils = (
        Frame(*(part[:, rows] for part in sections))
        for rows in np.split(np.arange(len(at)), [n_rings, n_rings + FOLDS])
    )
    centres = rings.position_m.reshape(-1, 3)
    return Shape(
        Copies(centres, _quaternions(rings.rotation.reshape(-1, 3, 3)), np.ones(len(centres))),
        _beside(folds, geometry.chamber_radius_m * directions),
        _beside(coils, geometry.spring_radius_m * directions),
    )


def _even(site_m: np.ndarray, spring_m: np.ndarray, at: np.ndarray) -> Frame:
    """Return the frames (n_sections, k) at shares (k,) of each section's length, the sections in series."""
    # Length and bend of a part of a section are the same part of its springs' lengths.
    inner = constant_curvature(site_m, at[:, None] * spring_m)  # (k, n_sections)
    ends = constant_curvature(site_m, spring_m)  # (n_sections,)
    position_m, rotation, found = np.zeros(3), np.eye(3), []
    for section in range(len(ends.position_m)):
        below_m = inner.position_m[:, section] @ rotation.T
        found.append((position_m + below_m, rotation @ inner.rotation[:, section]))
        position_m = position_m + rotation @ ends.position_m[section]
        rotation = rotation @ ends.rotation[section]
    return Frame(*(np.stack(part) for part in zip(*found, strict=True)))


def _carried(sections: Frame, tip: np.ndarray, at: np.ndarray) -> Frame:
    """Return the frames (n_sections, k), the one at the arm's end brought to the tip's pose."""
    if not np.isfinite(tip).all():
        return sections
    end = int(np.argmax(at))
    tip_m, tip_rotation = frame_from_pose(np.asarray(tip, float))
    off_m = tip_m - sections.position_m[-1, end]
    turn = tip_rotation @ sections.rotation[-1, end].T
    n_sections = len(sections.position_m)
    share = (np.arange(n_sections)[:, None] + at) / n_sections  # (n_sections, k) of the way to the tip
    turns = share_of_turn(turn, share)
    return Frame(sections.position_m + share[..., None] * off_m, turns @ sections.rotation)


def _beside(line: Frame, hole_m: np.ndarray) -> Copies:
    """Return copies beside each section's axis (n_sections, k), through its holes (n, 2)."""
    hole = hole_m.reshape(-1, N_CHAMBERS_PER_SECTION, 2)
    aside = np.einsum("skij,shj->shki", line.rotation[..., :2], hole)
    position_m = line.position_m[:, None] + aside  # (n_sections, 3, k, 3)
    pitch_m = np.linalg.norm(np.diff(position_m, axis=2), axis=-1).mean(axis=-1)
    n_copies = position_m.shape[2]
    quaternion = np.repeat(_quaternions(line.rotation)[:, None], N_CHAMBERS_PER_SECTION, axis=1)
    return Copies(position_m.reshape(-1, 3), quaternion.reshape(-1, 4), np.repeat(pitch_m.ravel(), n_copies))


def _quaternions(rotation: np.ndarray) -> np.ndarray:
    return quaternion_from_pose(pose_from_frame(np.zeros(rotation.shape[:-1]), rotation))
