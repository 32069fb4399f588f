"""Parameters of the fit to poses at rest: chambers, backbone and mounting, in one vector that starts at zero.

Each entry is a change from the specification:

- per chamber: logarithms of the ratios of stiffness and area; slope of the area, in areas per section length;
  rest length, in section lengths
- backbone: logarithm of the ratio of the bending stiffness, one for all sections
- share of the chambers that is bonded to the backbone, one for all sections. It shows where the links of a
  section bend unlike each other, by the arm's weight or a payload. It takes in other differences of the arm
  from the model, too: it is a number of the model rather than of the bellows
- mounting: turn of the base about its own x and y, and its offset; roll of each section's holes; turn of the
  measured tip, and its offset within the last plate. A turn of the base about its own z is a roll of all
  sections. An axial offset of the tip cannot be distinguished from an offset of the base.
- sites of the markers at the sections' ends, each within its plate, since markers are stuck on by hand

A section stretches and bends: three degrees of freedom. Rest lengths of its chambers act through one force
and two moments, stiffnesses through the entries of a symmetric matrix. Around a circle of chambers these are
harmonics of order 0 and 1, and of order 0 to 2. Patterns of higher order, such as alternating rest lengths of
four chambers, change nothing that can be measured. They stay zero: the parameters are the harmonics that act,
and one number per chamber where all of them do.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support.fields import scaled
from mjx_softarm._support.small_matrices import product
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.sensing.load import QUANTILE
from mjx_softarm.sensing.pose import rotation_about, rotation_from_quaternion, rotation_vector
from mjx_softarm.spec import BONDS, ArmSpec, Structure

# The four parameters of a chamber.
FIELDS = ("stiffness_n_per_m", "area_m2", "area_slope_m", "length_offset_m")
BENDING = "bending_stiffness_nm_per_rad"  # field of the backbone
BOND = "bonded_share"  # field of the chambers
FIXED = 1e-4  # prior of a parameter that stays at its start


class Block(NamedTuple):
    """Parameters of one kind."""

    name: str
    per: str  # "chamber", "section", or "" for `n` of them
    n: int
    prior: float  # standard deviation about the start
    tolerance: float  # error within which a parameter counts as known
    order: int | None = None  # highest harmonic of a section's chambers that acts; None: all of them


BLOCKS = (
    Block("stiffness", "chamber", 0, 1.0, 0.05, order=2),  # prior a factor of e, tolerance 5 %
    Block("area", "chamber", 0, 1.0, 0.05),  # prior a factor of e, tolerance 5 %
    Block("slope", "chamber", 0, 1.0, 0.05),  # prior an area per section length
    Block("offset", "chamber", 0, 0.25, 0.005, order=1),  # prior a quarter, tolerance 1 mm of 200 mm
    Block(BENDING, "", 1, 1.0, 0.05),  # prior a factor of e, tolerance 5 %
    Block(BOND, "", 1, 0.5, 0.1),  # prior half of them, tolerance 0.1
    Block("base turn", "", 2, 0.1, 0.01),  # [rad] prior 6 deg, tolerance 0.6 deg
    Block("base offset", "", 3, 0.01, 0.002),  # [m]
    Block("roll", "section", 0, 0.2, 0.01),  # [rad] prior 11 deg
    Block("tip turn", "", 3, 0.5, 0.01),  # [rad] prior 29 deg
    Block("tip offset", "", 2, 0.01, 0.002),  # [m]
    Block("marker x", "section", 0, 0.05, 1.0),  # [m] any error is tolerated: nobody needs the sites
    Block("marker y", "section", 0, 0.05, 1.0),  # [m] any error is tolerated
)


def priors(spec: ArmSpec) -> np.ndarray:
    """Return standard deviations (p,) about the start."""
    values = _of_each(spec, "prior")
    if spec.structure.links_per_section == 1:  # a bond shows in the links of a section only
        values[names(spec).index(BOND)] = FIXED
    return values


def tolerances(spec: ArmSpec) -> np.ndarray:
    """Return errors (p,) within which parameters count as known."""
    return _of_each(spec, "tolerance")


def _of_each(spec: ArmSpec, number: str) -> np.ndarray:
    """Return a number of the blocks for each parameter (p,)."""
    return np.concatenate([np.full(_size(block, spec.structure), getattr(block, number)) for block in BLOCKS])


def names(spec: ArmSpec) -> list[str]:
    """Return the name of each parameter."""
    return [name for block in BLOCKS for name in _names(block, spec.structure)]


def without_effect(spec: ArmSpec) -> list[str]:
    """Return which fields of chambers have patterns around a section that change nothing."""
    each = zip(FIELDS, BLOCKS, strict=False)  # the first blocks are those of the chambers
    return [field for field, block in each if _size(block, spec.structure) < spec.n_chambers]


def _size(block: Block, structure: Structure) -> int:
    """Return the number of parameters of a block."""
    n, c = structure.n_sections, structure.chambers_per_section
    return {"chamber": n * _harmonics(block.order, c).shape[1], "section": n, "": block.n}[block.per]


def _names(block: Block, structure: Structure) -> Iterator[str]:
    n, c = _size(block, structure), structure.chambers_per_section
    if block.per == "chamber" and n < structure.n_sections * c:
        patterns = ["mean", *(f"{f}{k}" for k in range(1, c) for f in ("cos", "sin"))]
        per_section = n // structure.n_sections
        return (f"{block.name}{k // per_section} {patterns[k % per_section]}" for k in range(n))
    if block.per:
        return (f"{block.name}{k}" for k in range(n))
    return iter([block.name] if n == 1 else (f"{block.name} {axis}" for axis in "xyz"[:n]))


def _harmonics(order: int | None, n: int) -> np.ndarray:
    """Return the patterns (n, m) of a section's n chambers up to an order; the identity where all act."""
    if order is None or n <= 2 * order + 1:
        return np.eye(n)
    angle = 2 * np.pi * np.arange(n) / n
    waves = [wave(k * angle) for k in range(1, order + 1) for wave in (np.cos, np.sin)]
    return np.stack([np.ones(n), *waves], axis=-1)


