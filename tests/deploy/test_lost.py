"""Runs that go on without a chamber, on the linear arm."""

import warnings

import numpy as np
import pytest

from mjx_softarm.deploy.ending import DONE, FAULT
from mjx_softarm.deploy.loop import refusals
from mjx_softarm.deploy.lost import without
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.policy.reach import nearest_springs
from mjx_softarm.sensing.estimator import estimate
from tests.linear_arm import (
    CONTROLLER,
    GAIN_M_PER_KPA,
    GOALS,
    POLICY,
    PRESSURES_KPA,
    REST_M,
    Leaking,
    N,
    go,
)

LOST = np.arange(N) == 3  # the chamber that leaks
OTHERS_KPA = np.where(LOST, 0.0, PRESSURES_KPA)
POSSIBLE = estimate(POLICY.estimator, REST_M + OTHERS_KPA @ GAIN_M_PER_KPA.T, 0.0).astype(float)


def test_a_run_goes_on_without_the_chamber_that_was_lost():
    lines, arm = [], Leaking(150)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = go(arm, goals=[GOALS[0], *POSSIBLE], tell=lines.append, go_on=True)
    assert run.counts()[Fault.CHAMBER_LOST] == 1
    [line] = [line for line in lines if "go on without" in line]
    assert line.endswith("lie as they would without that -> go on without chamber3")
    reached = [arrival.index for arrival in run.arrivals if arrival.reached]
    assert {1, 2} <= {*reached} and run.ending.status == DONE
    last_kpa = np.array(arm.written)[run.arrivals[-1].row - 50 : run.arrivals[-1].row]
    assert not last_kpa[:, LOST].any() and np.abs(last_kpa[:, ~LOST]).max() > 5.0


def test_without_leave_the_arm_is_vented():
    run = go(Leaking(150), goals=[GOALS[0], *POSSIBLE])
    assert run.ending.status == FAULT and run.counts()[Fault.CHAMBER_LOST] == 1


class Bursting(Leaking):
    """Another chamber follows."""

    def holds(self, pressure_kpa):
        leaks = (np.arange(N) == 5) & (self.tick >= 1_000)
        return np.where(leaks, 0.0, super().holds(pressure_kpa))


def test_a_second_chamber_ends_the_run():
    run = go(Bursting(150), goals=[GOALS[0], *np.tile(POSSIBLE, (40, 1))], go_on=True)
    assert run.counts()[Fault.CHAMBER_LOST] == 2 and run.ending.status == FAULT
    assert "chamber5" in run.ending.cause


def test_goals_that_the_other_chambers_do_not_reach_are_refused():
    long = estimate(POLICY.estimator, REST_M + GAIN_M_PER_KPA @ np.full(N, 19.0), 0.0).astype(float)
    assert not refusals(POLICY, [long]) and refusals(without(CONTROLLER, LOST).policy, [long])
    run = go(Leaking(150), goals=[GOALS[0], long, POSSIBLE[0]], go_on=True)
    assert run.counts()[Fault.GOAL_OUTSIDE] >= 1 and 1 not in {arrival.index for arrival in run.arrivals}
    assert run.arrivals[-1].reached


@pytest.mark.parametrize("k", range(2))
def test_references_are_those_of_pressures_without_the_chamber(k):
    limited = without(CONTROLLER, LOST)
    spring_m = nearest_springs(limited.policy, POSSIBLE[k])
    np.testing.assert_allclose(estimate(POLICY.estimator, spring_m, 0.0)[:3], POSSIBLE[k][:3], atol=0.5)
    pressure_kpa = np.linalg.lstsq(GAIN_M_PER_KPA, spring_m - REST_M, rcond=None)[0]
    assert abs(pressure_kpa[3]) < 1e-3 and np.abs(pressure_kpa).max() <= 40.0
