"""The control loop on a linear arm whose every answer is known: what it does when all is well."""

import dataclasses

import numpy as np
import pytest

from calib.read.logs import read_log
from mjx_softarm.control import Gains
from mjx_softarm.deploy import goals as sources
from mjx_softarm.deploy import link, moving, strategy
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.ending import MISSED, Ending
from mjx_softarm.deploy.goals import on_the_way
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.deploy.session import trace
from mjx_softarm.deploy.strategy import N_CORRECTIONS
from mjx_softarm.logs.schema import write_log
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.mdp.observation import layouts
from mjx_softarm.sensing.estimator import estimate
from mjx_softarm.sensing.pose import pose_error
from tests.linear_arm import (
    CONTROLLER,
    DT_S,
    FAR,
    GOALS,
    NOISE_M,
    POLICY,
    SPEC,
    SPRINGS_M,
    LinearArm,
    asking,
    between,
    exact_plan,
    go,
    read_m,
)


def test_reaches_goals_and_vents():
    arm, lines = LinearArm(), []
    run = go(arm, tell=lines.append)
    assert run.events == () and run.ending == Ending() and run.status == 0
    assert [arrival.goal.tolist() for arrival in run.arrivals] == GOALS.tolist()
    for arrival, spring_m in zip(run.arrivals, SPRINGS_M, strict=True):
        np.testing.assert_allclose(read_m(run.log)[arrival.row], spring_m, atol=5e-4)
        assert np.linalg.norm(arrival.estimate[:3] - arrival.goal[:3]) < 1.0
    np.testing.assert_array_equal(arm.command_kpa, 0.0)
    assert len(run.latency_s) == len(run.log) < len(arm.written)
    assert lines[0].startswith("payload: estimated from the commanded pressures")
    assert len(lines) == 1 + len(GOALS)


def test_acts_at_once_and_then_at_rest():
    arm, asked = LinearArm(), []

    def plan(pose, goal, spring_m, sensed):
        asked.append((arm.tick, np.abs(arm.command_kpa - arm.actual_kpa).max()))
        np.testing.assert_allclose(pose, estimate(POLICY.estimator, spring_m, 0.0), atol=1e-3)
        np.testing.assert_allclose(spring_m, arm.spring_m, atol=5 * NOISE_M)
        assert sensed is None
        return exact_plan(pose, goal, spring_m, sensed)

    go(arm, controller=Controller.of(POLICY, plan))
    assert len(asked) == N_ACTIONS * len(GOALS) and asked[0][0] == 0
    assert max(lag_kpa for _, lag_kpa in asked) < 0.3  # followed, but for what the readings' noise makes
    assert np.diff([tick for tick, _ in asked]).min() >= CONTROLLER.window or len(GOALS) > 1


_WIDE = (np.zeros((len(layouts(SPEC)["motion"]), 9), np.float32), np.zeros(9, np.float32))
OF_MOTION = dataclasses.replace(POLICY, layers=(_WIDE,), observation="motion", action_s=0.3)


def test_a_policy_of_motion_acts_in_time_and_is_told_of_motion():
    arm = LinearArm()
    plan, asked = asking(exact_plan, arm)
    run = go(arm, goals=GOALS[:1], controller=Controller.of(OF_MOTION, plan))
    assert len(run.arrivals) == 1 and not run.events
    assert [tick for *_, tick in asked] == [0, 15, 30] + (1 + N_CORRECTIONS) * [45]
    first, second = asked[0][3], asked[1][3]
    np.testing.assert_array_equal(first[9:21], 0.0)  # no rate of the springs, nor of the tip
    middle = 0.5 * (SPEC.springs.length_min_m + SPEC.springs.length_max_m)
    half = 0.5 * (SPEC.springs.length_max_m - SPEC.springs.length_min_m)
    rows = read_m(run.log)
    np.testing.assert_allclose(middle + half * second[:9], rows[15], atol=1e-6)
    np.testing.assert_allclose(second[9:18] * 0.1 * 0.1, rows[15] - rows[10], atol=1e-6)  # 100 mm/s, 0.1 s
    asked_m = POLICY.actions.lengths(second[-9:])
    np.testing.assert_allclose(asked_m, SPRINGS_M[0], atol=1e-5)


def test_a_goal_half_way_is_half_way_and_angles_take_the_short_way():
    goals = np.array([[0.0, 0, -600, 170, 0, 0], [10.0, 0, -580, -170, 0, 4], [30.0, 0, -580, -170, 0, 4]])
    np.testing.assert_allclose(on_the_way(goals, 0.25), [5.0, 0, -590, 180, 0, 2])
    np.testing.assert_allclose(on_the_way(goals, 0.75), [20.0, 0, -580, -170, 0, 4])
    np.testing.assert_allclose(on_the_way(goals, 1.2), goals[2])


def test_a_way_with_a_goal_out_of_reach_is_not_begun():
    arm = LinearArm()
    run = trace(arm, CONTROLLER, np.array([GOALS[0], FAR, GOALS[1]]), pace_s=5.0)
    assert run.status == MISSED and not run.arrivals and run.counts() == {Fault.GOAL_OUTSIDE: 1}
    np.testing.assert_array_equal(arm.written, 0.0)