def by_name(x: Array | np.ndarray, structure: Structure) -> dict[str, Any]:
    """Return the blocks of x (p, ...) by name, those of chambers with a number for each chamber."""
    values, start, n = {}, 0, structure.n_sections
    for block in BLOCKS:
        stop = start + _size(block, structure)
        value = x[start:stop]
        if block.per == "chamber" and stop - start < n * structure.chambers_per_section:
            patterns = _harmonics(block.order, structure.chambers_per_section)
            each = value.reshape(n, 1, patterns.shape[1], *value.shape[1:])
            weight = patterns.reshape(*patterns.shape, *(1 for _ in value.shape[1:])).astype(value.dtype)
            value = (weight * each).sum(axis=2).reshape(-1, *value.shape[1:])
        values[block.name], start = value, stop
    return values


def with_numbers(x: Array, params: ArmParams) -> ArmParams:
    """Return the arm at x (p,) where `params` is the arm at x = 0, with free chambers."""
    by = by_name(x, _structure_of(params))
    bend = jnp.exp(by[BENDING][0])
    joints = params.joint_stiffness.reshape(-1, 3) * jnp.stack([jnp.ones_like(bend), bend, bend])
    mount, zero = params.mount, jnp.zeros(1, x.dtype)
    base_turn = _turned(jnp.concatenate([by["base turn"], zero]))
    share = by[BOND][0]
    return params._replace(
        chamber_site_m=_rolled(params.chamber_site_m, by["roll"]),
        spring_site_m=_rolled(params.spring_site_m, by["roll"]),
        joint_stiffness=joints.reshape(-1),
        chamber_stiffness=params.chamber_stiffness * jnp.exp(by["stiffness"]),
        area=params.area * jnp.exp(by["area"]),
        area_slope=params.area_slope + by["slope"] * params.area / params.free_length_m,
        chamber_rest_m=params.chamber_rest_m + by["offset"] * params.free_length_m,
        mount=mount._replace(
            base_position_m=mount.base_position_m + by["base offset"],
            base_rotation=product(jnp.asarray(mount.base_rotation), base_turn),
            tip_offset_m=mount.tip_offset_m + jnp.concatenate([by["tip offset"], zero]),
            tip_rotation=product(jnp.asarray(mount.tip_rotation), _turned(by["tip turn"])),
        ),
        # At a limit the derivative stays, or the share would count as unknown
        bonded_share=share + jax.lax.stop_gradient(jnp.clip(share, *BONDS) - share),
    )


def free_arm(spec: ArmSpec, x: np.ndarray) -> tuple[np.ndarray, ArmParams]:
    """Return x (p,) and the arm for `with_numbers`: x counts the bonded share from that of `spec`."""
    at = names(spec).index(BOND)
    params = ArmParams.from_spec(spec.replace(chambers={BOND: 0.0}))
    return x + spec.chambers.bonded_share * (np.arange(len(x)) == at), params


