"""Estimators of an arm at rest: tip pose from spring lengths, spring lengths from pressures. NumPy and JAX.

Springs give a section's length and bend, a section of constant curvature has a closed form, and the sections
are in series. The weight below bends them unevenly. That moves and turns a section's end by a polynomial,
fitted to the simulator, of its length and bend, of the direction of gravity, and of the masses below. These
depend on the sections above and below, so several passes are made.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
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
N_PASSES = 2  # with 3, 95 % of poses with 1 kg are within 0.051 mm instead of 0.059
POSE_ERROR_MM = 0.1  # error that 95 % of poses shall not exceed; `train export` says where they do
# Cost of each variable as a factor in a term of the polynomial: three of the shape, seven of the load
_COSTS = (*[1] * 3, *[2] * 7)
_DEGREE = 7  # greatest cost of a term; with 6, turns are three times as far off
_SMALL_BEND = 1e-8  # square of a bend [rad^2] below which a section counts as straight


class PoseEstimator(NamedTuple):
    """Sections of constant curvature, and a polynomial for what each section's end is off. All float32."""

    coefficient: Array  # (n_sections, N_TERMS, N_CHANGES) [m, 1]
    variable_centre: Array  # (n_sections, N_VARIABLES) middle of the range of each of `variables`
    variable_scale: Array  # (n_sections, N_VARIABLES) half of this range, which variables are clipped to
    spring_site_m: Array  # (n_sections, s, 2) holes of the s springs of each section in its rings, x and y
    section_mass_kg: Array  # (n_sections,)
    gripper_mass_kg: Array  # ()
    tool_offset_m: Array  # (2,) centres of gripper and payload below the last plate
    base_position_m: Array  # (3,) origin of the arm's own base in the base frame (z up)
    base_rotation: Array  # (3, 3) axes of the arm's own base
    tip_offset_m: Array  # (3,) measured tip in the frame of the last plate
    tip_rotation: Array  # (3, 3) its axes


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
    # Sections of constant curvature
    xp = array_namespace(spring_m, estimator.spring_site_m)
    spring_m = xp.asarray(spring_m, dtype=estimator.spring_site_m.dtype)
    length, bend = section_shapes(estimator.spring_site_m, spring_m)
    even = sections = arcs(length, bend)

    # Changes of each section's end; position and Gibbs vector are continuous where yaw and roll are not
    given_kg: Array = xp.asarray(load_kg, dtype=length.dtype)[..., None]
    one_kg: Array = xp.zeros_like(length[..., 0, :]) + given_kg  # (..., 1)
    loads_kg = xp.zeros_like(length) + one_kg[..., None, :]
    for _ in range(N_PASSES):
        moments = first_moments(estimator, length, sections, one_kg)
        ups = directions_up(estimator, sections)
        x = variables(length, bend, even.rotation, ups, moments, loads_kg)
        x = xp.clip((x - estimator.variable_centre) / estimator.variable_scale, -1.0, 1.0)
        change = _change(estimator, x)
        quaternion = xp.concat([xp.ones_like(change[..., :1]), change[..., 3:]], axis=-1)
        turn = rotation_from_quaternion(quaternion / xp.sqrt(xp.sum(quaternion**2, axis=-1))[..., None])
        sections = Frame(even.position_m + change[..., :3], turn @ even.rotation)

    # From the last plate to the tip, and from the arm's own base to the base frame
    plate = chain(sections)
    tip_m = plate.position_m + plate.rotation @ estimator.tip_offset_m
    tip = Frame(tip_m, plate.rotation @ estimator.tip_rotation)
    return compose(Frame(estimator.base_position_m, estimator.base_rotation), tip)


def _change(estimator: PoseEstimator, x: Array) -> Array:
    """Return the change (..., n_sections, N_CHANGES) of each section's end at scaled `variables`."""
    xp = array_namespace(x)
    # Terms come first: NumPy gathers whole rows of a batch nine times as fast as single numbers
    terms = polynomial_terms(xp.swapaxes(x.reshape(-1, *x.shape[-2:]), 0, 2))  # (N_TERMS, n_sections, batch)
    change = xp.swapaxes(estimator.coefficient, 1, 2) @ xp.swapaxes(terms, 0, 1)
    change = xp.swapaxes(xp.swapaxes(change, 0, 2), 1, 2)  # (batch, n_sections, N_CHANGES)
    return change.reshape(*x.shape[:-1], N_CHANGES)


def directions_up(estimator: PoseEstimator, sections: Frame) -> Array:
    """Return the direction against gravity in the axes of each section's start, (..., n_sections, 3)."""
    rotation = sections.rotation  # of each section's end in its start
    up = array_namespace(rotation).zeros_like(rotation[..., 0, :1, :]) + estimator.base_rotation[2]
    ups = [up]  # (..., 1, 3)
    for k in range(rotation.shape[-3] - 1):
        up = up @ rotation[..., k, :, :]
        ups.append(up)
    return array_namespace(rotation).concat(ups, axis=-2)


