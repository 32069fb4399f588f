"""The rod twin: an arm with other physics than training's, behind the same `ArmIO` as `Twin`.

The arm is a rod of `mjx_softarm.twin.rod`: it bends, shears, twists and extends without joints. Chambers
are glued to it, whatever `bonded_share` the specification has. Each chamber hardens by a law of its own,
and its effective area grows with pressure. The base is tilted, the sections are rolled against each other,
and motion capture's frame of the tip is turned against the last plate and offset from its centre. Its
chambers have regulators, whatever the specification has. There is no hysteresis and no inertia. Readings,
noise and clock are those of `Twin`. Parts are drawn from the seed.

The gap is that of `Twin`, and the tolerances for base, roll and springs are the same. At the spring lengths
that bring training's model to the paper's circle, the tips of rods 100 to 105, which no experiment uses, are
18.4 mm and 6.9 deg off. The chambers' laws hardly change these: they show in the pressures that hold a shape,
and so in the payload.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjx_softarm._support.fields import PerChamber, PerSection
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.pneumatics import Pneumatics, Regulator
from mjx_softarm.sensing.pose import rotation_about
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin.instruments import (
    AS_BUILT,
    EVALUATION_SESSION,
    MARKERS_PER_SECTION,
    Build,
    InstrumentedArm,
    drawn,
    scaled_tolerances,
)
from mjx_softarm.twin.rod import Rod, RodParts

ELEMENTS_PER_SECTION = 6  # tip within 0.2 mm of that with twelve elements
AIR_STEPS = 4  # time steps of the chambers' air in a control period
# Bounds of a rod's regulators, about as in the public logs of ASU-RISE-Lab/4-chamber-softarm-control. Rates
# and deadband are in proportion to the arm's range of pressures. Lag and rates hold for a chamber of constant
# length. A chamber expands as it fills: the pressures of the paper's arm change half as fast.
LAG_S, DEAD_TIME_S = (0.15, 0.6), (0.05, 0.25)
FILL_PER_S, VENT_PER_S = (1.4, 2.8), (0.8, 1.8)  # in ranges of pressure
DEADBAND = (1 / 600, 4 / 600)  # in ranges of pressure; 0.1 to 0.4 kPa of the paper's arm
LAW_SPREAD = 0.6  # hardening and growth of a chamber differ from their means by up to this share
CHAMBER_SPREAD = 0.1  # lag, dead time and rates of a chamber differ from the rod's by up to this share


@dataclass(frozen=True)
class RodTolerances:
    """Deviations from the specification at a gap of 1: values of all rods, then standard deviations.

    Torsion and shear are arrays (n_sections,) where they have been scaled to an arm.
    """

    hardening: float = 0.5  # mean of the chambers: 50 % stiffer at a section's length from rest
    area_growth: float = 0.05  # mean of the chambers: growth of the area over the range of pressure
    torsion_rad_per_nm: float | np.ndarray = 0.08  # value of all rods: compliance of a section
    shear_per_n: float | np.ndarray = 6e-4  # value of all rods: compliance
    skew: float = 0.15  # per chamber: stiffer in stretch, or in compression, a section's length from rest
    chamber_stiffness: float = 0.05  # relative, per chamber
    chamber_area: float = 0.03  # relative, per chamber
    chamber_length_m: float = 0.001  # per chamber
    backbone_stiffness: float = 0.06  # relative, per section
    section_mass: float = 0.03  # relative, per section
    hole_radius_m: float = 0.001  # per chamber, and per spring
    hole_angle_deg: float = 1.0  # per chamber, and per spring
    section_roll_deg: float = 1.75  # per section, against the section above
    base_tilt_deg: float = 0.9  # per axis
    base_offset_m: float = 0.003  # per axis
    tip_turn_deg: float = 1.0  # per axis: motion capture's frame against the last plate
    tip_offset_m: float = 0.001  # per axis: motion capture's frame against the last plate's centre
    spring_beta: float = 0.01  # relative, per spring
    spring_delta_m: float = 0.00075  # per spring


class RodTwin(InstrumentedArm):
    """One rod with regulators, sensors and cameras; an `ArmIO` with motion capture."""

    rod_kind: Any = Rod  # a subclass may have another, with the same methods

    def __init__(
        self,
        seed: int,
        spec: ArmSpec | None = None,
        payload_kg: float = 0.0,
        session: int = EVALUATION_SESSION,
        build: Build = AS_BUILT,
    ):
        """Hang the arm up, unpressurised and at rest; arguments as for `Twin`."""
        spec = spec or ArmSpec.default()
        self._per_section = build.per_section or ELEMENTS_PER_SECTION
        rng = np.random.default_rng(seed)
        std = _scaled(build.gap, spec)

        # Mounting of the base and of the tip, then sensors and the rod; the order belongs to the seed
        mounting = spec.mounting
        self._base_m = mounting.base_offset_m + drawn(rng, std.base_offset_m, 3)
        tilt = rotation_about(np.radians(drawn(rng, std.base_tilt_deg, 3)) * [1.0, 1.0, 0.0])
        self._base_rotation = rotation_about(np.radians(mounting.base_turn_deg)) @ tilt
        self._tip_m = mounting.tip_offset_m + drawn(rng, std.tip_offset_m, 3)
        tip_turn = rotation_about(np.radians(drawn(rng, std.tip_turn_deg, 3)))
        self._tip_turn = rotation_about(np.radians(mounting.tip_turn_deg)) @ tip_turn
        sensor = spec.spring_sensor
        beta = sensor.beta * (1.0 + drawn(rng, std.spring_beta, spec.n_springs))
        delta_m = sensor.delta_m + drawn(rng, std.spring_delta_m, spec.n_springs)
        sensor = dataclasses.replace(sensor, beta=beta, delta_m=delta_m)
        super().__init__(spec, sensor, seed, session, build)
        parts = draw_rod(rng, seed, spec, std, self._base_rotation[2])
        parts = parts._replace(stiffness=(1.0 - build.softening) * parts.stiffness)
        self._rod = self.rod_kind(parts, self._per_section)

        # Chambers with air and regulators
        self._period_s = 1.0 / spec.control.rate_hz
        area_m2, slope_m = 1e-3 * parts.area.ravel(), 1e-3 * parts.area_slope.ravel()
        rest_m = spec.at_chambers(spec.geometry.section_length_m)
        now_m = self._rod.chamber_lengths()
        regulator = draw_regulator(seed, spec, build.losses)
        self._air = Pneumatics(area_m2, slope_m, rest_m, now_m, self._period_s / AIR_STEPS, regulator)

        # At rest without pressure
        self.attach(payload_kg)
        self.settle(np.zeros(spec.n_chambers))

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Command pressures (n,) [kPa], then let one control period pass; see `ArmIO`."""
        self._air.command(self._commands(pressure_kpa))
        length_m = self._rod.chamber_lengths()
        for _ in range(AIR_STEPS):
            self._air.step(length_m)
        self._rod.step(self._air.pressure_kpa, self._period_s)
        self.time_s += self._period_s

    def settle(self, pressure_kpa: np.ndarray) -> None:
        """Move to rest at pressures (n,) [kPa] without time passing."""
        pressure_kpa = self._commands(pressure_kpa)
        self._rod.settle(pressure_kpa)
        self._air.hold(pressure_kpa, self._rod.chamber_lengths())

    def _lengths_m(self) -> np.ndarray:
        return self._rod.spring_lengths()

    def motion_capture(self) -> Capture:
        """Return the tip, and markers in the rod at each third of a section, from the base to the tip."""
        n_markers = MARKERS_PER_SECTION * self._spec.structure.n_sections
        thirds = np.arange(1, n_markers + 1) * self._per_section // MARKERS_PER_SECTION
        node_m, rotation = self._rod.shape()
        marker_m = self._base_m + node_m[thirds] @ self._base_rotation.T
        tip_m = self._base_m + self._base_rotation @ (node_m[-1] + rotation[-1] @ self._tip_m)
        tip = self._capture_turn() @ self._base_rotation @ rotation[-1] @ self._tip_turn
        return self._capture(tip_m, tip, marker_m)

    def _hang(self, payload_kg: float) -> None:
        parts = self._rod.parts
        masses = np.array([parts.tool_mass_kg[0], payload_kg])
        self._rod.parts = parts._replace(tool_mass_kg=masses)


