"""The arm's specification: every physical number once, with its unit, read from TOML.

An `ArmSpec` is a tree of frozen dataclasses. The numbers live in a TOML file (the packaged
`arms/paper.toml` is the arm of the paper and says where each number comes from); this module
says which fields exist, what they mean and which values are allowed.
"""

from __future__ import annotations

import dataclasses
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from mjx_softarm._support.fields import (
    PerChamber,
    SpecError,
    anything,
    check_counts,
    count,
    not_negative,
    numbers,
    positive,
    read_fields,
    vector,
)
from mjx_softarm.arms import shipped_arm
from mjx_softarm.sensing.sensors import N_CHAMBERS_PER_SECTION, SENSORS, Sensor

ARM_FILE = "arm.toml"  # in the folder of a calibration
PAIRS = "pairs of chamber and spring"
PAPER_S_ARM_KG = 4.7  # which carries up to 1 kg


@dataclass(frozen=True)
class Structure:
    """Counts of sections and links. They fix array shapes, so a new value compiles anew."""

    n_sections: int = count()
    links_per_section: int = count()


@dataclass(frozen=True)
class Geometry:
    """Lengths of the unloaded arm at rest."""

    section_length_m: float = positive()
    chamber_radius_m: float = positive()
    spring_radius_m: float = positive()
    first_chamber_deg: float = anything(low=-360.0, high=360.0)
    chamber_diameter_m: float = positive()


@dataclass(frozen=True)
class Mass:
    """Masses. The arm's own mass is spread evenly over its links."""

    arm_kg: float = positive()
    gripper_kg: float = not_negative()
    gripper_length_m: float = positive()
    payload_kg: float = not_negative()

    @property
    def largest_payload_kg(self) -> float:
        """Payload on top of `payload_kg` to reckon with: 1 kg of the paper's arm, others in proportion."""
        return (self.arm_kg + self.gripper_kg) / PAPER_S_ARM_KG


@dataclass(frozen=True)
class Chambers:
    """Bellows: force = pressure * (area_m2 + area_slope_m * (length - section length))."""

    area_m2: PerChamber = positive(per="chambers")
    area_slope_m: PerChamber = anything(per="chambers")
    stiffness_n_per_m: PerChamber = positive(per="chambers")
    damping_ns_per_m: float = not_negative()
    length_offset_m: PerChamber = anything(per="chambers", low=-0.1, high=0.1)
    pressure_min_kpa: float = anything(low=-101.325)
    pressure_max_kpa: float = anything(low=-101.325)


@dataclass(frozen=True)
class Backbone:
    """Stiffness and damping of one whole section besides its chambers and springs."""

    axial_stiffness_n_per_m: float = positive()
    bending_stiffness_nm_per_rad: float = positive()
    axial_damping_ns_per_m: float = not_negative()
    bending_damping_nms_per_rad: float = not_negative()


@dataclass(frozen=True)
class Springs:
    """Springs whose lengths are sensed, and the range of lengths that may be commanded."""

    stiffness_n_per_m: float = not_negative()
    damping_ns_per_m: float = not_negative()
    rest_length_m: float = positive()
    length_min_m: float = positive()
    length_max_m: float = positive()


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
    """How the arm hangs in the frame of motion capture, and how that frame's tip sits on the arm.

    Turns are rotation vectors. All are zero in an arm that is built and measured perfectly, and where a file
    has no such table.
    """

    base_turn_deg: tuple[float, ...] = vector()  # of the base, in the base frame
    base_offset_m: tuple[float, ...] = vector()  # of the base, in the base frame
    section_roll_deg: tuple[float, ...] = numbers("sections")  # of its holes about its axis
    tip_turn_deg: tuple[float, ...] = vector()  # of the measured tip's axes, in those of the last plate
    tip_offset_m: tuple[float, ...] = vector()  # of the measured tip, in the axes of the last plate


@dataclass(frozen=True)
class Unmodelled:
    """Pressures that hold the unloaded arm, measured less simulated: what the model of the chambers leaves.

    Linear in the springs' lengths; nothing where a file has no such table. The simulation goes without, but a
    payload is estimated from pressures, with this taken into account.
    """

    pressure_kpa: tuple[float, ...] = numbers("chambers")  # where springs have their sections' length
    slope_kpa_per_m: tuple[float, ...] = numbers(PAIRS)  # a row for each chamber, a column for each spring


