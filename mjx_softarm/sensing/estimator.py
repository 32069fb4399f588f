"""Estimators of an arm at rest: tip pose from spring lengths, spring lengths from pressures. NumPy and JAX.

No sensor of the arm sees the tip. Three or more springs give a section's length and bend, a section of
constant curvature has a closed form, and the sections are in series. Real sections do not bend evenly, since
the weight below pulls at them. So a small network, distilled from the simulator, corrects each section's end.
Its inputs are the springs and the direction of gravity at each section's end. A second network also has the
payload as input (`mjx_softarm.sensing.load`); its output is multiplied by the payload.

In the other direction, `expected_springs` predicts the spring lengths at given pressures without a payload.
The control loop compares them with the readings to find a chamber that has lost its pressure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.archive import Entries
from mjx_softarm._support.mlp import Layer, mlp
from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.sensing.pose import (
    frame_from_pose,
    pose_from_frame,
    rotation_from_quaternion,
    share_of_turn,
)

N_CHANGES = 6  # change of a section's end: position [m], Gibbs vector (axis times tangent of half the angle)
_SMALL_BEND = 1e-8  # square of a bend [rad^2] below which a section counts as straight


class PoseEstimator(NamedTuple):
    """Networks from spring lengths and payload to the tip pose, for n springs. All float32."""

    # Normalised springs (n,) and ups (3 n_sections,) -> changes (n_sections * N_CHANGES,)
    layers: tuple[Layer, ...]
    load_layers: tuple[Layer, ...]  # these inputs and the normalised payload (1,) -> changes per payload
    spring_site_m: Array  # (n_sections, s, 2) holes of the s springs of each section in its rings, x and y
    spring_centre_m: Array  # (n,) lengths that are normalised to 0
    spring_scale_m: Array  # (n,) difference of length that is normalised to 1
    load_centre_kg: Array  # () payload that is normalised to 0
    load_scale_kg: Array  # () difference of payload that is normalised to 1
    change_scale: Array  # (N_CHANGES,) [m, 1] units of the networks' outputs
    base_position_m: Array = np.zeros(3, np.float32)  # origin of the arm's own base in the base frame (z up)
    base_rotation: Array = np.eye(3, dtype=np.float32)  # axes of the arm's own base


class SpringModel(NamedTuple):
    """Network from pressures to spring lengths at rest. All float32."""

    layers: tuple[Layer, ...]  # normalised pressures (n_chambers,) -> normalised springs (n_springs,)
    pressure_centre_kpa: Array  # (n_chambers,)
    pressure_scale_kpa: Array  # (n_chambers,)
    spring_centre_m: Array  # (n_springs,)
    spring_scale_m: Array  # (n_springs,)


class Frame(NamedTuple):
    """Frames of plates."""

    position_m: Array  # (..., 3)
    rotation: Array  # (..., 3, 3), columns are the plate's axes


def estimate(estimator: PoseEstimator, spring_m: Array, load_kg: Array | float) -> Array:
    """Return the tip pose (..., 6) [mm, deg] of an arm at rest, with the arguments of `estimate_frame`."""
    return pose_from_frame(*estimate_frame(estimator, spring_m, load_kg))


def estimate_frame(estimator: PoseEstimator, spring_m: Array, load_kg: Array | float) -> Frame:
    """Return the tip frame of an arm at rest with springs (..., n) [m] and a payload (...) or () [kg]."""
    # Sections of constant curvature, and inputs of the networks
    xp = array_namespace(spring_m, estimator.spring_site_m)
    spring_m = xp.asarray(spring_m, dtype=estimator.spring_site_m.dtype)
    even = constant_curvature(estimator.spring_site_m, spring_m)  # (..., n_sections)
    normalised = (spring_m - estimator.spring_centre_m) / estimator.spring_scale_m
    load = (xp.asarray(load_kg, dtype=spring_m.dtype) - estimator.load_centre_kg) / estimator.load_scale_kg
    load = (xp.zeros_like(normalised[..., 0]) + load)[..., None]  # (..., 1)
    shape = xp.concat([normalised, *_ups(estimator.base_rotation, even.rotation)], axis=-1)

    # Changes of each section's end; position and Gibbs vector are continuous where yaw and roll are not
    changes = mlp(estimator.layers, shape)
    changes = changes + load * mlp(estimator.load_layers, xp.concat([shape, load], axis=-1))
    changes = changes.reshape(*changes.shape[:-1], -1, N_CHANGES) * estimator.change_scale
    quaternion = xp.concat([xp.ones_like(changes[..., :1]), changes[..., 3:]], axis=-1)
    turn = rotation_from_quaternion(quaternion / xp.sqrt(xp.sum(quaternion**2, axis=-1))[..., None])
    tip = chain(Frame(even.position_m + changes[..., :3], turn @ even.rotation))

    return _from_base(Frame(estimator.base_position_m, estimator.base_rotation), tip)


def even_pose(base: Frame, spring_site_m: Array, spring_m: Array) -> Array:
    """Return the tip pose (..., 6) [mm, deg] with sections that bend evenly; arguments as of `backbone`."""
    return pose_from_frame(*_from_base(base, chain(constant_curvature(spring_site_m, spring_m))))


def _from_base(base: Frame, tip: Frame) -> Frame:
    """Return a frame in the axes of the arm's own base in the base frame."""
    position_m = (base.rotation @ tip.position_m[..., None])[..., 0] + base.position_m
    return Frame(position_m, base.rotation @ tip.rotation)