def draw_rod(
    rng: np.random.Generator, seed: int, spec: ArmSpec, std: RodTolerances, up: np.ndarray
) -> RodParts:
    """Draw the numbers of a rod; `up` (3,) points against gravity, in the axes of its base.

    `rng` is in the middle of the rod's draws; the chambers' laws have random numbers of the seed.
    """
    # Numbers of sections (s,), and of chambers (s, c)
    geometry, chambers, backbone = spec.geometry, spec.chambers, spec.backbone
    s = spec.structure.n_sections
    n_chambers = spec.structure.chambers_per_section
    per_chamber = s, n_chambers

    def of_section(value: PerSection) -> np.ndarray:
        return np.array(spec.per_section(value))

    def of_chamber(value: PerChamber) -> np.ndarray:
        return np.reshape(spec.per_chamber(value), per_chamber)

    def factors(deviation: float, *shape: int) -> np.ndarray:
        return 1.0 + drawn(rng, deviation, *shape)

    # The order of the draws belongs to the seed: another order makes other rods.
    length_m = of_section(geometry.section_length_m)
    rest_m = length_m[:, None] + of_chamber(chambers.length_offset_m)
    roll_rad = np.radians(drawn(rng, std.section_roll_deg, s))
    area = factors(std.chamber_area, *per_chamber)
    stiff = factors(std.backbone_stiffness, s)
    return RodParts(
        section_length_m=length_m,
        section_mass_kg=np.array(spec.section_mass_kg) * factors(std.section_mass, s),
        bending=of_section(backbone.bending_stiffness_nm_per_rad) * length_m * stiff,
        torsion=length_m / np.maximum(std.torsion_rad_per_nm, 1e-4) * stiff,
        shear=stiff / np.maximum(std.shear_per_n, 1e-6),
        extension=of_section(backbone.axial_stiffness_n_per_m) * length_m * stiff,
        joint=np.stack([rotation_about(np.array([0.0, 0.0, roll])) for roll in roll_rad]),
        chamber_hole_m=_holes(rng, spec, std, geometry.chamber_radius_m, n_chambers),
        spring_hole_m=_holes(rng, spec, std, geometry.spring_radius_m, spec.springs_per_section),
        stiffness=of_chamber(chambers.stiffness_n_per_m) * factors(std.chamber_stiffness, *per_chamber),
        **_chamber_laws(seed, spec, std),
        rest_m=rest_m + drawn(rng, std.chamber_length_m, *per_chamber),
        area=1e3 * of_chamber(chambers.area_m2) * area,
        area_slope=1e3 * of_chamber(chambers.area_slope_m) * area,
        spring_stiffness=of_section(spec.springs.stiffness_n_per_m),
        spring_rest_m=of_section(spec.springs.rest_length_m),
        tool_mass_kg=np.array([spec.mass.gripper_kg, 0.0]),
        tool_offset_m=spec.mass.gripper_length_m * np.array([0.5, 1.0]),
        up=up,
    )


