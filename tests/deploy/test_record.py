"""Recording on a linear arm: random pressures, poses at rest, whole transients, an early end."""

import numpy as np
import pytest

from calib.read.logs import read_log
from mjx_softarm.deploy.ending import Ending
from mjx_softarm.deploy.link import VENT_KPA_PER_S
from mjx_softarm.deploy.record import record
from mjx_softarm.logs.schema import write_log
from mjx_softarm.mechanics.excitation import random_pressures
from tests.linear_arm import (
    DT_S,
    GAIN_M_PER_KPA,
    HIGH_KPA,
    LOW_KPA,
    REST_M,
    SPEC,
    Blind,
    LinearArm,
    nan,
    read_m,
)


def test_random_pressures_follow_the_arcsine_law():
    kpa = random_pressures(SPEC, 20_000, 0)
    assert kpa.min() >= LOW_KPA and kpa.max() <= HIGH_KPA
    share = (kpa - LOW_KPA) / (HIGH_KPA - LOW_KPA)
    for x in (0.05, 0.3, 0.5, 0.9):
        assert np.mean(share < x) == pytest.approx(2 / np.pi * np.arcsin(np.sqrt(x)), abs=0.01)
    np.testing.assert_array_equal(kpa[:5], random_pressures(SPEC, 20_000, 0)[:5])


def test_recorded_poses_are_at_rest(tmp_path):
    arm, targets_kpa, lines = LinearArm(), random_pressures(SPEC, 5, 3), []
    result = record(arm, SPEC, targets_kpa, tell=lines.append)
    assert lines == ["5 of 5 poses, about 0.0 min left"]
    assert (result.n_poses, result.n_unsettled, result.ending) == (5, 0, Ending())
    np.testing.assert_array_equal(result.log.pressure_kpa, targets_kpa)
    np.testing.assert_allclose(read_m(result.log), REST_M + targets_kpa @ GAIN_M_PER_KPA.T, atol=5e-4)
    np.testing.assert_array_equal(arm.command_kpa, 0.0)
    steps = np.abs(np.diff(np.array(arm.written), axis=0))
    assert steps.max() <= VENT_KPA_PER_S * DT_S + 1e-9
    write_log(tmp_path / "log.npz", result.log)
    log, _ = read_log(tmp_path / "log.npz")
    np.testing.assert_allclose(log.pressure_kpa, targets_kpa)


def test_recorded_transients_are_whole():
    arm = LinearArm()
    result = record(arm, SPEC, random_pressures(SPEC, 2, 3), transients=True)
    np.testing.assert_array_equal(result.log.pressure_kpa[1:], arm.written[: len(result.log) - 1])


def test_recording_stops_and_vents_when_readings_are_lost():
    arm = Blind(range(150, 10**6), nan)
    result = record(arm, SPEC, random_pressures(SPEC, 50, 3))
    assert (
        "readings lost in 3 ticks in a row: spring4: read nan Hz" in result.ending.cause
        and result.ending.status == 3
    )
    assert 0 < result.n_poses == len(result.log) < 50
    np.testing.assert_array_equal(arm.command_kpa, 0.0)