def first_moments(estimator: PoseEstimator, length: Array, sections: Frame, load_kg: Array) -> Array:
    """Return the first moments (..., n_sections, 3) [kg m] of the masses below each section.

    They are about the section's end, in its axes.

    Args:
        length (..., n_sections, 1) [m]: lengths of the sections.
        sections: each section's end in the frame of its start, (..., n_sections).
        load_kg (..., 1) [kg]: payload.
    """
    z = np.eye(3, dtype=length.dtype)[2]
    mass = estimator.gripper_mass_kg + load_kg
    gripper_m, payload_m = estimator.tool_offset_m[0], estimator.tool_offset_m[1]
    moment = -(estimator.gripper_mass_kg * gripper_m + load_kg * payload_m) * z
    moments = [moment[..., None, :]]
    for k in reversed(range(1, length.shape[-2])):  # from the tip up
        position_m, rotation = sections.position_m[..., k, :], sections.rotation[..., k, :, :]
        # Centre of a cubic curve whose ends have these directions
        centre_m = 0.5 * position_m + length[..., k, :] / 12.0 * (rotation[..., 2] - z)
        moment = (rotation @ moment[..., None])[..., 0] + mass * position_m
        moment = moment + estimator.section_mass_kg[k] * centre_m
        mass = mass + estimator.section_mass_kg[k]
        moments.append(moment[..., None, :])
    return array_namespace(moment).concat(moments[::-1], axis=-2)


def variables(
    length: Array, bend: Array, even_rotation: Array, up: Array, moment: Array, load_kg: Array
) -> Array:
    """Return what the change of a section's end depends on, (..., N_VARIABLES).

    These are its shape, the direction against gravity, the torque of gravity on the masses below, over its
    acceleration, and the payload.

    Args:
        length (..., 1) [m], bend (..., 2) [rad]: of the section.
        even_rotation (..., 3, 3): axes of its end in those of its start, of constant curvature.
        up (..., 3): direction against gravity in the axes of the section's start.
        moment (..., 3) [kg m]: of the masses below, see `first_moments`.
        load_kg (..., 1) [kg]: payload.
    """
    moment = (even_rotation @ moment[..., None])[..., 0]
    after, before = np.array([1, 2, 0]), np.array([2, 0, 1])
    torque = moment[..., after] * up[..., before] - moment[..., before] * up[..., after]
    return array_namespace(length).concat([length, bend, up, torque, load_kg], axis=-1)


def polynomial_terms(x: Array) -> Array:
    """Return the products (N_TERMS, ...) of variables (N_VARIABLES, ...) that the polynomial adds up."""
    xp = array_namespace(x)
    products = [xp.ones_like(x[:1])]
    for parent, factor in _PRODUCTS:
        products.append(products[-1][parent] * x[factor])
    return xp.concat(products, axis=0)


def _products() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return, for products of 1, 2, ... factors, the product of one factor less and the last factor."""
    levels = list[tuple[np.ndarray, np.ndarray]]()
    shorter: dict[tuple[int, ...], int] = {(): 0}  # places of products, as numbers of their variables
    for n_factors in range(1, _DEGREE + 1):
        products = combinations_with_replacement(range(N_VARIABLES), n_factors)
        products = [product for product in products if sum(_COSTS[k] for k in product) <= _DEGREE]
        parents = [shorter[product[:-1]] for product in products]
        levels.append((np.array(parents), np.array([product[-1] for product in products])))
        shorter = {product: place for place, product in enumerate(products)}
    return levels


N_VARIABLES = len(_COSTS)
_PRODUCTS = _products()
N_TERMS = 1 + sum(len(factors) for _, factors in _PRODUCTS)


def even_pose(base: Frame, spring_site_m: Array, spring_m: Array) -> Array:
    """Return the tip pose (..., 6) [mm, deg] with sections that bend evenly; arguments as of `backbone`."""
    return pose_from_frame(*compose(base, chain(constant_curvature(spring_site_m, spring_m))))


def compose(outer: Frame, inner: Frame) -> Frame:
    """Return the frame `inner`, which is given in the axes of `outer`, in those of `outer`'s own frame."""
    position_m = (outer.rotation @ inner.position_m[..., None])[..., 0] + outer.position_m
    return Frame(position_m, outer.rotation @ inner.rotation)


def constant_curvature(spring_site_m: Array, spring_m: Array) -> Frame:
    """Return the ends of sections of constant curvature by their springs; see `section_shapes` and `arcs`."""
    return arcs(*section_shapes(spring_site_m, spring_m))


