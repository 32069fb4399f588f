"""The lag of the shape: planted dampings come back from springs and tip of a moving arm."""

import dataclasses

import numpy as np
import pytest

from calib import steps
from calib.arm import CalibratedArm
from calib.fit.motion import shape
from calib.fit.motion.damping import DampingFit
from calib.fit.motion.shape import fit_shape
from calib.read.measurements import Measurements
from calib.report import sections
from calib.report.page import to_json
from mjx_softarm import ArmSpec
from mjx_softarm.deploy.record import record
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.sensing.load import QUANTILE
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import Build

DAMPING = DampingFit(
    spec=ArmSpec.default(),
    half_width_95={"damping_ns_per_m": 1.0, "bending_damping_nms_per_rad": 0.01},
    in_sample_rms_mm=1.0,
    held_out_rms_mm=1.0,
    held_out_before_rms_mm=2.0,
    n_stretches=1,
    time_s=10.0,
    warnings=(),
)
SPEC = ArmSpec.default().replace(structure={"n_sections": 2, "links_per_section": 2})
ARM = CalibratedArm(SPEC)
DT_S = 1.0 / SPEC.control.rate_hz
IDEAL = Build(gap=0.0, losses=0.0, noise=0.0, per_section=2)


def log_of(factor, n=4):
    """A log of an arm with the specification's bending damping times a factor, at n random pressures."""
    damping = factor * SPEC.backbone.bending_damping_nms_per_rad
    arm = SPEC.replace(backbone={"bending_damping_nms_per_rad": damping})
    return record(Twin(0, arm, build=IDEAL), arm, random_pressures(arm, n, 0)).log


@pytest.fixture(scope="module")
def quick():
    return log_of(0.25)


@pytest.fixture(scope="module")
def long():
    return log_of(0.5, n=16)


def test_a_planted_damping_comes_back(quick):
    own, planted = fit_shape([log_of(1.0)], ARM), fit_shape([quick], ARM)
    assert planted.lag_s == pytest.approx(0.25 * own.lag_s, rel=0.25)
    assert planted.is_known and planted.rms_mm < 0.7 * planted.before_rms_mm
    assert planted.spec.shape_lag_s == pytest.approx(planted.lag_s)
    assert planted.before_s == SPEC.shape_lag_s
    for found, factor in ((own, 1.0), (planted, 0.25)):
        off = np.log(found.lag_s / (factor * SPEC.shape_lag_s))
        assert abs(off) < QUANTILE * found.log_std < 0.7


def test_a_log_without_springs_tip_or_dense_rows_has_no_lag(quick):
    without = [{"tip_m": None}, {"readings": None, "spring_m": None}]
    logs = [dataclasses.replace(quick, **none) for none in without]
    logs.append(quick.take(np.arange(0, len(quick), 25)))
    assert fit_shape(logs, ARM) is None
    backbone = {"bending_damping_nms_per_rad": 0.0}
    assert fit_shape([quick], CalibratedArm(SPEC.replace(backbone=backbone))) is None


@pytest.mark.parametrize("lost_from_s", [0.0, 4.5])
def test_tips_that_were_not_seen_do_not_shorten_the_lag(long, lost_from_s):
    """A quarter of the rows has no tip: 1.5 s in every 6 s."""
    whole = fit_shape([long], ARM)
    lost = (long.time_s % 6.0 >= lost_from_s) & (long.time_s % 6.0 < lost_from_s + 1.5)
    tip_m = np.where(lost[:, None], np.nan, long.tip_m)
    found = fit_shape([dataclasses.replace(long, tip_m=tip_m)], ARM)
    assert found.lag_s == pytest.approx(whole.lag_s, rel=0.15)
    assert found.log_std < 0.15


def test_a_log_is_cut_where_lengths_are_missing(long):
    readings = np.where((long.time_s % 25.0 > 23.5)[:, None], np.nan, long.readings)
    found = fit_shape([dataclasses.replace(long, readings=readings)], ARM)
    parts = [long.take(np.flatnonzero(long.time_s // 25.0 == k)[: round(23.5 / DT_S)]) for k in range(4)]
    assert found.lag_s == pytest.approx(fit_shape(parts, ARM).lag_s, rel=1e-9)


def test_a_lag_beyond_those_tried_is_not_believed(quick, monkeypatch):
    monkeypatch.setattr(shape, "LAGS_S", shape.LAGS_S[shape.LAGS_S > 0.3])
    found = fit_shape([quick], ARM)
    assert found.at_end and not found.is_known and found.log_std == np.inf
    assert found.rms_mm < 0.98 * found.before_rms_mm
    section = sections.damping(DAMPING, found)
    assert "the best lag of the shape, 0.31 s, is an end of those tried" in section.warnings[-1]
    assert to_json([section], [], {})["parts"]["Damping"]["figures"]["shape"]["log_std"] is None


def test_the_backbones_damping_is_the_shapes_own(quick, monkeypatch):
    """The fit to the tip in motion leaves it, and reports the interval of the shape's lag."""
    monkeypatch.setattr(steps, "find_stretches", lambda logs, spec: [None])
    monkeypatch.setattr(
        steps, "fit_damping", lambda _, spec, seed, width: fits.append((spec, width)) or DAMPING
    )
    fits = []
    steps.damping(Measurements((quick,), None, {}), ARM, 0)
    found = fit_shape([quick], ARM)
    [(spec, width)] = fits
    assert spec.shape_lag_s == pytest.approx(found.lag_s)
    assert width == pytest.approx(found.half_width_s / found.lag_s)


def test_errors_at_rest_that_the_network_corrects_do_not_change_the_lag(long, monkeypatch):
    """Tips are up to some 10 mm off, with the square of the lengths, as no line can say."""

    def off_mm(spring_m):
        return 1e5 * (np.asarray(spring_m) - SPEC.geometry.section_length_m)[:, :3] ** 2

    spring_m = SPEC.spring_sensor.lengths(long.readings, np.nan).length_m
    log = dataclasses.replace(long, tip_m=long.tip_m + 1e-3 * off_mm(spring_m))
    monkeypatch.setattr(shape, "correct", lambda _, pose, m: pose + np.pad(off_mm(m), [(0, 0), (0, 3)]))
    corrected = fit_shape([log], CalibratedArm(SPEC, s2r=object()))
    before, uncorrected = fit_shape([long], ARM), fit_shape([log], ARM)
    assert corrected.lag_s == before.lag_s and corrected.rms_mm == pytest.approx(before.rms_mm, rel=1e-3)
    assert uncorrected.rms_mm > 2.0 * before.rms_mm