def test_stops_on_a_way_are_arrivals_and_other_goals_are_passed():
    there = []
    goals = on_the_way(GOALS[:2], 0.0) + np.linspace(0.0, 1.0, 6)[:, None] * pose_error(GOALS[1], GOALS[0])
    controller = Controller.of(POLICY, between)
    run = trace(LinearArm(), controller, goals, 1.0, stops=np.arange(6) == 3, arrived=there.append)
    assert there == [0, 3, 5] == [arrival.index for arrival in run.arrivals]
    assert run.ending.status == 0 and run.n_goals == 3
    assert run.arrivals[0].reached and run.arrivals[2].reached
    np.testing.assert_allclose([arrival.goal for arrival in run.arrivals], goals[there])
    lasted = [rows.stop - rows.start for rows in run.ways]
    np.testing.assert_allclose(lasted, [150, 100], atol=1)
    np.testing.assert_allclose(run.log.goal[run.ways[1]][50], goals[4], atol=1e-6)
    # The references leave the stop before the goal does
    early = run.log.reference_m[run.ways[0].start - 2] - run.log.reference_m[run.arrivals[0].row]
    assert np.abs(early).max() > 1e-3


@pytest.fixture
def uncorrected(monkeypatch):
    """Goals without corrections: the linear arm's poses are not those of its references."""
    for module in (strategy, moving):
        monkeypatch.setattr(module, "SHIFT_LIMIT", np.zeros(6))


@pytest.mark.parametrize("slower", [1.0, 4.0])
def test_springs_of_a_moving_goal_are_on_time_however_slow_the_law(slower, uncorrected):
    spec = SPEC.replace(control={"ki_kpa_per_ms": SPEC.control.ki_kpa_per_ms / slower})
    policy = dataclasses.replace(POLICY, spec=spec, gains=Gains.from_spec(spec))
    run = trace(LinearArm(noise_m=0.0), Controller.of(policy, between), GOALS[:2], pace_s=10.0)
    rows = np.arange(run.ways[0].start, run.ways[0].stop)[300:480]
    due_m = [between(None, goal, None, None) for goal in run.log.goal[rows]]
    behind_m = np.abs(read_m(run.log)[rows] - due_m)
    asked_m = np.abs(run.log.reference_m[rows] - due_m)
    assert behind_m.max() < 2e-4 < 1e-3 < asked_m.max()


def test_a_policy_of_motion_is_given_a_goal_ahead_by_its_own_lag(uncorrected, monkeypatch):
    arm, goals = LinearArm(), np.array([GOALS[0], GOALS[1]])
    plan, asked = asking(between, arm)
    controller = Controller.of(OF_MOTION, plan)
    lead_s, start_s = moving.lead_of(controller)
    assert 0.2 < lead_s == start_s < 2.0
    monkeypatch.setattr(sources, "lead_of", lambda _: (lead_s, start_s))  # found twice it takes long
    run = trace(arm, controller, goals, pace_s=10.0)
    begun = run.ways[0].start
    waited_s = (begun - run.arrivals[0].row) * DT_S  # so the goal ahead begins at the stop
    assert waited_s == pytest.approx(lead_s, abs=2.5 * DT_S)
    goal, tick = next((goal, tick) for _, goal, *_, tick in asked if tick > begun + 200)
    on_way = [(tick, sensed) for *_, sensed, tick in asked if begun < tick < begun + 200]
    assert np.all(np.diff([tick for tick, _ in on_way]) == 1)  # an action in each tick
    for tick_of, sensed in on_way[::20]:  # the last action is that of 0.3 s ago
        then_m = run.log.reference_m[tick_of - 15]
        np.testing.assert_allclose(POLICY.actions.lengths(sensed[-9:]), then_m, atol=1e-5)
    ahead = on_the_way(goals, ((tick - begun) * DT_S + lead_s) / 10.0)
    np.testing.assert_allclose(goal, ahead, atol=0.003 * np.max(np.abs(goals[1] - goals[0])))  # a tick apart


def test_log_has_pressures_in_force_and_calibration_reads_it(tmp_path):
    arm = LinearArm()
    arm.motion_capture = lambda: Capture(
        tip_m=-arm.spring_m[:3],
        tip_quaternion=np.array([1.0, 0, 0, 0]),
        marker_m=np.ones((2, 3)) * arm.time_s,
    )
    run = go(arm, goals=GOALS[:1])
    np.testing.assert_array_equal(run.log.pressure_kpa[1:], arm.written[: len(run.log) - 1])
    np.testing.assert_allclose(-run.log.tip_m, read_m(run.log)[:, :3], atol=5 * NOISE_M)  # of one instant
    np.testing.assert_allclose(np.diff(run.log.time_s), DT_S, rtol=1e-6)
    write_log(tmp_path / "run.csv", run.log)
    log, _ = read_log(tmp_path / "run.csv")
    assert len(log) > 0.5 * len(run.log)
    np.testing.assert_allclose(log.reference_m[0], SPRINGS_M[0], atol=1e-7)
    np.testing.assert_allclose(log.goal[0], GOALS[0], atol=1e-4)


def test_real_arm_is_waited_for(monkeypatch):
    now = [5.0]
    slept = []
    monkeypatch.setattr(link.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(link.time, "sleep", lambda s: (slept.append(s), now.__setitem__(0, now[0] + s)))

    class Real:
        """Without a clock; each tick takes it 4 ms."""

        read_sensors = staticmethod(LinearArm().read_sensors)

        def write_pressures(self, pressure_kpa):
            now[0] += 0.004

    run = go(Real(), duration_s=1.0)
    assert run.events == ()
    np.testing.assert_allclose(slept, DT_S - 0.004, atol=1e-9)
    np.testing.assert_allclose(np.diff(run.log.time_s), DT_S, atol=1e-9)
