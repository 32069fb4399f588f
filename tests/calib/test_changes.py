"""Changes since a calibration, planted in poses of simulated arms."""

import json
import re

import numpy as np
import pytest

from calib.arm import CalibratedArm
from calib.changes import fit_changes
from calib.read.measurements import Measurements
from calib.read.static_poses import StaticPoses
from calib.report import sections
from calib.report.page import to_html, to_json
from calib.steps import changes
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.workspace import settle_many

SHIFT_M = 1e-3 * np.array([1.0, 1.0, -1.0, -1.0, 1.0, 0.0, 0.0, -1.0, 0.0])
SOFTER = 0.95


def poses_of(spec, shift_m=0.0, softer=1.0, n=24, payload_kg=0.0, seed=1):
    """Poses of an arm whose springs read too little by a shift, and whose chambers are softer."""
    now = spec.replace(
        chambers={"stiffness_n_per_m": softer * spec.chambers.stiffness_n_per_m},
        mass={"payload_kg": payload_kg},
    )
    found = settle_many(now, pressure_kpa := random_pressures(spec, n, seed))
    kept = np.asarray(found.settled)
    rng, noise = np.random.default_rng(0), 1e-4
    tip_m, rotation = (np.asarray(x, float)[kept] for x in (found.tip_position_m, found.tip_rotation))
    spring_m = np.asarray(found.spring_m, float)[kept] - shift_m
    m = len(spring_m)
    return StaticPoses(
        pressure_kpa=pressure_kpa[kept] + 0.1 * rng.standard_normal((m, spec.n_chambers)),
        payload_kg=np.full(m, payload_kg),
        tip_m=tip_m + noise * rng.standard_normal(tip_m.shape),
        tip_rotation=rotation,
        spring_m=spring_m + 0.3 * noise * rng.standard_normal(spring_m.shape),
        marker_m=np.empty((m, 0, 3)),
        readings=np.full((m, 1, spec.n_springs), np.nan),
        n_rows=np.ones(m, int),
    )


@pytest.fixture(scope="module")
def aged(spec):
    return fit_changes(CalibratedArm(spec), poses_of(spec, SHIFT_M, SOFTER))


def test_shifted_zeros_and_softer_chambers_are_found(aged, spec):
    np.testing.assert_allclose(1e3 * aged.zero_m, 1e3 * SHIFT_M, atol=0.35)
    assert (np.abs(aged.zero_m - SHIFT_M) < aged.zero_half_width_m).all()
    assert aged.stiffness.mean() == pytest.approx(SOFTER - 1.0, abs=0.01)
    assert aged.is_better and aged.after.translation_mean_mm < 0.5 < 5.0 < aged.before.translation_mean_mm
    np.testing.assert_allclose(aged.spec.spring_sensor.delta_m - spec.spring_sensor.delta_m, aged.zero_m)
    mean = np.mean(aged.spec.chambers.stiffness_n_per_m)
    assert mean == pytest.approx(SOFTER * spec.chambers.stiffness_n_per_m, rel=0.01)


def test_the_report_says_what_has_changed(aged):
    section = sections.changes(aged, known_mm=0.3)
    assert not section.warnings and section.title == sections.CHANGES
    said = r"zeros of the springs \+0\.8, \+1\.0, -1\.0, .* mm; stiffness of the chambers -5 \+- [0-9]+ %"
    assert re.match(said, section.notes[0]), section.notes
    [warning] = sections.changes(aged, known_mm=0.01).warnings
    assert "more has changed than zeros and stiffness, so record poses anew" in warning


def test_without_motion_capture_the_pressures_show_softer_chambers(spec):
    poses = poses_of(spec, 0.0, SOFTER)
    unseen = poses._replace(tip_m=np.nan * poses.tip_m, tip_rotation=np.nan * poses.tip_rotation)
    found = fit_changes(CalibratedArm(spec), unseen)
    assert found.is_better and found.before.n == 0
    assert found.stiffness.mean() == pytest.approx(SOFTER - 1.0, abs=0.015)
    section = sections.changes(found, known_mm=0.3)
    assert re.search(r"pressures at held-out poses [0-9.]+ kPa off before, [0-9.]+ now$", section.notes[0])
    report = json.loads(json.dumps(to_json([section], [], {}), allow_nan=False))
    figures = report["parts"][sections.CHANGES]["figures"]
    assert figures["before"]["translation_mean_mm"] is None and figures["is_better"]
    np.testing.assert_array_equal(figures["zero_m"], found.zero_m)
    assert "nan" not in to_html("paper", [section], [], {})


def test_an_arm_that_has_not_changed_keeps_its_calibration(spec):
    measurements = Measurements((), poses_of(spec), {})
    result = changes(measurements, CalibratedArm(spec), 0)
    assert np.abs(result.arm.spec.spring_sensor.delta_m - spec.spring_sensor.delta_m).max() < 1e-4


def test_poses_with_a_payload_do_not_count(spec):
    loaded = Measurements((), poses_of(spec, payload_kg=0.5), {"used": 24})
    result = changes(loaded, CalibratedArm(spec), 0)
    assert result.arm.spec == spec and "measure 8 goals or more" in result.section.warnings[0]
    assert "Got 0 poses at rest" in result.section.text
