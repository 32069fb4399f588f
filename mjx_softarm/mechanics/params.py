"""Parameters of an arm as arrays, from its specification."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support.xp import array_namespace
from mjx_softarm.control import Allocation, allocation
from mjx_softarm.mechanics.body import chamber_directions, holes_m, spring_directions
from mjx_softarm.pneumatics import Regulator, volume_m3
from mjx_softarm.posture import base_rotation, check_posture
from mjx_softarm.sensing.pose import rotation_about
from mjx_softarm.spec import LEAST_CHAMBERS, ArmSpec

N_PER_KPA_M2 = 1e3  # force of 1 kPa on 1 m^2
PAYLOAD = 1  # index in ArmParams.tool_mass_kg


class Mount(NamedTuple):
    """Frame of the base in the base frame, and frame of the tip on the last plate."""

    base_position_m: Array | np.ndarray  # (3,)
    base_rotation: Array | np.ndarray  # (3, 3)
    tip_offset_m: Array | np.ndarray  # (3,) in the axes of the last plate
    tip_rotation: Array | np.ndarray  # (3, 3)


class ArmParams(NamedTuple):
    """Parameters of an arm as arrays, so that a new value needs no new compilation.

    Chambers and springs are ordered section by section, counter-clockwise within a section.
    """

    link_length_m: Array  # (n_links,)
    section_length_m: Array  # (n_sections,)
    chamber_site_m: Array  # (n_sections, c, 2) x and y of the chambers' holes in their rings
    spring_site_m: Array  # (n_sections, s, 2) x and y of the springs' holes
    link_mass_kg: Array  # (n_links,) at the hinges' anchor
    tool_mass_kg: Array  # (2,) gripper and payload, below the last plate
    tool_offset_m: Array  # (2,)
    joint_stiffness: Array  # (3 * n_links,) [N/m, N m/rad, N m/rad]
    chamber_stiffness: Array  # (n_chambers,) [N/m]
    chamber_rest_m: Array  # (n_chambers,)
    area: Array  # (n_chambers,) [N/kPa]
    area_slope: Array  # (n_chambers,) [N/kPa/m]
    spring_stiffness: Array  # (n_springs,) [N/m]
    spring_rest_m: Array  # (n_springs,)
    law_stiffness: Array  # (n_springs,) [N/m] of a spring, by the law's gain; zeros if chambers are redundant
    pressure_min_kpa: Array  # (n_chambers,)
    pressure_max_kpa: Array  # (n_chambers,)
    mount: Mount
    bonded_share: Array | None = None  # () see `mjx_softarm.mechanics.statics`; None: free chambers
    allocation: Allocation | None = None  # of arms with redundant chambers, see `mjx_softarm.control`

    @property
    def n_sections(self) -> int:
        return self.section_length_m.shape[0]

    @property
    def free_length_m(self) -> Array:
        """(n_chambers, *arms) length of each chamber's section at rest."""
        xp = array_namespace(self.section_length_m)
        return xp.repeat(self.section_length_m, self.chamber_site_m.shape[1], axis=0)

    @property
    def pinned(self) -> Array:
        """(n_chambers,) bool, chambers whose limits leave one pressure."""
        return self.pressure_min_kpa == self.pressure_max_kpa

    def without_pressure_limits(self) -> ArmParams:
        """Return the arm with limits that no pressure meets."""
        limit = jnp.full_like(self.area, jnp.inf)
        return self._replace(pressure_min_kpa=-limit, pressure_max_kpa=limit)

    def with_law_gain(self, held: Array, reference_m: Array) -> ArmParams:
        """Return the arm with the law's proportional gain as springs about the references, where `held`.

        This changes no equilibrium at which these springs are on their references, but it may make it stable.
        Redundant chambers are not held.
        """
        if self.allocation is not None:
            return self
        stiffness = self.spring_stiffness + self.law_stiffness
        pull = self.spring_stiffness * self.spring_rest_m + self.law_stiffness * reference_m
        return self._replace(
            spring_stiffness=jnp.where(held, stiffness, self.spring_stiffness),
            spring_rest_m=jnp.where(held, pull / stiffness, self.spring_rest_m),
        )

    def volume_m3(self, length_m: Array) -> Array:
        """Return the volumes (n_chambers, *arms) [m^3] of chambers with lengths (n_chambers, *arms) [m]."""
        area = self.area / N_PER_KPA_M2, self.area_slope / N_PER_KPA_M2
        return volume_m3(length_m, *area, self.free_length_m)

    def stiffened(self, factor: Array) -> ArmParams:
        """Return the arm with its chambers' stiffnesses times factors (n_chambers,)."""
        # Rounded as in the published results
        return self._replace(
            chamber_stiffness=self.chamber_stiffness + (factor - 1.0) * self.chamber_stiffness
        )

    @classmethod
    def from_spec(cls, spec: ArmSpec, dtype: np.typing.DTypeLike = np.float32) -> ArmParams:
        """Return the numbers of `spec`, in SI units but for the pressures [kPa]."""
        # A section's backbone is `links_per_section` links in series
        geometry, backbone, chambers = spec.geometry, spec.backbone, spec.chambers
        per_section = spec.structure.links_per_section
        n = spec.n_chambers
        axial = np.array(spec.per_section(backbone.axial_stiffness_n_per_m)) * per_section
        bending = np.array(spec.per_section(backbone.bending_stiffness_nm_per_rad)) * per_section
        joints = np.stack([axial, bending, bending], axis=-1)  # (n_sections, 3)

        values: dict[str, Any] = {
            "link_length_m": spec.link_length_m,
            "section_length_m": spec.per_section(geometry.section_length_m),
            "chamber_site_m": holes_m(chamber_directions(spec), spec.per_section(geometry.chamber_radius_m)),
            "spring_site_m": holes_m(spring_directions(spec), spec.per_section(geometry.spring_radius_m)),
            "link_mass_kg": np.repeat(spec.section_mass_kg, per_section) / per_section,
            "tool_mass_kg": [spec.mass.gripper_kg, spec.mass.payload_kg],
            "tool_offset_m": [spec.mass.gripper_length_m / 2, spec.mass.gripper_length_m],
            "joint_stiffness": np.repeat(joints, per_section, axis=0).ravel(),
            "chamber_stiffness": spec.per_chamber(chambers.stiffness_n_per_m),
            "chamber_rest_m": spec.at_chambers(geometry.section_length_m)
            + np.array(spec.per_chamber(chambers.length_offset_m)),
            "area": 1e3 * np.array(spec.per_chamber(chambers.area_m2)),
            "area_slope": 1e3 * np.array(spec.per_chamber(chambers.area_slope_m)),
            "spring_stiffness": spec.at_springs(spec.springs.stiffness_n_per_m),
            "spring_rest_m": spec.at_springs(spec.springs.rest_length_m),
            "law_stiffness": _law_stiffness(spec),
            "pressure_min_kpa": np.full(n, chambers.pressure_min_kpa),
            "pressure_max_kpa": np.full(n, chambers.pressure_max_kpa),
        }
        numbers = {name: np.asarray(value, dtype) for name, value in values.items()}
        matrices = jax.tree.map(lambda matrix: matrix.astype(dtype), allocation(spec))
        share = np.asarray(chambers.bonded_share, dtype) if chambers.bonded_share else None
        return cls(**numbers, mount=_mount(spec, dtype), bonded_share=share, allocation=matrices)  # type: ignore


def _law_stiffness(spec: ArmSpec) -> np.ndarray:
    """Return the forces per length (n_springs,) [N/m] with which the law answers to errors at once.

    They are zero for redundant chambers, which answer to several springs, whose errors need not vanish at
    rest, and for regulators, which answer too late to hold an arm.
    """
    redundant = spec.structure.chambers_per_section > LEAST_CHAMBERS
    if redundant or isinstance(spec.actuators, Regulator):
        return np.zeros(spec.n_springs)
    return spec.control.kp_kpa_per_m * N_PER_KPA_M2 * np.array(spec.per_chamber(spec.chambers.area_m2))


def _mount(spec: ArmSpec, dtype: np.typing.DTypeLike) -> Mount:
    """Return the mount of `spec`; raise SpecError where `check_posture` does."""
    check_posture(spec)
    mounting = spec.mounting
    tip = rotation_about(np.radians(mounting.tip_turn_deg))
    values = (mounting.base_offset_m, base_rotation(spec), mounting.tip_offset_m, tip)
    return Mount(*(np.asarray(value, dtype) for value in values))
