"""Arms besides the paper's: short, of four and of six chambers a section, tapered and bonded ones."""

from mjx_softarm import ArmSpec

_PAPER = ArmSpec.default()
SHORT = _PAPER.replace(structure={"n_sections": 1, "links_per_section": 2})  # compiles in seconds


def with_arm(state, **changes):
    """The environment's state with parts of its arms exchanged."""
    return state.replace(pipeline_state=state.pipeline_state._replace(**changes))


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
_WIDTHS = 1.1, 1.0, 0.85  # widths of the tapered arm's sections; areas and stiffnesses go with their squares


def _tapered(value, power=2, each=1):
    """A number of the paper's arm times a power of each section's width, for so many parts of each."""
    return tuple(value * width**power for width in _WIDTHS for _ in range(each))


TAPERED = _PAPER.replace(
    name="tapered",
    geometry={
        "section_length_m": (0.22, 0.2, 0.17),
        "chamber_radius_m": _tapered(0.035, 1),
        "spring_radius_m": _tapered(0.067, 1),
        "first_chamber_deg": (90.0, 150.0, 80.0),
        "chamber_diameter_m": _tapered(0.06, 1),
    },
    mass={"arm_kg": (1.7, 1.4, 1.0)},
    chambers={name: _tapered(value, each=3) for name, value in _chambers(1.0).items()}
    | {"bonded_share": 1.0},
    backbone={
        "axial_stiffness_n_per_m": _tapered(_PAPER.backbone.axial_stiffness_n_per_m),
        "bending_stiffness_nm_per_rad": _tapered(_PAPER.backbone.bending_stiffness_nm_per_rad, 4),
    },
    springs={
        "stiffness_n_per_m": _tapered(_PAPER.springs.stiffness_n_per_m),
        "rest_length_m": (0.22, 0.2, 0.17),
        "length_min_m": (0.094, 0.085, 0.072),
        "length_max_m": (0.302, 0.275, 0.234),
    },
)
OTHER_ARMS = {"four": FOUR_CHAMBERS, "six": SIX_CHAMBERS, "tapered": TAPERED}
