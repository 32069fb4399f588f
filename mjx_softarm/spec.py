"""Specification of an arm: every physical number once, with its unit, read from TOML.

An `ArmSpec` is a tree of frozen dataclasses, one for each table of a TOML file. `arms/paper.toml` is the arm
of the paper, with the source of each number.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjx_softarm._support.fields import (
    PerChamber,
    PerSection,
    SpecError,
    anything,
    count,
    not_negative,
    numbers,
    positive,
    read_fields,
    vector,
    wrong_counts,
)
from mjx_softarm.arms import shipped_arm
from mjx_softarm.pneumatics import ACTUATORS, PAPER_PUMP, Actuators, Pneumatics
from mjx_softarm.sensing.sensors import SENSORS, Sensor

ARM_FILE = "arm.toml"  # in the folder of a calibration
# Lag of a section's shape over damping by stiffness of its backbone: free chambers and weight stiffen it.
# Of the paper's arm, simulated on the circle in 20 s.
SHAPE_SHARE = 0.65
MOST_RATIO = 3.0  # of a spring's length and that of its section, either way; larger ratios are input errors
LEAST_CHAMBERS, MOST_CHAMBERS = 3, 12  # of a section; fewer bend it in one plane
BONDS = -0.3, 2.0  # of rods, whose springs are bonded, too, calibrations find up to 1.3
# Upper bounds that no soft arm exceeds, but its number in another unit does.
LENGTH = {"high": 2.0, "unit": "m, not mm"}
MASS = {"high": 50.0, "unit": "kg, not g"}
AREA = {"high": 0.1, "unit": "m2, not cm2 or mm2"}
PRESSURE = {"high": 2000.0, "unit": "kPa, not Pa"}
PAPER_S_ARM_KG = 4.7  # mass of the paper's arm, which carries up to 1 kg


@dataclass(frozen=True)
class Structure:
    """Counts of sections and links. They fix array shapes, so a new value needs a new compilation."""

    n_sections: int = count()
    links_per_section: int = count()
    chambers_per_section: int = count(default=3, low=LEAST_CHAMBERS, high=MOST_CHAMBERS)
    springs_per_section: int = count(default=0, low=0, high=MOST_CHAMBERS)  # 0: one beside each chamber


@dataclass(frozen=True)
class Geometry:
    """Lengths and angles of the unloaded arm at rest, each a number or one for each section.

    Chambers stand at equal angles, counter-clockwise from the first one seen from above, with springs beside
    them. Where springs are fewer, the first chamber has one, and every k-th chamber from there.
    """

    section_length_m: PerSection = positive(per="sections", **LENGTH)
    chamber_radius_m: PerSection = positive(per="sections", **LENGTH)
    spring_radius_m: PerSection = positive(per="sections", **LENGTH)
    first_chamber_deg: PerSection = anything(per="sections", low=-360.0, high=360.0)
    chamber_diameter_m: PerSection = positive(per="sections", **LENGTH)


@dataclass(frozen=True)
class Mass:
    """Masses. The arm's own mass is one number, spread evenly over all links, or one for each section."""

    arm_kg: PerSection = positive(per="sections", **MASS)
    gripper_kg: float = not_negative(**MASS)
    gripper_length_m: float = positive(**LENGTH)
    payload_kg: float = not_negative(**MASS)

    @property
    def largest_payload_kg(self) -> float:
        """Largest payload on top of `payload_kg`: 1 kg for the paper's arm, others by their mass."""
        arm_kg = sum(self.arm_kg) if isinstance(self.arm_kg, tuple) else self.arm_kg
        return (arm_kg + self.gripper_kg) / PAPER_S_ARM_KG


@dataclass(frozen=True)
class Chambers:
    """Bellows: force = pressure * (area_m2 + area_slope_m * (length - section length)).

    A bellows that is free between the ends of its section resists a change of its length alone. One that is
    bonded to every ring resists a change of each of its pieces, from ring to ring. `bonded_share` is 0 for
    free and 1 for bonded chambers, see `mjx_softarm.mechanics.statics`. Above 1 something else is bonded,
    too, such as the springs; a negative share makes links softer. Damping and pressure act on the whole
    length.
    """

    area_m2: PerChamber = positive(per="chambers", **AREA)
    area_slope_m: PerChamber = anything(per="chambers")
    stiffness_n_per_m: PerChamber = positive(per="chambers")
    damping_ns_per_m: PerChamber = not_negative(per="chambers")
    length_offset_m: PerChamber = anything(per="chambers", low=-0.1, high=0.1)
    pressure_min_kpa: float = anything(low=-101.325, **PRESSURE)
    pressure_max_kpa: float = anything(low=-101.325, **PRESSURE)
    bonded_share: float = anything(default=0.0, low=BONDS[0], high=BONDS[1])