def constant_curvature(spring_site_m: Array, spring_m: Array) -> Frame:
    """Return each section's end in the frame of its start, for sections of constant curvature.

    Args:
        spring_site_m (n_sections, s, 2) [m]: holes of the springs, three or more a section at equal angles.
        spring_m (..., n_sections * s) [m]: lengths.

    Returns:
        Positions (..., n_sections, 3) and rotations (..., n_sections, 3, 3).

    Source: Webster, Jones, "Design and Kinematic Modeling of Constant Curvature Continuum Robots", 2010.
    """
    xp = array_namespace(spring_m, spring_site_m)
    # Length and bend by least squares over springs at equal angles
    # (a section turns towards its shorter springs by |bend|)
    spring = spring_m.reshape(*spring_m.shape[:-1], *spring_site_m.shape[:2])
    length = xp.mean(spring, axis=-1)[..., None]  # (..., n_sections, 1)
    moment = xp.sum((spring - length)[..., None] * spring_site_m, axis=-2)
    bend = -2.0 * moment / xp.sum(spring_site_m**2, axis=(-2, -1))[:, None]
    square = xp.sum(bend**2, axis=-1)[..., None]
    angle = xp.sqrt(xp.where(square < _SMALL_BEND, _SMALL_BEND, square))

    # Chord and turn of the arc
    half = xp.sin(0.5 * angle) / angle
    aside = 2.0 * half**2  # (1 - cos) / angle^2, exact in float32
    down = xp.sin(angle) / angle
    position_m = length * xp.concat([aside * bend, -down], axis=-1)
    across = half * bend  # the axis of the turn is (bend y, -bend x, 0)
    quaternion = xp.concat(
        [xp.cos(0.5 * angle), across[..., 1:], -across[..., :1], xp.zeros_like(angle)], axis=-1
    )
    return Frame(position_m, rotation_from_quaternion(quaternion))


def _ups(base_rotation: Array, rotation: Array) -> list[Array]:
    """Return the direction against gravity (..., 3) in the frame of each section's end."""
    ups = [base_rotation[2:]]
    for section in range(rotation.shape[-3]):
        ups.append(ups[-1] @ rotation[..., section, :, :])
    return [up[..., 0, :] for up in ups[1:]]


