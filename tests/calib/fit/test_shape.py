"""The lag of the shape: planted dampings come back from springs and tip of a moving arm."""

import dataclasses

import numpy as np
import pytest

from calib.fit.motion.shape import fit_shape
from mjx_softarm import ArmSpec
from mjx_softarm.deploy.record import record
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import Build

SPEC = ArmSpec.default().replace(structure={"n_sections": 2, "links_per_section": 2})
IDEAL = Build(gap=0.0, losses=0.0, noise=0.0, per_section=2)


def log_of(factor):
    """A log of an arm with the specification's bending damping times a factor."""
    damping = factor * SPEC.backbone.bending_damping_nms_per_rad
    arm = SPEC.replace(backbone={"bending_damping_nms_per_rad": damping})
    return record(Twin(0, arm, build=IDEAL), arm, random_pressures(arm, 4, 0), transients=True).log


@pytest.fixture(scope="module")
def quick():
    return log_of(0.25)


def test_a_planted_damping_comes_back(quick):
    own, planted = fit_shape([log_of(1.0)], SPEC), fit_shape([quick], SPEC)
    assert planted.lag_s == pytest.approx(0.25 * own.lag_s, rel=0.25)
    assert planted.is_better and planted.rms_mm < 0.7 * planted.before_rms_mm
    assert planted.spec.backbone.shape_lag_s == pytest.approx(planted.lag_s)
    assert planted.before_s == SPEC.backbone.shape_lag_s


def test_a_log_without_springs_tip_or_dense_rows_has_no_lag(quick):
    without = [{"tip_m": None}, {"readings": None, "spring_m": None}]
    logs = [dataclasses.replace(quick, **none) for none in without]
    logs.append(quick.take(np.arange(0, len(quick), 25)))
    assert fit_shape(logs, SPEC) is None
    backbone = {"bending_damping_nms_per_rad": 0.0}
    assert fit_shape([quick], SPEC.replace(backbone=backbone)) is None
