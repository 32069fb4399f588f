"""Planted damping comes back from the motion of a tip; stretches of logs are what they are said to be."""

import dataclasses

import numpy as np
import pytest

from calib.fit.motion.damping import MAX_TOTAL_S, Stretch, damped, find_stretches, fit_damping, simulate
from mjx_softarm import ArmSpec
from mjx_softarm.logs.schema import Log

SPEC = ArmSpec.default().replace(structure={"n_sections": 1, "links_per_section": 2})  # it steps fast
RATE_HZ = SPEC.control.rate_hz
FACTORS = (1.5, 0.7)  # of chambers and backbone


def steps(n, seed=0, hold_s=1.0):
    targets = np.random.default_rng(seed).uniform(-35.0, 18.0, (n, 3))
    return np.repeat(targets, round(hold_s * RATE_HZ), axis=0)


def moving_log(arm, pressure_kpa, noise=1.0, **changes):
    rng, n = np.random.default_rng(1), len(pressure_kpa)
    tip_m = simulate(Stretch(pressure_kpa, np.zeros((n, 3)), 0.0), arm)
    log = Log(
        source="steps.csv",
        row=np.arange(n) + 2,
        time_s=np.arange(n) / RATE_HZ,
        pressure_kpa=pressure_kpa + noise * rng.normal(scale=0.1, size=pressure_kpa.shape),
        tip_m=tip_m + noise * rng.normal(scale=5e-4, size=tip_m.shape),
    )
    return dataclasses.replace(log, **changes)


@pytest.fixture(scope="module")
def log():
    return moving_log(damped(SPEC, np.log(FACTORS)), steps(15))


@pytest.fixture(scope="module")
def fitted(log):
    return fit_damping(find_stretches([log], SPEC), SPEC)


def test_planted_damping_comes_back(fitted):
    chambers, backbone = fitted.spec.chambers, fitted.spec.backbone
    assert chambers.damping_ns_per_m == pytest.approx(FACTORS[0] * SPEC.chambers.damping_ns_per_m, rel=0.05)
    bending = FACTORS[1] * SPEC.backbone.bending_damping_nms_per_rad
    assert backbone.bending_damping_nms_per_rad == pytest.approx(bending, rel=0.05)
    for part, name in ((chambers, "damping_ns_per_m"), (backbone, "bending_damping_nms_per_rad")):
        assert 0 < fitted.half_width_95[name] < 0.1 * getattr(part, name)


def test_what_is_left_is_noise(fitted):
    assert fitted.held_out_rms_mm == pytest.approx(0.5 * np.sqrt(3), rel=0.25)
    assert fitted.held_out_rms_mm < 0.7 * fitted.held_out_before_rms_mm
    assert fitted.warnings == ()
    assert fitted.n_stretches == 1
    assert fitted.time_s == pytest.approx(15.0, abs=0.1)


def test_a_known_bending_damping_stays_and_keeps_its_interval(log):
    """Only the chambers' damping is fitted; the backbone's is the planted one."""
    spec = damped(SPEC, np.log([1.0, FACTORS[1]]))
    found = fit_damping(find_stretches([log], SPEC), spec, bending_half_width=0.1)
    bending = spec.backbone.bending_damping_nms_per_rad
    assert found.spec.backbone.bending_damping_nms_per_rad == bending
    assert found.half_width_95["bending_damping_nms_per_rad"] == pytest.approx(0.1 * bending)
    planted = FACTORS[0] * SPEC.chambers.damping_ns_per_m
    assert found.spec.chambers.damping_ns_per_m == pytest.approx(planted, rel=0.05)


def test_small_steps_are_said_not_to_tell_the_damping(log):
    calm = moving_log(SPEC, steps(12) * 0.02 - 10.0)
    assert fit_damping(find_stretches([calm], SPEC), SPEC).warnings


def test_a_slower_log_is_brought_to_the_control_rate_with_pressures_held(log):
    slow = log.take(np.arange(0, len(log), 2))
    (found,) = find_stretches([slow], SPEC)
    assert len(found.tip_m) == len(log) - 2
    np.testing.assert_array_equal(found.pressure_kpa, np.repeat(slow.pressure_kpa[:-1], 2, axis=0))
    np.testing.assert_allclose(found.tip_m[1::2], 0.5 * (slow.tip_m[1:] + slow.tip_m[:-1]), atol=1e-9)


def test_commands_drive_the_arm_through_its_actuators(log):
    """Logged pressures without noise are commands, which a pump of 12 L/min follows later."""
    commands = moving_log(SPEC, steps(15), noise=0.0)
    (found,) = find_stretches([commands], SPEC)
    late_kpa = np.abs(found.pressure_kpa - commands.pressure_kpa[: len(found.pressure_kpa)]).max(axis=1)
    within = np.arange(len(late_kpa)) % round(RATE_HZ)  # ticks since the step
    assert late_kpa[50:][within[50:] < 2].min() > 3.0
    assert late_kpa[50:][within[50:] > 48].mean() < 0.2 * late_kpa[50:][within[50:] < 2].mean()


def test_stretches_end_at_gaps_where_the_payload_changes_and_at_the_longest_time(log):
    time_s = log.time_s + np.where(log.time_s >= 7.5, 3.0, 0.0)
    assert len(find_stretches([dataclasses.replace(log, time_s=time_s)], SPEC)) == 2
    payload = np.where(log.time_s >= 7.5, 0.2, 0.1)
    loads = [s.payload_kg for s in find_stretches([dataclasses.replace(log, payload_kg=payload)], SPEC)]
    assert loads == [0.1, 0.2]
    assert sum(len(s.tip_m) for s in find_stretches([log] * 5, SPEC)) <= MAX_TOTAL_S * RATE_HZ


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"tip_m": None}, "no tip"),
        ({"pressure_kpa": None}, "no pressures"),
        ({"pressure_kpa": np.zeros((750, 3))}, "nothing changes"),
        ({"time_s": np.arange(750) * 0.2}, "too slow"),
    ],
)
def test_logs_without_motion_are_passed_by_and_no_damping_is_refused(log, changes, why):
    changed = dataclasses.replace(log, **changes)
    assert find_stretches([changed], SPEC) == [], why
    with pytest.raises(ValueError, match="damping_ns_per_m 0.0 and .* expected both above 0"):
        fit_damping([], SPEC.replace(chambers={"damping_ns_per_m": 0.0}))