def _chamber_laws(seed: int, spec: ArmSpec, std: RodTolerances) -> dict[str, np.ndarray]:
    """Draw hardening, area growth and skew (s, c) of the chambers, with random numbers of their own."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    range_kpa = spec.chambers.pressure_max_kpa - spec.chambers.pressure_min_kpa
    shape = spec.structure.n_sections, spec.structure.chambers_per_section
    hardening, growth = (
        mean * rng.uniform(1.0 - LAW_SPREAD, 1.0 + LAW_SPREAD, shape)
        for mean in (std.hardening, std.area_growth / range_kpa)
    )
    return {"hardening": hardening, "area_growth": growth, "skew": drawn(rng, std.skew, *shape)}


def _holes(
    rng: np.random.Generator, spec: ArmSpec, std: RodTolerances, radius_m: PerSection, n: int
) -> np.ndarray:
    """Draw places (s, n, 2) of n holes in each section at equal angles."""
    s = spec.structure.n_sections
    first_deg = np.array(spec.per_section(spec.geometry.first_chamber_deg))
    first = np.radians(first_deg + spec.section_roll_deg)[:, None]
    angle = first + 2 * np.pi * np.arange(n) / n
    angle = angle + np.radians(drawn(rng, std.hole_angle_deg, s, n))
    radius = np.array(spec.per_section(radius_m))[:, None] + drawn(rng, std.hole_radius_m, s, n)
    return radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def draw_regulator(seed: int, spec: ArmSpec, deadband: float = 1.0) -> Regulator:
    """Draw the regulators of a rod from its seed; `deadband` is a factor of their deadband."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    range_kpa = spec.chambers.pressure_max_kpa - spec.chambers.pressure_min_kpa

    def each(bounds: tuple[float, float]) -> np.ndarray:
        """Draw a number of the rod, and a number near it for each chamber (n,)."""
        mean = rng.uniform(*bounds)
        return mean * rng.uniform(1.0 - CHAMBER_SPREAD, 1.0 + CHAMBER_SPREAD, spec.n_chambers)

    return Regulator(
        lag_s=each(LAG_S),
        dead_time_s=each(DEAD_TIME_S),
        fill_kpa_per_s=range_kpa * each(FILL_PER_S),
        vent_kpa_per_s=range_kpa * each(VENT_PER_S),
        deadband_kpa=deadband * range_kpa * each(DEADBAND),
    )


def _scaled(gap: float, spec: ArmSpec) -> RodTolerances:
    """Return an arm's tolerances; lengths and compliances are in proportion to the arm's."""
    paper = ArmSpec.default()

    def ratio(of_paper: PerSection, own: PerSection) -> np.ndarray:
        """Return the paper's mean number, divided by the numbers of the arm's sections (n_sections,)."""
        return np.mean(of_paper) / np.array(spec.per_section(own))

    bending = ratio(paper.backbone.bending_stiffness_nm_per_rad, spec.backbone.bending_stiffness_nm_per_rad)
    axial = ratio(paper.backbone.axial_stiffness_n_per_m, spec.backbone.axial_stiffness_n_per_m)
    section = np.array(spec.per_section(spec.geometry.section_length_m)) / np.mean(
        paper.geometry.section_length_m
    )
    factors = {"torsion_rad_per_nm": bending, "shear_per_n": axial / section}
    return scaled_tolerances(RodTolerances(), gap, spec, **factors)
