"""Arms besides the paper's: four chambers a section, six chambers with three springs, tapered sections."""

from mjx_softarm import ArmSpec

_PAPER = ArmSpec.default()


def _chambers(share):
    """The paper's chambers with a share of its area and stiffness, so that a section moves as the paper's."""
    names = "area_m2", "area_slope_m", "stiffness_n_per_m", "damping_ns_per_m"
    return {name: share * getattr(_PAPER.chambers, name) for name in names}


FOUR_CHAMBERS = _PAPER.replace(
    name="four",
    structure={"chambers_per_section": 4},
    geometry={"chamber_diameter_m": 0.048},
    chambers=_chambers(3 / 4),
)
SIX_CHAMBERS = _PAPER.replace(
    name="six",
    structure={"chambers_per_section": 6, "springs_per_section": 3},
    geometry={"chamber_diameter_m": 0.034},
    chambers=_chambers(3 / 6),
)
TAPERED = _PAPER.replace(
    name="tapered",
    geometry={
        "section_length_m": (0.22, 0.2, 0.17),
        "chamber_radius_m": (0.04, 0.035, 0.03),
        "spring_radius_m": (0.075, 0.067, 0.058),
        "first_chamber_deg": (90.0, 150.0, 80.0),
        "chamber_diameter_m": (0.066, 0.06, 0.051),
    },
    mass={"arm_kg": (1.8, 1.4, 1.05)},
    chambers={
        "area_m2": (0.00196,) * 3 + (0.00162,) * 3 + (0.00117,) * 3,
        "area_slope_m": (-0.0045,) * 3 + (-0.0041,) * 3 + (-0.0034,) * 3,
    },
    backbone={
        "axial_stiffness_n_per_m": (850.0, 850.0, 800.0),
        "bending_stiffness_nm_per_rad": (1.4, 1.1, 0.8),
    },
    springs={
        "rest_length_m": (0.22, 0.2, 0.17),
        "length_min_m": (0.094, 0.085, 0.072),
        "length_max_m": (0.302, 0.275, 0.234),
    },
)
OTHER_ARMS = {"four": FOUR_CHAMBERS, "six": SIX_CHAMBERS, "tapered": TAPERED}