@dataclass(frozen=True)
class ArmSpec:
    """A pneumatic soft arm: sections in series, three chambers and three springs in each.

    Build one with `ArmSpec.default()`, `ArmSpec.from_toml(path)` or `spec.replace(...)`; each of
    them validates. A field marked per chamber holds one number or a tuple of `n_chambers`.
    """

    name: str
    structure: Structure
    geometry: Geometry
    mass: Mass
    chambers: Chambers
    backbone: Backbone
    springs: Springs
    sensor: Sensor = field(metadata={"kinds": SENSORS})  # without `kind` in a file: the first
    control: Control
    mounting: Mounting = Mounting()
    unmodelled: Unmodelled = Unmodelled()

    @property
    def length_m(self) -> float:
        """Length of the unloaded arm at rest."""
        return self.structure.n_sections * self.geometry.section_length_m

    @property
    def n_chambers(self) -> int:
        return N_CHAMBERS_PER_SECTION * self.structure.n_sections

    @property
    def n_links(self) -> int:
        return self.structure.n_sections * self.structure.links_per_section

    @property
    def link_length_m(self) -> float:
        return self.geometry.section_length_m / self.structure.links_per_section

    @property
    def spring_sensor(self) -> Sensor:
        """The sensor with one calibration per spring."""
        return self.sensor.per_spring(self.n_chambers)

    def per_chamber(self, value: PerChamber) -> tuple[float, ...]:
        """Return one number per chamber, however the field was written."""
        return tuple(value) if isinstance(value, tuple) else (float(value),) * self.n_chambers

    @property
    def section_roll_deg(self) -> tuple[float, ...]:
        """One number per section."""
        return self.mounting.section_roll_deg or (0.0,) * self.structure.n_sections

    def unmodelled_kpa(self, spring_m: np.ndarray) -> np.ndarray:
        """Return measured less simulated pressures (..., n) [kPa] at springs (..., n) [m], unloaded."""
        n, table = self.n_chambers, self.unmodelled
        slope = np.reshape(table.slope_kpa_per_m or np.zeros(n * n), (n, n))
        stretched_m = spring_m - self.geometry.section_length_m
        return np.asarray(table.pressure_kpa or np.zeros(n)) + stretched_m @ slope.T

    @classmethod
    def default(cls) -> ArmSpec:
        """Return the paper's arm."""
        return cls.from_dict(tomllib.loads(shipped_arm("paper")), "arms/paper.toml")

    @classmethod
    def of(cls, path: Path | None) -> ArmSpec:
        """Return the arm of a file or of the package's name for it, or the paper's arm where none is given.

        Raises:
            SpecError: there is no such arm, or as `from_toml` does.
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
        spec = cls(**read_fields(cls, data, source, ""))
        spec._check_together(source)
        return spec

    def to_dict(self) -> dict[str, Any]:
        """Return nested dictionaries, as a TOML file has them."""
        data = dataclasses.asdict(self)
        data["sensor"] = {"kind": self.sensor.kind, **data["sensor"]}
        return data

    def to_toml(self, path: str | Path) -> None:
        """Write the specification; `from_toml` of it gives an equal one."""
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

    def _check_together(self, source: str) -> None:
        """Refuse fields that contradict each other."""
        counts = {
            "sections": self.structure.n_sections,
            "chambers": self.n_chambers,
            PAIRS: self.n_chambers**2,
        }
        check_counts(self, counts, source, "")
        for group, low, high in (
            ("chambers", "pressure_min_kpa", "pressure_max_kpa"),
            ("springs", "length_min_m", "length_max_m"),
            ("sensor", *self.sensor.range_fields),
        ):
            least, greatest = (getattr(getattr(self, group), name) for name in (low, high))
            if not least < greatest:
                raise SpecError(
                    f"{source}: {group}.{low}: got {least!r}, expected less than {high} ({greatest!r})"
                )
        # Lengths that may be commanded must be lengths that the sensor can read.
        sensor = self.spring_sensor
        (low, high), unit = sensor.range, sensor.unit
        for name in ("length_min_m", "length_max_m"):
            length_m = getattr(self.springs, name)
            readings = sensor.readings(np.full(self.n_chambers, length_m))
            if not (readable := (readings >= low) & (readings <= high)).all():
                raise SpecError(
                    f"{source}: springs.{name}: got {length_m!r}, which reads {readings[~readable][0]:.6g} "
                    f"{unit}, expected sensor.{' to '.join(sensor.range_fields)}, {low:g} to {high:g} {unit}"
                )
