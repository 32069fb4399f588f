"""The control loop with readings that are lost, late, stuck or wrong."""

import numpy as np
import pytest

from mjx_softarm.deploy.controller import LOOP
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.sensing.estimator import estimate
from tests.linear_arm import POLICY, Blind, LinearArm, N, go, nan, read_m


def late(readings):
    raise TimeoutError


@pytest.mark.parametrize("spoil", [nan, late])
def test_one_lost_reading_holds_the_last_good_one(spoil):
    run = go(Blind({30, 40}, spoil))
    assert run.counts() == {Fault.LOST_READING: 2} and len(run.arrivals) == 2
    before_m, now_m, after_m = read_m(run.log)[29:32]
    held_m = np.where(np.isnan(now_m), before_m, now_m)
    assert held_m[4] == before_m[4] != after_m[4]
    np.testing.assert_allclose(run.log.estimate[30], estimate(POLICY.estimator, held_m, 0.0), atol=1e-3)
    assert np.isnan(run.log.readings[30, 4])
    assert ("spring4: got nan Hz" in run.events[0].message) == (spoil is nan)


@pytest.mark.parametrize("spoil", [nan, late])
def test_several_lost_readings_vent(spoil):
    arm = Blind(range(30, 100), spoil)
    run = go(arm)
    assert run.status == 3 and run.arrivals == () and "sensor lost" in run.ending.cause
    assert run.counts() == {Fault.LOST_READING: LOOP.lost_ticks, Fault.SENSOR_LOST: 1}
    assert "spring4" in run.events[-1].message
    assert len(run.log) == 30 + LOOP.lost_ticks
    assert np.abs(arm.written[29]).max() > 1.0
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


def test_no_reading_at_all_moves_nothing():
    arm = Blind(range(100), nan)
    assert go(arm).status == 3
    np.testing.assert_array_equal(arm.written, 0.0)


def test_stuck_sensor_vents():
    arm = LinearArm()
    stuck_hz = arm.read_sensors()[7]
    blind = Blind(range(20, 10**6), lambda f_hz: np.where(np.arange(N) == 7, stuck_hz, f_hz))
    run = go(blind)
    assert run.status == 3 and run.counts()[Fault.SENSOR_STUCK] == 1
    np.testing.assert_array_equal(blind.command_kpa, 0.0)
    assert "spring7: moved less than 0.01 mm" in run.events[-1].message


def test_noiseless_arm_at_rest_is_not_stuck():
    run = go(LinearArm(noise_m=0.0))
    assert run.events == () and len(run.arrivals) == 2