@dataclass(frozen=True)
class Backbone:
    """Stiffness and damping of one whole section besides its chambers and springs."""

    axial_stiffness_n_per_m: PerSection = positive(per="sections")
    bending_stiffness_nm_per_rad: PerSection = positive(per="sections")
    axial_damping_ns_per_m: PerSection = not_negative(per="sections")
    bending_damping_nms_per_rad: PerSection = not_negative(per="sections")


@dataclass(frozen=True)
class Springs:
    """Springs with their sensed lengths, and the range of lengths that may be commanded."""

    stiffness_n_per_m: PerSection = not_negative(per="sections")
    damping_ns_per_m: PerSection = not_negative(per="sections")
    rest_length_m: PerSection = positive(per="sections", **LENGTH)
    length_min_m: PerSection = positive(per="sections", **LENGTH)
    length_max_m: PerSection = positive(per="sections", **LENGTH)


@dataclass(frozen=True)
class Control:
    """Gains of the sensor-space law; see `mjx_softarm.control`."""

    rate_hz: float = positive()
    kp_kpa_per_m: float = not_negative()
    ki_kpa_per_ms: float = positive()
    kd_kpa_s_per_m: float = not_negative()
    reference_s: float = not_negative()


@dataclass(frozen=True)
class Mounting:
    """Mount of the base in the frame of motion capture, and of the measured tip on the last plate.

    Turns are rotation vectors. All are zero in a perfect arm, and where a file has no such table.
    """

    base_turn_deg: tuple[float, ...] = vector()  # turn of the base, in the base frame
    base_offset_m: tuple[float, ...] = vector()  # offset of the base, in the base frame
    section_roll_deg: tuple[float, ...] = numbers(per="sections")  # roll of a section's holes about its axis
    tip_turn_deg: tuple[float, ...] = vector()  # turn of the measured tip, in the axes of the last plate
    tip_offset_m: tuple[float, ...] = vector()  # offset of the measured tip, in the axes of the last plate


@dataclass(frozen=True)
class Unmodelled:
    """Residual pressures that hold the unloaded arm: measured minus simulated.

    The simulation ignores them; the estimate of a payload from pressures subtracts them.
    """

    pressure_kpa: tuple[float, ...] = numbers(per="chambers")


