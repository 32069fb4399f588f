"""Tables of a specification: their fields, with units and allowed values."""

from __future__ import annotations

from dataclasses import dataclass

from mjx_softarm._support.fields import (
    PerChamber,
    PerSection,
    anything,
    count,
    not_negative,
    numbers,
    positive,
    share,
    vector,
)
from mjx_softarm._support.xp import Array

PAIRS = "pairs of chamber and spring"
LEAST_CHAMBERS, MOST_CHAMBERS = 3, 12  # of a section
BONDS = -0.3, 0.95  # a bonded share of 1 would leave no chamber that pulls between the ends of its section
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
    chambers_per_section: int = count(3, LEAST_CHAMBERS, MOST_CHAMBERS, "fewer bend a section in one plane")
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
    bonded to every ring resists the bend of each link, too: `bonded_share` of its stiffness does, of its
    damping nothing. A negative share makes links softer, as more of them would be.
    """

    area_m2: PerChamber = positive(per="chambers", **AREA)
    area_slope_m: PerChamber = anything(per="chambers")
    stiffness_n_per_m: PerChamber = positive(per="chambers")
    damping_ns_per_m: PerChamber = not_negative(per="chambers")
    length_offset_m: PerChamber = anything(per="chambers", low=-0.1, high=0.1)
    pressure_min_kpa: float = anything(low=-101.325, **PRESSURE)
    pressure_max_kpa: float = anything(low=-101.325, **PRESSURE)
    bonded_share: float = share(*BONDS)


def bonded_stiffness(share: Array, stiffness: Array, square_m2: Array) -> tuple[Array, Array, Array]:
    """Return what the bonded chambers of each section are worth (n_sections,).

    Each chamber of a section gives its links the same stiffness, a share of that of the least stiff one.

    Args:
        share: bonded share.
        stiffness (n_sections, c) [N/m]: stiffnesses of the chambers.
        square_m2 (n_sections,) [m^2]: mean square of their distances from the section's axis.

    Returns:
        Stiffness [N/m] that each chamber gives; axial [N/m] and bending stiffness [N m/rad] of a section.
    """
    given = share * stiffness.min(axis=1)
    axial = stiffness.shape[1] * given
    return given, axial, axial * square_m2 / 2


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
    section_roll_deg: tuple[float, ...] = numbers("sections")  # roll of each section's holes about its axis
    tip_turn_deg: tuple[float, ...] = vector()  # turn of the measured tip, in the axes of the last plate
    tip_offset_m: tuple[float, ...] = vector()  # offset of the measured tip, in the axes of the last plate


@dataclass(frozen=True)
class Unmodelled:
    """Residual pressures that hold the unloaded arm: measured minus simulated, linear in spring lengths.

    The simulation ignores them; the estimate of a payload from pressures subtracts them.
    """

    pressure_kpa: tuple[float, ...] = numbers("chambers")  # where springs have their sections' length
    slope_kpa_per_m: tuple[float, ...] = numbers(PAIRS)  # a row for each chamber, a column for each spring
