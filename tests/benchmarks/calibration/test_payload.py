"""Payloads of rods: holding a rod at springs, and how payloads are told there."""

import numpy as np
import pytest

from benchmarks.calibration.payload import PAYLOADS_G, hold, targets
from calib.arm import CalibratedArm
from calib.fit.held_pressures import fit_held_pressures
from calib.fit.payload import payload_poses, told_payload
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
    at = payload_poses(CalibratedArm(SPEC), 60)
    left_kpa = 0.1 * np.random.default_rng(0).standard_normal(at.pressure_kpa.shape)
    return at, fit_held_pressures(SPEC, at.spring_m, at.pressure_kpa + left_kpa, at.pressure_kpa).held


def test_a_payload_is_told_within_its_interval(arms):
    at, held = arms
    for payload_kg in (0.0, 1.0):
        rng = np.random.default_rng(1)
        kpa = held_kpa(held, at.spring_m, at.pressure_kpa, payload_kg * at.effect_kpa_per_kg, rng)
        told_kg, half_width_kg = told_payload(CalibratedArm(SPEC, held=held), at.spring_m, kpa)
        assert np.mean(np.abs(told_kg - payload_kg) < half_width_kg) > 0.85
        assert (half_width_kg < 0.4).all() and abs(told_kg.mean() - payload_kg) < 0.05


def test_targets_are_those_of_each_way_to_tell_payloads():
    told = {"told by": "line", "within the interval": 0.9}
    rows = [
        told | {"payload [g]": g, "told [g]": g + off}
        for g, off in zip(PAYLOADS_G, (10, -70, 0), strict=True)
    ]
    verdicts = [row["measured"] for row in targets(rows)]
    assert verdicts == ["90%", "70 g"]