def section_shapes(spring_site_m: Array, spring_m: Array) -> tuple[Array, Array]:
    """Return lengths (..., n_sections, 1) [m] and bends (..., n_sections, 2) [rad], by least squares.

    A section turns towards its shorter springs by |bend|.

    Args:
        spring_site_m (n_sections, s, 2) [m]: holes of the springs, three or more a section at equal angles.
        spring_m (..., n_sections * s) [m]: lengths.
    """
    xp = array_namespace(spring_m, spring_site_m)
    spring = spring_m.reshape(*spring_m.shape[:-1], *spring_site_m.shape[:2])
    length = xp.mean(spring, axis=-1)[..., None]
    moment = xp.sum((spring - length)[..., None] * spring_site_m, axis=-2)
    return length, -2.0 * moment / xp.sum(spring_site_m**2, axis=(-2, -1))[:, None]


def arcs(length: Array, bend: Array) -> Frame:
    """Return the ends (..., n_sections) of sections of constant curvature, with shapes of `section_shapes`.

    Each is in the frame of its section's start.

    Source: Webster, Jones, "Design and Kinematic Modeling of Constant Curvature Continuum Robots", 2010.
    """
    xp = array_namespace(length)
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


def chain(sections: Frame) -> Frame:
    """Return the frame of the last plate in the axes of the base, of sections (..., n_sections) in series."""
    *above, frame = (
        Frame(sections.position_m[..., k, :], sections.rotation[..., k, :, :])
        for k in range(sections.position_m.shape[-2])
    )
    for section in reversed(above):  # from the tip up to the base
        frame = compose(section, frame)
    return frame


def backbone(
    base: Frame, spring_site_m: np.ndarray, spring_m: np.ndarray, tip: np.ndarray, at: np.ndarray
) -> Frame:
    """Return frames (n_sections, k) along the arm in the base frame. NumPy only.

    Sections of constant curvature are in series, by the springs. The tip's distance from their end is
    spread over the arm: it grows evenly from the base.

    Args:
        base: frame (3,) [m], (3, 3) of the arm's own base.
        spring_site_m (n_sections, s, 2) [m]: holes of the springs.
        spring_m (n_sections * s,) [m]: lengths.
        tip (6,) [mm, deg]: pose; with NaN the arm ends where the springs bring it.
        at (k,): places as shares of each section's length; one of them is 1.
    """
    # Sections in series; a share of a section has the same share of its springs' lengths
    inner = constant_curvature(spring_site_m, at[:, None] * spring_m)  # (k, n_sections)
    last, frames, end = int(np.argmax(at)), [], base
    for section in range(inner.position_m.shape[1]):
        frames.append(compose(end, Frame(inner.position_m[:, section], inner.rotation[:, section])))
        end = Frame(frames[-1].position_m[last], frames[-1].rotation[last])
    position_m, rotation = map(np.stack, zip(*frames, strict=True))  # (n_sections, k)
    if not np.isfinite(tip).all():
        return Frame(position_m, rotation)

    # Spread the distance of the tip from their end
    tip_m, tip_rotation = frame_from_pose(np.asarray(tip, float))
    share = (np.arange(len(frames))[:, None] + at) / len(frames)  # share of the way to the tip
    turn = share_of_turn(tip_rotation @ end.rotation.T, share)
    return Frame(position_m + share[..., None] * (tip_m - end.position_m), turn @ rotation)


def expected_springs(model: SpringModel, pressure_kpa: Array) -> Array:
    """Return spring lengths (..., n_springs) [m] at rest at pressures (..., n_chambers) [kPa], unloaded."""
    xp = array_namespace(pressure_kpa, model.pressure_centre_kpa)
    pressure_kpa = xp.asarray(pressure_kpa, dtype=model.pressure_centre_kpa.dtype)
    normalised = (pressure_kpa - model.pressure_centre_kpa) / model.pressure_scale_kpa
    return model.spring_centre_m + model.spring_scale_m * mlp(model.layers, normalised)


def take_estimator(entries: Entries, n_sections: int, n_springs: int) -> PoseEstimator:
    """Take the pose estimator from the entries of a file."""
    return entries.network(
        "estimator",
        PoseEstimator,
        coefficient=(n_sections, N_TERMS, N_CHANGES),
        variable_centre=(n_sections, N_VARIABLES),
        variable_scale=(n_sections, N_VARIABLES),
        spring_site_m=(n_sections, n_springs // n_sections, 2),
        section_mass_kg=(n_sections,),
        gripper_mass_kg=(),
        tool_offset_m=(2,),
        base_position_m=(3,),
        base_rotation=(3, 3),
        tip_offset_m=(3,),
        tip_rotation=(3, 3),
    )


def take_spring_model(entries: Entries, n_chambers: int, n_springs: int) -> SpringModel:
    """Take the spring model from the entries of a file."""
    return entries.network(
        "spring_model",
        SpringModel,
        pressure_centre_kpa=(n_chambers,),
        pressure_scale_kpa=(n_chambers,),
        spring_centre_m=(n_springs,),
        spring_scale_m=(n_springs,),
        layers=(n_chambers, n_springs),
    )
