"""The control loop with faults of readings, chambers, goals and time injected, and its response to each."""

import dataclasses
import functools

import numpy as np
import pytest

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.link import LATE_TICKS, LOST_TICKS, VENT_KPA_PER_S
from mjx_softarm.deploy.safety import MOVING_WINDOWS, Fault
from mjx_softarm.deploy.session import follow, trace
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.policy.lag import SETTLE_TIMEOUT_S
from mjx_softarm.sensing.estimator import estimate
from mjx_softarm.sensing.s2r import N_POSE_INPUTS, N_POSE_OUTPUTS, correct, extrapolation
from tests.linear_arm import (
    CONTROLLER,
    DT_S,
    FAR,
    GOALS,
    HIGH_KPA,
    POLICY,
    PRESSURES_KPA,
    Blind,
    Leaking,
    LinearArm,
    N,
    between,
    exact_plan,
    go,
    nan,
    read_m,
)
from tests.networks import s2r_of


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
    assert run.counts() == {Fault.LOST_READING: LOST_TICKS, Fault.SENSOR_LOST: 1}
    assert "spring4" in run.events[-1].message
    assert len(run.log) == 30 + LOST_TICKS
    assert np.abs(arm.written[29]).max() > 1.0
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


def test_no_reading_at_all_moves_nothing():
    arm = Blind(range(100), nan)
    assert go(arm).status == 3 and not np.any(arm.written)


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


def test_lost_chamber_vents():
    arm = Leaking(150)
    run = go(arm)
    assert abs(PRESSURES_KPA[0, 3]) > 5.0  # it matters
    assert run.status == 3 and run.counts()[Fault.CHAMBER_LOST] == 1
    [event] = [event for event in run.events if event.fault is Fault.CHAMBER_LOST]
    assert event.message.startswith("chamber3: at")
    np.testing.assert_array_equal(arm.command_kpa, 0.0)
    vented = np.abs(np.diff(np.array(arm.written)[-20:], axis=0))
    assert 0.0 < vented.max() <= VENT_KPA_PER_S * DT_S + 1e-9


def test_arm_without_air_vents():
    class Airless(LinearArm):
        def holds(self, pressure_kpa):
            return np.zeros_like(pressure_kpa)

    arm = Airless()
    run = go(arm)
    assert run.status == 3 and run.arrivals == () and "supply of air" in run.ending.cause
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


def test_chamber_lost_while_the_goal_moves_vents():
    arm = Leaking(500)
    run = trace(arm, Controller.of(POLICY, between), GOALS[:2], pace_s=30.0)
    assert run.status == 3 and run.counts()[Fault.CHAMBER_LOST] == 1 and len(run.arrivals) == 1
    assert 500 + MOVING_WINDOWS * CONTROLLER.window < len(run.log.goal) < 1000
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


@pytest.mark.parametrize("moves", [False, True])
def test_saturated_chamber_is_not_lost(moves):
    def beyond(*at):
        return between(*at) + np.where(np.arange(N) == 3, 0.08, 0.0)

    drive = functools.partial(trace, pace_s=5.0) if moves else follow
    run = drive(LinearArm(), Controller.of(POLICY, beyond), GOALS[:2])
    assert set(run.counts()) == {Fault.SATURATED} and len(run.arrivals) == 2
    assert "chamber3: at the limit, spring -" in run.events[0].message
    rows = run.ways[0] if moves else slice(run.arrivals[0].row, None)
    assert (run.log.pressure_kpa[rows, 3] == HIGH_KPA).mean() > 0.9


def test_arm_that_never_rests_is_counted():
    class Swinging(LinearArm):
        @property
        def spring_m(self):
            return super().spring_m + 5e-3 * np.sin(2 * np.pi * 0.7 * self.time_s)

    run = go(Swinging(), goals=GOALS[:1])
    assert run.counts()[Fault.NOT_SETTLED] == N_ACTIONS and len(run.arrivals) == 1
    assert run.log.time_s[run.arrivals[0].row] >= N_ACTIONS * SETTLE_TIMEOUT_S - 1.0


@pytest.mark.parametrize("goal", [FAR, np.full(6, np.nan), np.zeros(6)])
def test_goal_outside_is_skipped(goal):
    arm = LinearArm()
    run = go(arm, goals=[goal, GOALS[1]])
    assert run.counts() == {Fault.GOAL_OUTSIDE: 1}
    assert np.isnan(goal).any() or "the nearest is" in run.events[0].message
    assert [arrival.goal.tolist() for arrival in run.arrivals] == [GOALS[1].tolist()]


class Slow(LinearArm):
    """Some ticks take three periods."""

    def __init__(self, ticks, refuse=False):
        super().__init__()
        self._slow, self._refuse, self.n_writes = ticks, refuse, 0

    def write_pressures(self, pressure_kpa):
        self.n_writes += 1
        if self.n_writes not in self._slow:
            return super().write_pressures(pressure_kpa)
        if self._refuse:
            self.time_s += DT_S
            raise TimeoutError
        super().write_pressures(pressure_kpa)
        self.time_s += 2 * DT_S
        return None


@pytest.mark.parametrize("refuse", [False, True])
def test_missed_deadlines(refuse):
    run = go(Slow({20, 22, 23}, refuse))
    assert run.counts() == {Fault.MISSED_DEADLINE: 3} and len(run.arrivals) == 2
    arm = Slow(range(20, 29), refuse)
    run = go(arm)
    assert run.status == 3 and "arm late" in run.ending.cause
    assert run.counts() == {Fault.MISSED_DEADLINE: LATE_TICKS, Fault.ARM_LATE: 1}
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


def test_s2r_corrects_the_estimate_and_extrapolation_is_counted():
    rng, edge = np.random.default_rng(3), np.ones(N_POSE_INPUTS + N, np.float32)
    layers = tuple(
        (rng.normal(0.0, 0.2, shape).astype(np.float32), np.zeros(shape[1], np.float32))
        for shape in ((len(edge), 16), (16, N_POSE_OUTPUTS))
    )
    bound = np.repeat([9.0, 0.1], 3)
    network = s2r_of(layers, bound, anchors=edge[None], limit=np.float32(0.002))
    controller = Controller.of(dataclasses.replace(POLICY, s2r=network), exact_plan)
    run = go(LinearArm(), goals=GOALS[:1], controller=controller)
    assert run.counts() == {Fault.EXTRAPOLATION: N_ACTIONS}
    spring_m = read_m(run.log).astype(np.float32)
    simulated = estimate(POLICY.estimator, spring_m, 0.0)
    corrected = correct(network, simulated, spring_m)
    assert np.abs(corrected - simulated).max() > 0.5
    np.testing.assert_allclose(run.log.estimate, corrected, atol=2e-3)
    away = extrapolation(network, simulated[0], spring_m[0])  # of the simulated pose, not the corrected one
    assert abs(away - extrapolation(network, corrected[0], spring_m[0])) > 0.1
    assert run.events[0].message.startswith(f"{away:.1f} times")
