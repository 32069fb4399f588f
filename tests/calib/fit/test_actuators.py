"""Actuators from commands with measured pressures, or with springs; planted pumps and regulators."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from calib.arm import CalibratedArm
from calib.fit.held_pressures import fit_held_pressures
from calib.fit.motion.actuators import ArmLag, fit_actuators, with_actuators
from calib.fit.motion.tracks import find_tracks
from calib.fit.s2r import simulate_poses
from calib.read.measurements import measure
from calib.steps import actuators, pressures_by_springs
from mjx_softarm.deploy.record import record
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.workspace import settle_many
from mjx_softarm.pneumatics import Pneumatics, Pump, Regulator
from mjx_softarm.twin.instruments import Build
from mjx_softarm.twin.rod_twin import RodTwin, draw_regulator
from tests.calib.fit.planted import planted, pose_log
from tests.calib.fit.planted import random_pressures as planted_pressures

TIME_S, PERIOD_S, STEPS = 60.0, 0.02, 4
FACTORS = np.linspace(0.9, 1.1, 3)
REGULATOR = Regulator(
    0.3 * FACTORS, 0.15, 60.0, 25.0 * FACTORS[::-1], 0.2, offset_kpa=np.array([0.0, 1.0, -1.0])
)
STILL = 1  # chamber whose command never changes


@pytest.fixture(scope="module")
def short(spec):
    """One section, whose chambers are held at their length."""
    return spec.replace(structure={"n_sections": 1})


def log_of(spec, plant, seed=0):
    """A log of a plant under random steps, in chambers that lengthen and shorten."""
    rng, n = np.random.default_rng(seed), round(TIME_S / PERIOD_S)
    command = np.repeat(rng.uniform(-30.0, 15.0, (n // 100, 3)), 100, axis=0)
    command[:, STILL] = 2.0
    length_m = 0.2 + 0.02 * np.sin(np.arange(n)[:, None] * PERIOD_S + np.arange(3.0))
    chambers = spec.chambers
    bellows = np.full(3, chambers.area_m2), np.full(3, chambers.area_slope_m), 0.2, length_m[0]
    air = Pneumatics(*bellows, PERIOD_S / STEPS, plant.per_chamber(3))
    measured = np.zeros((n, 3))
    for k in range(n - 1):
        air.command(command[k])
        for part in range(STEPS):
            air.step(length_m[k] + (part + 1) / STEPS * (length_m[k + 1] - length_m[k]))
        measured[k + 1] = air.pressure_kpa
    in_force = np.concatenate([np.zeros((1, 3)), command[:-1]])
    radii = spec.geometry.spring_radius_m / spec.geometry.chamber_radius_m
    mean_m = length_m.mean(axis=1, keepdims=True)
    return Log(
        source="planted",
        row=np.arange(n) + 2,
        time_s=PERIOD_S * np.arange(n),
        spring_m=mean_m + radii * (length_m - mean_m),
        pressure_kpa=measured + 0.05 * rng.standard_normal((n, 3)),
        commanded_kpa=in_force,
    )


def test_planted_regulators_are_found(short):
    fit = fit_actuators(find_tracks([log_of(short, REGULATOR)], short), short)
    found = fit.spec.actuators
    assert found.kind == fit.chosen == "regulator" and not fit.warnings + fit.notes
    moved = np.arange(3) != STILL
    for name in ("lag_s", "dead_time_s", "fill_kpa_per_s", "vent_kpa_per_s"):
        true = np.full(3, getattr(REGULATOR, name))
        np.testing.assert_allclose(
            np.array(getattr(found, name))[moved], true[moved], rtol=0.07, err_msg=name
        )
        np.testing.assert_allclose(getattr(found, name)[STILL], true.mean(), rtol=0.15, err_msg=name)
    np.testing.assert_allclose(found.offset_kpa, REGULATOR.offset_kpa, atol=0.25)
    rms = fit.held_out_rms_kpa
    assert rms["regulator"] < 0.3 < 2.0 < min(rms["command"], rms["pump"], rms["specification"])
    law = short.control
    assert fit.spec.control.ki_kpa_per_ms == pytest.approx(law.kp_kpa_per_m / 0.45, rel=0.1)


def test_a_law_without_a_proportional_gain_keeps_its_integral(short):
    arm = short.replace(control={"kp_kpa_per_m": 0.0})
    behind = with_actuators(arm, REGULATOR)
    assert behind.control == arm.control and behind.actuators.kind == "regulator"


def test_a_spring_without_a_reading_counts_as_free(short):
    """A lost reading changes the volumes of that moment alone."""
    log = log_of(short, REGULATOR)
    readings = short.spring_sensor.readings(log.spring_m)
    lost = readings.copy()
    lost[7, 0] = np.nan
    [whole], [track] = (
        find_tracks([dataclasses.replace(log, spring_m=None, readings=x)], short) for x in (readings, lost)
    )
    assert np.isfinite(track.volume_m3).all()
    changed = (track.volume_m3 != whole.volume_m3).any(axis=1)
    assert np.flatnonzero(changed).tolist() == [7]


def test_the_specification_s_pump_stays_where_it_fits(short):
    fit = fit_actuators(find_tracks([log_of(short, short.actuators)], short), short)
    assert fit.chosen == "specification" and fit.spec == short
    assert fit.held_out_rms_kpa["specification"] < 0.5 < fit.held_out_rms_kpa["command"]


def test_a_weaker_pump_is_found(short):
    fit = fit_actuators(find_tracks([log_of(short, Pump(3.0, 0.01))], short), short)
    assert fit.chosen == "pump"
    assert fit.spec.actuators.flow_l_per_min == pytest.approx(3.0, rel=0.05)


def test_regulators_of_a_rod_are_found_in_a_recording_of_all_ticks(spec):
    """Ramps do not show the greatest rates, and the report says so."""
    arm = RodTwin(101, spec, build=Build(per_section=3))
    log = record(arm, spec, random_pressures(spec, 4, 0)).log
    fit = fit_actuators(find_tracks([log], spec), spec)
    true = draw_regulator(101, spec)
    assert fit.chosen == "regulator" and fit.held_out_rms_kpa["regulator"] < 0.3
    for name, tolerance in (("lag_s", 0.12), ("dead_time_s", 0.03)):
        np.testing.assert_allclose(getattr(fit.spec.actuators, name), getattr(true, name), atol=tolerance)
    assert not fit.warnings and "fill_kpa_per_s is known to" in fit.notes[0]
    section = actuators(measure([log], spec), CalibratedArm(spec), 0).section
    assert section.notes == fit.notes and "The regulator is kept" in section.text


def test_a_stiff_regulator_is_distinguished_from_one_that_the_volume_pulls(short):
    """Its lag comes out as planted, where the other model would need 0.4 s."""
    plant = dataclasses.replace(REGULATOR, lag_s=0.8, volume_share=0.0)
    fit = fit_actuators(find_tracks([log_of(short, plant)], short), short)
    found = fit.spec.actuators
    assert found.volume_share < 0.05 and fit.half_width_95["volume_share"][0] < 0.1
    np.testing.assert_allclose(np.delete(found.lag_s, STILL), 0.8, rtol=0.05)
    assert fit.held_out_rms_kpa["regulator"] < 0.2 and not fit.warnings


def test_actuators_of_another_kind_are_said_to_be(short):
    """A second lag, in a row with the first, is no regulator of ours."""
    log = log_of(short, dataclasses.replace(REGULATOR, lag_s=0.8))
    kpa = log.pressure_kpa.copy()
    for k in range(1, len(kpa)):
        kpa[k] = kpa[k - 1] + 0.05 * (log.pressure_kpa[k] - kpa[k - 1])
    fit = fit_actuators(find_tracks([dataclasses.replace(log, pressure_kpa=kpa)], short), short)
    assert "yours are of another kind, and the intervals may not hold" in " ".join(fit.warnings)


def test_springs_show_regulators_whose_pressures_are_not_measured(short):
    """Springs follow the pressures with lags of their own, in stretching and in bending."""
    plant = dataclasses.replace(REGULATOR, lag_s=0.6, volume_share=0.0)
    log = log_of(short, plant)
    slope_kpa_per_m, lags_s = 1e3, (0.25, 0.12)
    kpa = log.pressure_kpa - log.pressure_kpa[0]
    mean = np.repeat(kpa.mean(axis=1, keepdims=True), 3, axis=1)
    parts = [
        lfilter([0.0, -np.expm1(-PERIOD_S / T)], [1.0, -np.exp(-PERIOD_S / T)], part, axis=0)
        for part, T in zip((mean, kpa - mean), lags_s, strict=True)
    ]
    spring_m = 0.2 + (sum(parts) + log.pressure_kpa[0]) / slope_kpa_per_m
    hidden = dataclasses.replace(log, spring_m=spring_m, pressure_kpa=log.commanded_kpa, commanded_kpa=None)
    assert find_tracks([hidden], short) == []
    tracks = find_tracks([hidden], short, lambda spring_m: slope_kpa_per_m * (spring_m - 0.2))
    fit = fit_actuators(tracks, short, arm=ArmLag.of_shape(0.25, 0.1))
    moved = np.arange(3) != STILL
    for name in ("lag_s", "dead_time_s"):
        found, true = np.array(getattr(fit.spec.actuators, name)), np.full(3, getattr(plant, name))
        np.testing.assert_allclose(found[moved], true[moved], rtol=0.15, err_msg=name)
        assert (np.abs(found - true) < fit.half_width_95[name])[moved].all()


def test_springs_of_an_arm_at_rest_show_its_pressures(spec):
    """The arm is unlike its specification; the poses at rest make up for most of that."""
    arm = planted(spec=spec)
    poses = measure([pose_log(arm, 150, 0)], spec).poses.with_lengths(spec)
    simulated_kpa = simulate_poses(spec, poses.spring_m).pressure_kpa
    held = fit_held_pressures(spec, poses.spring_m, poses.pressure_kpa, simulated_kpa).held
    others = settle_many(arm, planted_pressures(60, 1))
    off_kpa = pressures_by_springs(CalibratedArm(spec, held=held), others.spring_m) - others.pressure_kpa
    uncorrected_kpa = simulate_poses(spec, others.spring_m).pressure_kpa - others.pressure_kpa
    rms, before = (np.sqrt(np.mean(x**2)) for x in (off_kpa, uncorrected_kpa))
    assert rms < 0.3 * before and rms < 0.5


def test_a_log_without_commands_or_of_poses_alone_says_so(short):
    log = log_of(short, short.actuators)
    rows = np.arange(0, len(log), 50)
    for unfit in (dataclasses.replace(log, commanded_kpa=None), log.take(rows)):
        arm, section = actuators(measure([unfit], short), CalibratedArm(short), 0)
        assert arm.spec == short and "No log has commands and pressures" in section.text
