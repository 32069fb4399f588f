"""Changes of the parameters in millimetres of the tip: by hand, and beside arms that have them."""

import numpy as np
import pytest

from calib.fit.chambers import tip_changes
from calib.fit.parameters import names, spec_at
from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.workspace import settle_many

SPEC = ArmSpec.default().replace(structure={"n_sections": 1, "links_per_section": 2})
NAMES = names(SPEC)


def change(**values):
    """A change of x by names, whose spaces are underscores."""
    x = np.zeros(len(NAMES))
    for name, value in values.items():
        x[NAMES.index(name.replace("_", " "))] = value
    return x


def test_a_shifted_base_shifts_the_tip_as_far_and_a_marker_s_site_does_nothing():
    both = np.stack([change(base_offset_x=2e-3), change(marker_x0=0.02)], axis=1)
    np.testing.assert_allclose(tip_changes(SPEC, np.zeros(len(NAMES)), both), [2e-3, 0.0], atol=1e-6)
    assert tip_changes(SPEC, np.zeros(len(NAMES)), both[:, :0]).shape == (0,)


@pytest.mark.parametrize("what", [{"stiffness0": 0.02}, {"offset1": 5e-3, "offset2": -5e-3}])
def test_chambers_that_are_off_move_the_tip_as_those_of_such_an_arm(what):
    x, far = change(area0=0.1), change(**what)
    pressure_kpa, moved_m = random_pressures(SPEC, 1000, 5), []
    for payload_kg in (0.0, SPEC.mass.largest_payload_kg):
        arms = [spec_at(SPEC.replace(mass={"payload_kg": payload_kg}), at) for at in (x - far, x + far)]
        low, high = (settle_many(arm, pressure_kpa) for arm in arms)
        away_m = 0.5 * np.linalg.norm(high.tip_position_m - low.tip_position_m, axis=1)
        moved_m.append(away_m[low.settled & high.settled])
    expected = np.max(np.concatenate(moved_m))
    assert tip_changes(SPEC, x, far[:, None])[0] == pytest.approx(expected, rel=0.1)


ALTERNATING = [(4, "length_offset_m", 2, 3), (6, "stiffness_n_per_m", 3, 8)]


@pytest.mark.parametrize(("n_chambers", "field", "order", "n_more"), ALTERNATING)
def test_patterns_that_are_no_parameters_move_nothing(n_chambers, field, order, n_more):
    """Alternating rest lengths of four chambers, stiffnesses of six; a pattern of lower order does much."""
    structure = {"n_sections": 1, "links_per_section": 2, "chambers_per_section": n_chambers}
    spec = ArmSpec.default().replace(structure=structure)
    size = 5e-3 if field == "length_offset_m" else 0.1 * spec.chambers.stiffness_n_per_m
    pressure_kpa, tip_m = 0.5 * random_pressures(spec, 40, 0), []
    for k in (0, order, order - 1):
        off = (k > 0) * size * np.cos(2 * np.pi * k * np.arange(n_chambers) / n_chambers)
        value = tuple((getattr(spec.chambers, field) + off).tolist())
        tip_m.append(settle_many(spec.replace(chambers={field: value}), pressure_kpa).tip_position_m)
    moved, more = (1e3 * np.linalg.norm(x - tip_m[0], axis=1).max() for x in tip_m[1:])
    assert moved < 0.1 < 0.5 < more
    assert len(names(spec)) == len(NAMES) + n_more