def marker_sites(x: Array, params: ArmParams) -> Array:
    """Return where the sections' end markers sit in their plates (n_sections, 3) [m] at x (p,)."""
    by = by_name(x, _structure_of(params))
    return jnp.stack([by["marker x"], by["marker y"], jnp.zeros_like(by["marker x"])], axis=-1)


def _structure_of(params: ArmParams) -> Structure:
    n_sections, per_section, _ = params.chamber_site_m.shape
    return Structure(n_sections, params.link_mass_kg.shape[0] // n_sections, per_section)


def _rolled(site_m: Array, roll: Array) -> Array:
    """Turn sites (n_sections, k, 2) by the rolls (n_sections,) of their sections."""
    cos, sin = jnp.cos(roll)[:, None], jnp.sin(roll)[:, None]
    x, y = site_m[..., 0], site_m[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _turned(gibbs: Array) -> Array:
    """Return the rotation (3, 3) about a vector (3,), smooth at zero; its angle [rad] to second order."""
    quaternion = jnp.concatenate([jnp.ones(1, gibbs.dtype), 0.5 * gibbs])
    return rotation_from_quaternion(quaternion) / jnp.sum(quaternion**2)


def spec_at(spec: ArmSpec, x: np.ndarray) -> ArmSpec:
    """Return the specification at x (p,) where `spec` is the specification at x = 0."""
    # Change the chambers.
    by = by_name(x, spec.structure)
    old = {name: np.array(spec.per_chamber(getattr(spec.chambers, name))) for name in FIELDS}
    length_m, mounting = spec.at_chambers(spec.geometry.section_length_m), spec.mounting
    chambers = {
        "stiffness_n_per_m": old["stiffness_n_per_m"] * np.exp(by["stiffness"]),
        "area_m2": old["area_m2"] * np.exp(by["area"]),
        "area_slope_m": old["area_slope_m"] + by["slope"] * old["area_m2"] / length_m,
        "length_offset_m": old["length_offset_m"] + by["offset"] * length_m,
    }
    bond = float(np.clip(spec.chambers.bonded_share + by[BOND][0], *BONDS))
    # Turn and shift the mounting.
    base, tip = (rotation_about(np.radians(v)) for v in (mounting.base_turn_deg, mounting.tip_turn_deg))
    base = base @ np.asarray(_turned(jnp.append(by["base turn"], 0.0)), float)
    tip = tip @ np.asarray(_turned(jnp.asarray(by["tip turn"])), float)
    turned = {
        "base_turn_deg": np.degrees(rotation_vector(base)),
        "base_offset_m": mounting.base_offset_m + by["base offset"],
        "section_roll_deg": spec.section_roll_deg + np.degrees(by["roll"]),
        "tip_turn_deg": np.degrees(rotation_vector(tip)),
        "tip_offset_m": mounting.tip_offset_m + np.append(by["tip offset"], 0.0),
    }
    bending = scaled(spec.backbone.bending_stiffness_nm_per_rad, float(np.exp(by[BENDING][0])))
    return spec.replace(
        chambers={name: tuple(map(float, value)) for name, value in chambers.items()} | {BOND: bond},
        backbone={BENDING: bending},
        mounting={name: tuple(map(float, value)) for name, value in turned.items()},
    )


def half_widths(spec: ArmSpec, covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Return half-widths of 95 % intervals by field, in its unit.

    Args:
        spec: the fitted arm.
        covariance (p, p): covariance of the parameters.
    """
    # A root of the covariance turns into half-widths row by row, whatever parameters a chamber's number sums
    values, vectors = np.linalg.eigh(covariance)
    root = by_name(QUANTILE * vectors * np.sqrt(np.maximum(values, 0.0)), spec.structure)
    by = {name: np.linalg.norm(rows, axis=1) for name, rows in root.items()}
    length_m = spec.at_chambers(spec.geometry.section_length_m)
    area = np.array(spec.per_chamber(spec.chambers.area_m2))
    return {
        "stiffness_n_per_m": np.array(spec.per_chamber(spec.chambers.stiffness_n_per_m)) * by["stiffness"],
        "area_m2": area * by["area"],
        "area_slope_m": area / length_m * by["slope"],
        "length_offset_m": length_m * by["offset"],
        BENDING: np.multiply(spec.backbone.bending_stiffness_nm_per_rad, by[BENDING][0]),
        BOND: by[BOND][0],
        "base_turn_deg": np.append(np.degrees(by["base turn"]), 0.0),
        "base_offset_m": by["base offset"],
        "section_roll_deg": np.degrees(by["roll"]),
        "tip_turn_deg": np.degrees(by["tip turn"]),
        "tip_offset_m": np.append(by["tip offset"], 0.0),
    }