def chain(sections: Frame) -> Frame:
    """Return the frame of the last plate in the axes of the base, of sections (..., n_sections) in series."""
    position_m, rotation = sections.position_m[..., -1, :, None], sections.rotation[..., -1, :, :]
    for section in reversed(range(sections.position_m.shape[-2] - 1)):  # from the tip up to the base
        above = sections.rotation[..., section, :, :]
        position_m = sections.position_m[..., section, :, None] + above @ position_m
        rotation = above @ rotation
    return Frame(position_m[..., 0], rotation)


def backbone(
    base: Frame, spring_site_m: np.ndarray, spring_m: np.ndarray, tip: np.ndarray, at: np.ndarray
) -> Frame:
    """Return frames along the arm, which ends at the tip's pose. NumPy only.

    Sections of constant curvature are in series, by the springs. The tip's distance from their end is
    spread over the arm: it grows evenly from the base.

    Args:
        base: frame (3,) [m], (3, 3) of the arm's own base.
        spring_site_m (n_sections, s, 2) [m]: holes of the springs.
        spring_m (n_sections * s,) [m]: lengths.
        tip (6,) [mm, deg]: pose; with NaN the arm ends where the springs bring it.
        at (k,): places as shares of each section's length; one of them is 1.

    Returns:
        Positions (n_sections, k, 3) and rotations (n_sections, k, 3, 3) in the base frame.
    """
    # Sections in series; a share of a section has the same share of its springs' lengths
    inner = constant_curvature(spring_site_m, at[:, None] * spring_m)  # (k, n_sections)
    end = int(np.argmax(at))
    frames, above_m, above = [], *base
    for section in range(inner.position_m.shape[1]):
        position_m = above_m + inner.position_m[:, section] @ above.T
        rotation = above @ inner.rotation[:, section]
        frames.append((position_m, rotation))
        above_m, above = position_m[end], rotation[end]
    position_m, rotation = (np.stack(part) for part in zip(*frames, strict=True))  # (n_sections, k)
    if not np.isfinite(tip).all():
        return Frame(position_m, rotation)

    # Spread the distance of the tip from their end
    tip_m, tip_rotation = frame_from_pose(np.asarray(tip, float))
    share = (np.arange(len(frames))[:, None] + at) / len(frames)  # share of the way to the tip
    turn = share_of_turn(tip_rotation @ above.T, share)
    return Frame(position_m + share[..., None] * (tip_m - above_m), turn @ rotation)


def expected_springs(model: SpringModel, pressure_kpa: Array) -> Array:
    """Return spring lengths (..., n_springs) [m] at rest at pressures (..., n_chambers) [kPa], unloaded."""
    xp = array_namespace(pressure_kpa, model.pressure_centre_kpa)
    pressure_kpa = xp.asarray(pressure_kpa, dtype=model.pressure_centre_kpa.dtype)
    normalised = (pressure_kpa - model.pressure_centre_kpa) / model.pressure_scale_kpa
    return model.spring_centre_m + model.spring_scale_m * mlp(model.layers, normalised)


def take_estimator(entries: Entries, name: str, n_sections: int, n_springs: int) -> PoseEstimator:
    """Take the estimator `name` from the entries of a file."""
    n_in, n_out = n_springs + 3 * n_sections, N_CHANGES * n_sections
    return entries.network(
        name,
        PoseEstimator,
        {"load_layers": (n_in + 1, n_out), "layers": (n_in, n_out)},
        spring_site_m=(n_sections, n_springs // n_sections, 2),
        spring_centre_m=(n_springs,),
        spring_scale_m=(n_springs,),
        load_centre_kg=(),
        load_scale_kg=(),
        change_scale=(N_CHANGES,),
        base_position_m=(3,),
        base_rotation=(3, 3),
    )


def take_spring_model(entries: Entries, name: str, n_chambers: int, n_springs: int) -> SpringModel:
    """Take the spring model `name` from the entries of a file."""
    return entries.network(
        name,
        SpringModel,
        {"layers": (n_chambers, n_springs)},
        pressure_centre_kpa=(n_chambers,),
        pressure_scale_kpa=(n_chambers,),
        spring_centre_m=(n_springs,),
        spring_scale_m=(n_springs,),
    )
