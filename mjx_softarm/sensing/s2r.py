"""The sim-to-real network: simulated tip pose and spring lengths -> pose of the real tip.

Orientation goes in as two columns of the rotation matrix, its correction comes out as a Gibbs vector (axis
times the tangent of half the angle): both are smooth at pitch 90, where yaw and roll are not. Training visits
arms far from the logged ones, so inputs and outputs are clipped to the range of the training rows.

Source: Sim-to-Real Transfer in Meng et al., N_S2R: (P, L_spring) -> P_S2R.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_softarm._support.archive import Entries, entries_of, read_sealed, write_sealed
from mjx_softarm._support.mlp import Layer, mlp
from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_frame, rotation_from_quaternion

N_POSE_INPUTS = 9  # position and two columns of the rotation
N_POSE_OUTPUTS = 6  # change of the position and Gibbs vector
KIND = "s2r"
S2R_FILE = "s2r.npz"  # in the folder of a calibration, and of a run that was trained with it


class S2R(NamedTuple):
    """Network and its training range; n_in is 9 + n springs, n_out is 6. All float32."""

    layers: tuple[Layer, ...]  # normalised inputs (n_in,) -> corrections (n_out,)
    input_low: Array  # (n_in,) least inputs of the training rows, normalised to -1
    input_high: Array  # (n_in,) greatest inputs of the training rows, normalised to 1
    output_low: Array  # (n_out,) least corrections of the training rows
    output_high: Array  # (n_out,) greatest corrections of the training rows
    anchors: Array  # (n_anchors, n_in) normalised training rows that represent all of them
    limit: Array  # () greatest believable distance to the nearest anchor
    error_mm: Array = np.float32(0.0)  # () mean error of the tip at held-out poses; 0: not known


def correct(s2r: S2R, pose: Array, spring_m: Array) -> Array:
    """Return the real tip's pose (..., 6) [mm, deg] by the simulated one and spring lengths (..., n) [m]."""
    return pose_from_frame(*corrected(s2r, frame_from_pose(pose), spring_m))


def corrected(s2r: S2R, frame: tuple[Array, Array], spring_m: Array) -> tuple[Array, Array]:
    """Return the frame of the real tip: origin (..., 3) [m] and axes (..., 3, 3); see `correct`."""
    return apply_correction(frame, correction(s2r, inputs(frame, spring_m)))


def extrapolation(s2r: S2R, pose: Array, spring_m: Array) -> Array:
    """Return the distance (...) to the training rows over its limit; above 1, do not trust the network."""
    return distance(s2r, inputs(frame_from_pose(pose), spring_m)) / s2r.limit


def inputs(frame: tuple[Array, Array], spring_m: Array) -> Array:
    """Return the network's inputs (..., 9 + n): position [m], the tip's x and y axes, spring lengths [m]."""
    position_m, rotation = frame
    xp = array_namespace(position_m, spring_m)
    return xp.concat([position_m, rotation[..., 0], rotation[..., 1], spring_m], axis=-1)


def correction(s2r: S2R, x: Array) -> Array:
    """Return the corrections (..., n_out) of inputs (..., n_in), within the range of the training rows."""
    xp = array_namespace(x, s2r.input_low)
    z = xp.clip(_normalised(s2r, x), -1.0, 1.0)
    return xp.clip(mlp(s2r.layers, z, "relu"), s2r.output_low, s2r.output_high)


def distance(s2r: S2R, x: Array) -> Array:
    """Return the root-mean-square distance (...) of inputs (..., n_in) to the nearest anchor."""
    xp = array_namespace(x, s2r.anchors)
    offset = _normalised(s2r, x)[..., None, :] - s2r.anchors  # (..., n_anchors, n_in)
    return xp.sqrt(xp.min(xp.mean(offset**2, axis=-1), axis=-1))


def apply_correction(frame: tuple[Array, Array], change: Array) -> tuple[Array, Array]:
    """Move and turn a frame in the base frame by a change (..., 6): shift [mm] and Gibbs vector.

    This scales the frame's axes, which changes no angle.
    """
    position_m, rotation = frame
    xp = array_namespace(position_m, change)
    turn = rotation_from_quaternion(xp.concat([xp.ones_like(change[..., :1]), change[..., 3:]], axis=-1))
    return position_m + 0.001 * change[..., :3], turn @ rotation


def correction_between(pose: Array, real_pose: Array) -> Array:
    """Return the change (..., 6) that makes `apply_correction` reach the real pose; turns below 180 deg."""
    xp = array_namespace(pose, real_pose)
    (start_m, start), (end_m, end) = frame_from_pose(pose), frame_from_pose(real_pose)
    turn = end @ xp.swapaxes(start, -1, -2)
    skew = turn - xp.swapaxes(turn, -1, -2)
    axis = xp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    size = 1.0 + xp.trace(turn, axis1=-2, axis2=-1)  # 4 cos(angle / 2)^2
    gibbs = axis / xp.maximum(size, 1e-6)[..., None]
    return xp.concat([1000.0 * (end_m - start_m), gibbs], axis=-1)


def carry_body(plate_position: Array, plate_rotation: Array, real_pose: Array) -> tuple[Array, Array]:
    """Estimate positions and axes of the real arm's plates from the pose of its tip.

    Each plate moves by a share of the tip's offset that grows evenly along the arm, as under a tilted base,
    the main cause of the offset, and keeps its direction. The last plate is that of the real tip.

    Args:
        plate_position (..., L + 1, 3) [m]: simulated, as in `mjx_softarm.mechanics.kinematics.Frames`.
        plate_rotation (..., L + 1, 3, 3): axes of these plates.
        real_pose (..., 6) [mm, deg]: pose of the tip, from `correct`.
    """
    xp = array_namespace(plate_position, real_pose)
    tip_m, rotation = frame_from_pose(real_pose)
    share = xp.linspace(0.0, 1.0, plate_position.shape[-2], dtype=plate_position.dtype)
    offset_m = tip_m - plate_position[..., -1, :]
    real_position = plate_position + share[:, None] * offset_m[..., None, :]
    return real_position, xp.concat([plate_rotation[..., :-1, :, :], rotation[..., None, :, :]], axis=-3)


def _normalised(s2r: S2R, x: Array) -> Array:
    """Scale inputs (..., n_in) by the range of the training rows, whose inputs then lie in [-1, 1]."""
    return 2.0 * (x - s2r.input_low) / (s2r.input_high - s2r.input_low) - 1.0


def save_s2r(path: str | Path, s2r: S2R) -> None:
    """Write a network; raises as `write_sealed` does. Equal networks give equal bytes."""
    write_sealed(Path(path), entries_of(KIND, s2r), KIND)


def load_s2r(path: str | Path, n_springs: int) -> S2R:
    """Read a network for an arm of n springs, and check all of it.

    Raises:
        SealedFileError: the file is none of this kind, is damaged, or has a wrong entry.
    """
    entries = Entries(read_sealed(Path(path), KIND, "python -m calib run"), str(path))
    s2r = take_s2r(entries, n_springs)
    entries.finish(1)
    return s2r


def take_s2r(entries: Entries, n_springs: int) -> S2R:
    """Take the network for an arm of n springs from the entries of a file."""
    n_in, n_out = N_POSE_INPUTS + n_springs, N_POSE_OUTPUTS
    return entries.network(
        KIND,
        S2R,
        input_low=(n_in,),
        input_high=(n_in,),
        output_low=(n_out,),
        output_high=(n_out,),
        anchors=(None, n_in),
        limit=(),
        error_mm=(),
        layers=(n_in, n_out),
    )