@dataclass(frozen=True)
class ArmSpec:
    """A pneumatic soft arm: sections in series, with chambers and springs in each.

    Build one with `ArmSpec.default()`, `ArmSpec.from_toml(path)` or `spec.replace(...)`; each of
    them validates. A field marked per chamber holds one number or a tuple of `n_chambers`, one marked per
    section a number or a tuple of `n_sections`.
    """

    name: str
    structure: Structure
    geometry: Geometry
    mass: Mass
    chambers: Chambers
    backbone: Backbone
    springs: Springs
    sensor: Sensor = field(metadata={"kinds": SENSORS})  # the first kind where a file has none
    control: Control
    mounting: Mounting = field(default_factory=Mounting)
    unmodelled: Unmodelled = field(default_factory=Unmodelled)
    actuators: Actuators = field(default=PAPER_PUMP, metadata={"kinds": ACTUATORS})

    @property
    def length_m(self) -> float:
        """Length of the unloaded arm at rest."""
        return sum(self.per_section(self.geometry.section_length_m))

    @property
    def n_chambers(self) -> int:
        return self.structure.chambers_per_section * self.structure.n_sections

    @property
    def springs_per_section(self) -> int:
        return self.structure.springs_per_section or self.structure.chambers_per_section

    @property
    def n_springs(self) -> int:
        return self.springs_per_section * self.structure.n_sections

    @property
    def n_links(self) -> int:
        return self.structure.n_sections * self.structure.links_per_section

    @property
    def link_length_m(self) -> np.ndarray:
        """Length of each link (n_links,) of the unloaded arm at rest."""
        per_section = self.structure.links_per_section
        return np.repeat(self.per_section(self.geometry.section_length_m), per_section) / per_section

    @property
    def spring_sensor(self) -> Sensor:
        """The sensor with one calibration per spring."""
        return self.sensor.per_spring(self.n_springs)

    def pneumatics(self, length_m: np.ndarray, timestep_s: float) -> Pneumatics:
        """Return the air of chambers with lengths (n_chambers,) [m] at the start, stepped by `timestep_s`."""
        area = self.chambers.area_m2, self.chambers.area_slope_m
        area_m2, slope_m = (np.array(self.per_chamber(value)) for value in area)
        rest_m = self.at_chambers(self.geometry.section_length_m)
        actuators = self.actuators.per_chamber(self.n_chambers)
        return Pneumatics(area_m2, slope_m, rest_m, length_m, timestep_s, actuators)

    def per_chamber(self, value: PerChamber) -> tuple[float, ...]:
        """Return one number per chamber, from a field with one number or one per chamber."""
        return tuple(value) if isinstance(value, tuple) else (float(value),) * self.n_chambers

    def per_section(self, value: PerSection) -> tuple[float, ...]:
        """Return one number per section, from a field with one number or one per section."""
        return tuple(value) if isinstance(value, tuple) else (float(value),) * self.structure.n_sections

    def at_chambers(self, value: PerSection) -> np.ndarray:
        """Return the number of each chamber's section (n_chambers,)."""
        return np.repeat(self.per_section(value), self.structure.chambers_per_section)

    def at_springs(self, value: PerSection) -> np.ndarray:
        """Return the number of each spring's section (n_springs,)."""
        return np.repeat(self.per_section(value), self.springs_per_section)

    @property
    def section_mass_kg(self) -> tuple[float, ...]:
        """Own mass of each section."""
        n = self.structure.n_sections
        arm_kg = self.mass.arm_kg
        return arm_kg if isinstance(arm_kg, tuple) else (arm_kg / n,) * n

    @property
    def shape_lag_s(self) -> float:
        """Time constant with which a section's bend is shared out within it, a mean over the sections."""
        bending = np.array(self.per_section(self.backbone.bending_stiffness_nm_per_rad))
        damping = self.per_section(self.backbone.bending_damping_nms_per_rad)
        return float(np.mean(np.divide(damping, bending / SHAPE_SHARE + self._bonded()[1])))

    def _bonded(self) -> tuple[np.ndarray, np.ndarray]:
        """Return stiffnesses [N/m, N m/rad] (n_sections,) of bonds against links unlike each other."""
        stiffness = self.per_chamber(self.chambers.stiffness_n_per_m)
        axial = np.reshape(stiffness, (-1, self.structure.chambers_per_section)).sum(axis=1)
        axial = self.chambers.bonded_share * axial
        return axial, axial * np.square(self.per_section(self.geometry.chamber_radius_m)) / 2

    @property
    def section_roll_deg(self) -> tuple[float, ...]:
        """Roll of each section about its axis."""
        return self.mounting.section_roll_deg or (0.0,) * self.structure.n_sections

    @property
    def unmodelled_kpa(self) -> np.ndarray:
        """Residual pressures (n_chambers,) [kPa] that hold the unloaded arm."""
        return np.array(self.unmodelled.pressure_kpa or np.zeros(self.n_chambers))

    @classmethod
    def default(cls) -> ArmSpec:
        """Return the paper's arm."""
        return cls.from_dict(tomllib.loads(shipped_arm("paper")), "arms/paper.toml")

    @classmethod
    def of(cls, path: Path | None) -> ArmSpec:
        """Return the arm of a file, or a shipped arm by its name; None is the paper's arm.

        Raises:
            SpecError: there is no such arm, or a field is not valid.
        """
        if path is None:
            return cls.default()
        if path.suffix or path.exists():
            return cls.from_toml(path)
        return cls.from_dict(tomllib.loads(shipped_arm(str(path))), f"arms/{path}.toml")

    @classmethod
    def from_toml(cls, path: str | Path) -> ArmSpec:
        """Read and validate a TOML file.

        Raises:
            SpecError: the file cannot be read or parsed, or a field is missing, unknown or out of range.
        """
        try:
            data = tomllib.loads(Path(path).read_text("utf-8"))
        except OSError as error:
            raise SpecError(f"{path}: got {error.strerror!r}, expected a specification") from error
        except (ValueError, RecursionError) as error:  # no TOML, no UTF-8, or nested too deeply
            raise SpecError(f"{path}: got {error}, expected TOML") from error
        return cls.from_dict(data, str(path))

    @classmethod
    def from_dict(cls, data: dict[str, Any], source: str = "spec") -> ArmSpec:
        """Build from nested dictionaries, as `to_dict` gives them.

        Raises:
            SpecError: a field is missing, unknown, of the wrong type or out of range.
        """
        spec = cls(**read_fields(cls, data, f"{source}: "))
        if problem := next(spec._contradictions(), None):  # the first explains the others
            raise SpecError(f"{source}: {problem}")
        return spec

    def to_dict(self) -> dict[str, Any]:
        """Return nested dictionaries, as a TOML file has them."""
        data = dataclasses.asdict(self)
        for table in ("sensor", "actuators"):
            data[table] = {"kind": getattr(self, table).kind, **data[table]}
        return data

    def to_toml(self, path: str | Path) -> None:
        """Write the specification, so that `from_toml` gives an equal one."""
        import tomli_w

        Path(path).write_text(tomli_w.dumps(self.to_dict()), "utf-8")

    def replace(self, **groups: dict[str, Any] | str) -> ArmSpec:
        """Return a new, validated specification with some fields changed.

        Example: `spec.replace(mass={"payload_kg": 0.2}, structure={"links_per_section": 6})`.
        """
        data = self.to_dict()
        for group, values in groups.items():
            if group not in data:
                raise SpecError(f"replace: got unknown group {group!r}, expected one of {', '.join(data)}")
            before = data[group]
            if isinstance(values, dict) and isinstance(before, dict):
                same_kind = values.get("kind", before.get("kind")) == before.get("kind")
                values = {**before, **values} if same_kind else values
            data[group] = values
        return self.from_dict(data, "replace")

    def _contradictions(self) -> Iterator[str]:
        """Yield what is wrong about fields that are valid by themselves, but not together."""
        # Each spring stands beside a chamber
        n, springs = self.structure.chambers_per_section, self.structure.springs_per_section
        if springs and (springs < LEAST_CHAMBERS or n % springs):
            yield (
                f"structure.springs_per_section: got {springs}, expected 0 for one beside each chamber, "
                f"or {LEAST_CHAMBERS} or more that divide the {n} chambers"
            )

        # Lists have the right number of entries
        n_sections = self.structure.n_sections
        counts = {"sections": n_sections, "chambers": self.n_chambers, "springs": self.n_springs}
        yield from wrong_counts(self, counts)

        # A negative bond leaves the backbone some stiffness
        backbone = self.backbone.axial_stiffness_n_per_m, self.backbone.bending_stiffness_nm_per_rad
        for stiffness, bonded in zip(map(self.per_section, backbone), self._bonded(), strict=True):
            if not np.all(np.add(stiffness, bonded) > 0.0):
                yield (
                    f"chambers.bonded_share: got {self.chambers.bonded_share!r}, which takes more "
                    "stiffness than the backbone has, expected a share closer to 0"
                )

        # Lower limits are below upper ones
        for group, low, high in (
            ("chambers", "pressure_min_kpa", "pressure_max_kpa"),
            ("springs", "length_min_m", "length_max_m"),
            ("sensor", *self.sensor.range_fields),
        ):
            least, greatest = (getattr(getattr(self, group), name) for name in (low, high))
            if not np.all(np.less(least, greatest)):
                yield f"{group}.{low}: got {least!r}, expected less than {high} ({greatest!r})"

        # Springs have about the length of their sections
        section_m = self.geometry.section_length_m
        for name, low, high in (
            ("rest_length_m", 1.0 / MOST_RATIO, MOST_RATIO),
            ("length_min_m", 0.0, MOST_RATIO),
            ("length_max_m", 1.0 / MOST_RATIO, np.inf),
        ):
            length_m = getattr(self.springs, name)
            ratio = np.divide(self.per_section(length_m), self.per_section(section_m))
            if not np.all((low <= ratio) & (ratio <= high)):
                beside = f"with geometry.section_length_m {section_m!r}"
                yield f"springs.{name}: got {length_m!r} {beside}, expected lengths that go together"

        # The sensor can read every length that may be commanded
        sensor = self.spring_sensor
        (low, high), unit = sensor.range, sensor.unit
        for name in ("length_min_m", "length_max_m"):
            length_m = getattr(self.springs, name)
            readings = sensor.readings(self.at_springs(length_m))
            if not (readable := (readings >= low) & (readings <= high)).all():
                expected = f"sensor.{' to '.join(sensor.range_fields)}, {low:g} to {high:g} {unit}"
                unreadable = f"{readings[~readable][0]:.6g} {unit}"
                yield f"springs.{name}: got {length_m!r}, which reads {unreadable}, expected {expected}"
