"""Runs that go on without a chamber, on the linear arm."""

import warnings
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from mjx_softarm.deploy import lost
from mjx_softarm.deploy.__main__ import main
from mjx_softarm.deploy.ending import DONE, FAULT
from mjx_softarm.deploy.loop import refusals
from mjx_softarm.deploy.lost import MORE_STEPS, without
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.policy.reach import N_STARTS, N_STEPS, improve, nearest_poses
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

GOES_ON = replace(CONTROLLER, config=replace(CONTROLLER.config, go_on=True))
LOST = np.arange(N) == 3  # the chamber that leaks
OTHERS_KPA = np.where(LOST, 0.0, PRESSURES_KPA)
POSSIBLE = estimate(POLICY.estimator, REST_M + OTHERS_KPA @ GAIN_M_PER_KPA.T, 0.0).astype(float)


def test_a_run_goes_on_without_the_chamber_that_was_lost():
    lines, arm = [], Leaking(150)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = go(arm, goals=[GOALS[0], *POSSIBLE], tell=lines.append, controller=GOES_ON)
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
    run = go(Bursting(150), goals=[GOALS[0], *np.tile(POSSIBLE, (40, 1))], controller=GOES_ON)
    assert run.counts()[Fault.CHAMBER_LOST] == 2 and run.ending.status == FAULT
    assert "chamber5" in run.ending.cause


def test_goals_that_the_other_chambers_do_not_reach_are_refused():
    long = estimate(POLICY.estimator, REST_M + GAIN_M_PER_KPA @ np.full(N, 19.0), 0.0).astype(float)
    assert not refusals(POLICY, [long]) and refusals(without(CONTROLLER, LOST)[0].policy, [long])
    run = go(Leaking(150), goals=[GOALS[0], long, POSSIBLE[0]], controller=GOES_ON)
    assert run.counts()[Fault.GOAL_OUTSIDE] >= 1 and 1 not in {arrival.index for arrival in run.arrivals}
    assert run.arrivals[-1].reached


def found(goal):
    """The controller without the chamber, once a goal was searched for in as many steps as the search has."""
    limited, search = without(CONTROLLER, LOST)
    assert [search.step(goal) for _ in range(N_STEPS)] == [False] * (N_STEPS - 1) + [True]
    assert search.step(goal) and search.refusal() is None
    return limited


@pytest.mark.parametrize("k", range(2))
@pytest.mark.parametrize("shift", [np.zeros(6), np.array([8.0, -6.0, 3.0, 0.0, 0.0, 2.0])])
def test_references_are_those_of_pressures_without_the_chamber(k, shift):
    """As for the goal, so for the goal with a shift, to which the search goes on by a few steps."""
    limited, goal = found(POSSIBLE[k]), POSSIBLE[k] + shift
    spring_m = limited.plan(None, goal, None, None)
    [nearest], _ = nearest_poses(limited.policy, [goal])
    np.testing.assert_allclose(estimate(POLICY.estimator, spring_m, 0.0)[:3], nearest[:3], atol=0.1)
    pressure_kpa = np.linalg.lstsq(GAIN_M_PER_KPA, spring_m - REST_M, rcond=None)[0]
    assert abs(pressure_kpa[3]) < 1e-3 and np.abs(pressure_kpa).max() <= 40.0


def test_a_tick_has_at_most_one_step_of_a_search_besides_those_of_an_action(monkeypatch):
    """A search over all goals at once would block the loop while a chamber has burst."""
    steps, arm = Counter(), Leaking(150)

    def counted(policy, goal, search):
        assert len(goal) == 1 and len(search) in (1, N_STARTS)
        steps[arm.tick, len(search)] += 1
        return improve(policy, goal, search)

    monkeypatch.setattr(lost, "improve", counted)
    run = go(arm, goals=[GOALS[0], *POSSIBLE], controller=GOES_ON)
    assert run.ending.status == DONE and {arrival.index for arrival in run.arrivals} >= {1, 2}
    searched = [n for (_, rows), n in steps.items() if rows == N_STARTS]
    assert len(searched) >= 3 * N_STEPS and max(searched) == 1
    assert max(steps.values()) <= len(CONTROLLER.config.shares) * MORE_STEPS


def test_an_arm_in_time_does_not_go_on(tmp_path, capsys):
    options = "--seconds", "20", "--go-on", "--out", str(tmp_path / "out")
    assert main(["measure", "--arm", "twin:0", *options]) == 2
    assert "--go-on: got --seconds 20, expected stops" in capsys.readouterr().err
