"""Payloads of rods: holding a rod at springs, and how payloads are told there."""

import numpy as np
import pytest

from benchmarks.accuracy.payload import PAYLOADS_G, hold, targets
from calib.fit.held_pressures import fit_held_pressures
from calib.fit.payload import fit_payloads, payload_poses, told_payload
from calib.read.static_poses import StaticPoses
from mjx_softarm import ArmSpec
from mjx_softarm.sensing.held_pressures import held_kpa
from mjx_softarm.twin.instruments import Build
from mjx_softarm.twin.rod_twin import RodTwin

SPEC = ArmSpec.default()


def test_a_rod_is_held_at_springs_that_its_pressures_reach():
    arm = RodTwin(101, build=Build(noise=0.0, per_section=3))
    arm.settle(np.array([-12.0, 3, -20, -5, -30, 4, 2, -9, -14]))
    spring_m = SPEC.spring_sensor.lengths(arm.read_sensors()).length_m
    arm.settle(np.zeros(9))
    found_m, _ = hold(arm, SPEC, spring_m)
    np.testing.assert_allclose(found_m, spring_m, atol=2e-4)
    out_m, kpa = hold(arm, SPEC, np.full(9, 0.3))
    assert out_m.max() < 0.29 and (kpa > 19.0).any()


@pytest.fixture(scope="module")
def arms():
    """Springs, pressures without a payload, effects of a kilogram; and a process of small residuals."""
    at = payload_poses(SPEC, 60)
    left_kpa = 0.1 * np.random.default_rng(0).standard_normal(at.pressure_kpa.shape)
    return at, fit_held_pressures(SPEC, at.spring_m, at.pressure_kpa + left_kpa, at.pressure_kpa).held


def test_a_payload_is_told_within_its_interval(arms):
    at, held = arms
    for payload_kg in (0.0, 1.0):
        rng = np.random.default_rng(1)
        kpa = held_kpa(held, at.spring_m, at.pressure_kpa, payload_kg * at.effect_kpa_per_kg, rng)
        told_kg, half_width_kg = told_payload(SPEC, held, at.spring_m, kpa)
        assert np.mean(np.abs(told_kg - payload_kg) < half_width_kg) > 0.85
        assert (half_width_kg < 0.4).all() and abs(told_kg.mean() - payload_kg) < 0.05


def test_poses_with_a_known_payload_tell_a_common_share_of_all_forces(arms):
    """All masses and stiffnesses are a tenth greater, so a payload changes the pressures a tenth less."""
    at, held = arms
    n = len(at.spring_m)
    kpa = at.pressure_kpa + 0.9 * 0.5 * at.effect_kpa_per_kg
    nothing = np.full((n, 3), np.nan)
    rest = (np.full(n, 0.5), nothing, np.zeros((n, 3, 3)), at.spring_m, nothing[:, None], nothing[:, None])
    known = fit_payloads(SPEC, held, StaticPoses(kpa, *rest, np.ones(n, int)))
    assert abs(known.factor.mean() - 0.9) < 0.03
    before, after = (told_payload(SPEC, process, at.spring_m, kpa)[0].mean() for process in (held, known))
    assert abs(after - 0.5) < 0.01 < 0.03 < abs(before - 0.5)
    unloaded = StaticPoses(kpa, np.zeros(n), *rest[1:], np.ones(n, int))
    assert fit_payloads(SPEC, held, unloaded) is held


def test_targets_are_those_of_each_way_to_tell_payloads():
    told = {"told by": "line", "within the interval": 0.9}
    rows = [
        told | {"payload [g]": g, "told [g]": g + off}
        for g, off in zip(PAYLOADS_G, (10, -70, 0), strict=True)
    ]
    verdicts = [row["measured"] for row in targets(rows)]
    assert verdicts == ["90%", "70 g"]
