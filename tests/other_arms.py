"""Changes of the paper's arm to arms of other structures, for `ArmSpec.replace`."""

_TAPERED = {
    "geometry": {
        "section_length_m": (0.24, 0.20, 0.16),
        "chamber_radius_m": (0.040, 0.035, 0.028),
        "spring_radius_m": (0.075, 0.067, 0.055),
        "first_chamber_deg": (90.0, 30.0, 75.0),
        "chamber_diameter_m": (0.068, 0.060, 0.048),
    },
    "mass": {"arm_kg": (2.0, 1.4, 0.85)},
    "backbone": {
        "axial_stiffness_n_per_m": (1000.0, 850.0, 700.0),
        "bending_stiffness_nm_per_rad": (1.5, 1.1, 0.8),
        "axial_damping_ns_per_m": (25.0, 20.0, 15.0),
        "bending_damping_nms_per_rad": (1.2, 1.0, 0.8),
    },
    "springs": {"stiffness_n_per_m": (60.0, 54.0, 45.0), "rest_length_m": (0.24, 0.20, 0.16)},
}


def tapered(n_sections=3):
    """Sections that differ in all that may differ, the upper ones of three."""
    groups = {group: {k: x[:n_sections] for k, x in fields.items()} for group, fields in _TAPERED.items()}
    return {"structure": {"n_sections": n_sections}, **groups}


# The chambers of a section have together the area and the stiffness of the paper's three
FOUR = {
    "structure": {"chambers_per_section": 4},
    "chambers": {"area_m2": 1.215e-3, "area_slope_m": -3.045e-3, "stiffness_n_per_m": 380.0},
}
SIX = {
    "structure": {"chambers_per_section": 6, "springs_per_section": 3},
    "chambers": {"area_m2": 0.81e-3, "area_slope_m": -2.03e-3, "stiffness_n_per_m": 253.0},
}
