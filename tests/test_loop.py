"""The control loop on a linear arm whose every answer is known, with each fault injected."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calib.logs import read_log
from mjx_softarm import ArmSpec
from mjx_softarm.control import Gains
from mjx_softarm.deploy import faults, session
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.deploy.arms import ArmError, open_arm
from mjx_softarm.deploy.faults import RESPONSE, Fault, Response
from mjx_softarm.deploy.loop import N_ACTIONS, VENT_KPA_PER_S, Controller, Phase, start, step, with_goal
from mjx_softarm.deploy.reach import Reachable, nearest
from mjx_softarm.deploy.record import record
from mjx_softarm.deploy.session import follow
from mjx_softarm.estimator import PoseEstimator, SpringModel, estimate
from mjx_softarm.excitation import random_pressures
from mjx_softarm.export import Policy, save_policy
from mjx_softarm.logs import write_log
from mjx_softarm.obs import ObsScale
from mjx_softarm.rewards import RewardConfig
from mjx_softarm.s2r import N_POSE_INPUTS, N_POSE_OUTPUTS, S2R, correct, extrapolation
from mjx_softarm.sensors import (
    SensorParams,
    frequency_from_length,
    frequency_range_hz,
    length_from_frequency,
)

ROOT = Path(__file__).resolve().parent.parent
SPEC = ArmSpec.default()
N, DT_S = SPEC.n_chambers, 1.0 / SPEC.control.rate_hz
SENSOR = SensorParams.from_spec(SPEC)
LOW_KPA, HIGH_KPA = SPEC.chambers.pressure_min_kpa, SPEC.chambers.pressure_max_kpa
REST_M = 0.2
# A chamber lengthens its own spring and, by bending, shortens its section's others.
GAIN_M_PER_KPA = np.kron(np.eye(3), np.full((3, 3), -3e-4) + 1.8e-3 * np.eye(3))
NOISE_M = 4e-5
LAG = 0.15  # of the way to the commanded pressure, per tick


class LinearArm:
    """Springs that follow the pressures linearly, with a lag, on a clock of its own."""

    def __init__(self, noise_m=NOISE_M):
        self.time_s, self.noise_m = 0.0, noise_m
        self.command_kpa = self.actual_kpa = np.zeros(N)
        self.written = []
        self._rng = np.random.default_rng(0)

    @property
    def spring_m(self):
        return REST_M + GAIN_M_PER_KPA @ self.actual_kpa

    @property
    def tick(self):
        return round(self.time_s / DT_S)

    def read_frequencies(self):
        return frequency_from_length(self.spring_m + self.noise_m * self._rng.standard_normal(N), SENSOR)

    def write_pressures(self, pressure_kpa):
        self.command_kpa = np.array(pressure_kpa)
        self.written.append(self.command_kpa)
        self.actual_kpa = self.actual_kpa + LAG * (self.holds(self.command_kpa) - self.actual_kpa)
        self.time_s += DT_S

    def holds(self, pressure_kpa):
        return pressure_kpa


def make_policy():
    """A policy whose estimator and spring model are exact for the linear arm; its actor is not looked at."""
    centre = np.zeros(N, np.float32)
    angle = np.pi / 2 + 2 * np.pi * np.arange(N) / 3
    site = SPEC.geometry.spring_radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    network = PoseEstimator(
        layers=((np.zeros((2 * N, 18), np.float32), np.zeros(18, np.float32)),),
        spring_site_m=site.astype(np.float32),
        spring_centre_m=centre,
        spring_scale_m=centre + 1,
        change_scale=np.ones(6, np.float32),
    )
    model = SpringModel(
        layers=((GAIN_M_PER_KPA.astype(np.float32), np.zeros(N, np.float32)),),
        pressure_centre_kpa=centre,
        pressure_scale_kpa=centre + 1,
        spring_centre_m=centre + np.float32(REST_M),
        spring_scale_m=centre + 1,
    )
    rng = np.random.default_rng(1)
    return Policy(
        layers=((np.zeros((18, N), np.float32), np.zeros(N, np.float32)),),
        obs_scale=ObsScale(*(np.asarray(value, float) for value in ObsScale.from_spec(SPEC))),
        reward=RewardConfig(),
        frequency_hz=frequency_range_hz(SPEC),
        sensor=SENSOR,
        gains=Gains.from_spec(SPEC),
        rate_hz=SPEC.control.rate_hz,
        spec=SPEC,
        workspace=estimate(network, REST_M + rng.uniform(-30, 15, (2000, N)) @ GAIN_M_PER_KPA.T),
        estimator=network,
        spring_model=model,
        s2r=None,
        provenance={},
    )


POLICY = make_policy()
PRESSURES_KPA = np.random.default_rng(2).uniform(-20, 10, (2, N))
SPRINGS_M = REST_M + PRESSURES_KPA @ GAIN_M_PER_KPA.T
GOALS = estimate(POLICY.estimator, SPRINGS_M).astype(float)
FAR = GOALS[0] + [0.0, 0.0, -400.0, 0.0, 0.0, 0.0]


def exact_plan(pose, goal, spring_m):
    """The springs of the goal."""
    return SPRINGS_M[int(np.argmin(np.abs(GOALS - goal).sum(axis=1)))]


CONTROLLER = Controller.of(POLICY, exact_plan)


def go(arm, goals=GOALS, controller=CONTROLLER, **kwargs):
    return follow(arm, controller, goals, **kwargs)


# --- without faults --------------------------------------------------------------------------------


def read_m(log):
    """Spring lengths (rows, 9) [m] by the logged frequencies, NaN where a reading was lost."""
    return length_from_frequency(log.frequency_hz, SENSOR, np.nan).length_m


def test_reaches_goals_and_vents():
    arm, lines = LinearArm(), []
    run = go(arm, tell=lines.append)
    assert run.events == () and run.phase is Phase.DONE and not run.interrupted
    assert [arrival.goal.tolist() for arrival in run.arrivals] == GOALS.tolist()
    for arrival, spring_m in zip(run.arrivals, SPRINGS_M, strict=True):
        np.testing.assert_allclose(read_m(run.log)[arrival.row], spring_m, atol=5e-4)
        assert np.linalg.norm(arrival.estimate[:3] - arrival.goal[:3]) < 1.0
    np.testing.assert_array_equal(arm.command_kpa, 0.0)
    assert len(run.latency_s) == len(run.log) == len(arm.written) and len(lines) == len(GOALS)


def test_pressures_do_not_wait_for_the_log():
    arm, n_written = LinearArm(), []
    run = go(arm, goals=GOALS[:1], tell=lambda _: n_written.append(len(arm.written)))
    assert n_written == [run.arrivals[0].row + 1]


def test_acts_at_once_and_then_at_rest():
    arm, asked = LinearArm(), []

    def plan(pose, goal, spring_m):
        asked.append((arm.tick, np.abs(arm.command_kpa - arm.actual_kpa).max()))
        np.testing.assert_allclose(pose, estimate(POLICY.estimator, spring_m), atol=1e-3)
        np.testing.assert_allclose(spring_m, arm.spring_m, atol=5 * NOISE_M)
        return exact_plan(pose, goal, spring_m)

    go(arm, controller=Controller.of(POLICY, plan))
    assert len(asked) == N_ACTIONS * len(GOALS) and asked[0][0] == 0
    assert max(lag_kpa for _, lag_kpa in asked) < 0.2  # the arm has followed the command
    assert np.diff([tick for tick, _ in asked]).min() >= CONTROLLER.window or len(GOALS) > 1


def test_policy_itself_plans_by_default():
    run = go(LinearArm(), goals=GOALS[:1], controller=Controller.of(POLICY), duration_s=0.1)
    middle_hz = POLICY.frequency_hz.mean(axis=1)  # the actor's weights are zero
    got_hz = frequency_from_length(run.log.reference_m[1], SENSOR)
    np.testing.assert_allclose(got_hz, middle_hz, rtol=1e-6)


def test_state_is_not_changed_in_place():
    state, _ = with_goal(CONTROLLER, start(CONTROLLER), GOALS[0])
    arrays = [np.array(value, copy=True) for value in (state.integral_kpa, state.n_lost, state.springs_m)]
    frequency_hz = LinearArm().read_frequencies()
    first = step(CONTROLLER, state, frequency_hz, False)[0]
    second = step(CONTROLLER, state, frequency_hz, False)[0]
    np.testing.assert_array_equal(first.pressure_kpa, second.pressure_kpa)
    for before, after in zip(arrays, (state.integral_kpa, state.n_lost, state.springs_m), strict=True):
        np.testing.assert_array_equal(before, after)


def test_log_has_pressures_in_force_and_calibration_reads_it(tmp_path):
    arm = LinearArm()
    arm.motion_capture = lambda: Capture(
        tip_m=-arm.spring_m[:3],
        tip_quaternion=np.array([1.0, 0, 0, 0]),
        marker_m=np.ones((2, 3)) * arm.time_s,
    )
    run = go(arm, goals=GOALS[:1])
    np.testing.assert_array_equal(run.log.pressure_kpa[1:], arm.written[:-1])
    np.testing.assert_allclose(-run.log.tip_m, read_m(run.log)[:, :3], atol=5 * NOISE_M)  # of one instant
    np.testing.assert_allclose(np.diff(run.log.time_s), DT_S, rtol=1e-6)
    write_log(tmp_path / "run.csv", run.log)
    log, _ = read_log(tmp_path / "run.csv")
    assert len(log) > 0.5 * len(run.log)
    np.testing.assert_allclose(log.reference_m[0], SPRINGS_M[0], atol=1e-7)
    np.testing.assert_allclose(log.goal[0], GOALS[0], atol=1e-4)


def test_duration_ends_with_venting():
    arm = LinearArm()
    run = go(arm, duration_s=2.0)
    assert run.phase is Phase.DONE and run.arrivals == ()
    assert 2.0 <= run.log.time_s[-1] <= 2.0 + HIGH_KPA / VENT_KPA_PER_S + 2.0
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


# --- readings --------------------------------------------------------------------------------------


class Blind(LinearArm):
    """Readings go wrong in some ticks."""

    def __init__(self, ticks, spoil):
        super().__init__()
        self._ticks, self._spoil = ticks, spoil

    def read_frequencies(self):
        frequency_hz = super().read_frequencies()
        return self._spoil(frequency_hz) if self.tick in self._ticks else frequency_hz


def nan(frequency_hz):
    return np.where(np.arange(N) == 4, np.nan, frequency_hz)


def late(frequency_hz):
    raise TimeoutError


def gone(frequency_hz):
    raise OSError("bus error")


@pytest.mark.parametrize("spoil", [nan, late])
def test_one_lost_reading_holds_the_last_good_one(spoil):
    run = go(Blind({30, 40}, spoil))
    assert run.counts() == {Fault.LOST_READING: 2} and len(run.arrivals) == 2
    before_m, now_m, after_m = read_m(run.log)[29:32]
    held_m = np.where(np.isnan(now_m), before_m, now_m)
    assert held_m[4] == before_m[4] != after_m[4]
    np.testing.assert_allclose(run.log.estimate[30], estimate(POLICY.estimator, held_m), atol=1e-3)
    assert np.isnan(run.log.frequency_hz[30, 4])
    assert ("spring4: read nan Hz" in run.events[0].message) == (spoil is nan)


@pytest.mark.parametrize("spoil", [nan, late])
def test_several_lost_readings_hold(spoil):
    arm = Blind(range(30, 100), spoil)
    run = go(arm)
    assert run.phase is Phase.HOLD and run.arrivals == ()
    assert run.counts() == {Fault.LOST_READING: faults.LOST_TICKS, Fault.SENSOR_LOST: 1}
    assert "spring4" in run.events[-1].message
    assert len(run.log) == 30 + faults.LOST_TICKS and len(arm.written) == len(run.log) - 1
    assert np.abs(arm.command_kpa).max() > 1.0  # not vented


def test_no_reading_at_all_moves_nothing():
    arm = Blind(range(100), nan)
    assert go(arm).phase is Phase.HOLD
    np.testing.assert_array_equal(arm.written, 0.0)


def test_stuck_sensor_holds():
    arm = LinearArm()
    stuck_hz = arm.read_frequencies()[7]
    blind = Blind(range(20, 10**6), lambda f_hz: np.where(np.arange(N) == 7, stuck_hz, f_hz))
    run = go(blind)
    assert run.phase is Phase.HOLD and run.counts()[Fault.SENSOR_STUCK] == 1
    assert "spring7: moved less than 0.01 mm" in run.events[-1].message


def test_noiseless_arm_at_rest_is_not_stuck():
    run = go(LinearArm(noise_m=0.0))
    assert run.events == () and len(run.arrivals) == 2


def test_sensors_out_of_reach_hold_but_do_not_stop_venting():
    run = go(Blind({50}, gone))
    assert run.phase is Phase.HOLD and run.counts() == {Fault.ARM_LOST: 1}
    assert "read_frequencies: bus error" in run.events[0].message
    arm = Blind(range(105, 10**6), gone)
    assert go(arm, duration_s=2.0).phase is Phase.DONE
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


def test_wrong_number_of_readings():
    run = go(Blind({0}, lambda frequency_hz: frequency_hz[:5]))
    assert run.counts() == {Fault.ARM_LOST: 1} and "got shape (5,), expected (9,)" in run.events[0].message


# --- chambers --------------------------------------------------------------------------------------


class Leaking(LinearArm):
    """A chamber falls to atmospheric pressure."""

    def holds(self, pressure_kpa):
        return np.where((np.arange(N) == 3) & (self.tick >= 150), 0.0, pressure_kpa)


def test_lost_chamber_vents():
    arm = Leaking()
    run = go(arm)
    assert abs(PRESSURES_KPA[0, 3]) > 5.0  # it matters
    assert run.phase is Phase.DONE and run.counts()[Fault.CHAMBER_LOST] == 1
    [event] = [event for event in run.events if event.fault is Fault.CHAMBER_LOST]
    assert event.message.startswith("chamber3: at")
    np.testing.assert_array_equal(arm.command_kpa, 0.0)
    vented = np.abs(np.diff(np.array(arm.written)[-20:], axis=0))
    assert 0.0 < vented.max() <= VENT_KPA_PER_S * DT_S + 1e-9


def test_saturated_chamber_is_not_lost():
    beyond = SPRINGS_M[0] + np.where(np.arange(N) == 3, 0.08, 0.0)
    arm = LinearArm()
    run = go(arm, goals=GOALS[:1], controller=Controller.of(POLICY, lambda *_: beyond))
    assert set(run.counts()) == {Fault.SATURATED} and len(run.arrivals) == 1
    assert "chamber3: at the limit, spring -" in run.events[0].message
    assert max(written[3] for written in arm.written) == HIGH_KPA


def test_arm_that_never_rests_is_counted():
    class Swinging(LinearArm):
        @property
        def spring_m(self):
            return super().spring_m + 5e-3 * np.sin(2 * np.pi * 0.7 * self.time_s)

    run = go(Swinging(), goals=GOALS[:1])
    assert run.counts()[Fault.NOT_SETTLED] == N_ACTIONS and len(run.arrivals) == 1
    assert run.log.time_s[run.arrivals[0].row] >= N_ACTIONS * faults.SETTLE_TIMEOUT_S - 1.0


# --- goals -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("goal", [FAR, np.full(6, np.nan), np.zeros(6)])
def test_goal_outside_is_skipped(goal):
    arm = LinearArm()
    run = go(arm, goals=[goal, GOALS[1]])
    assert run.counts() == {Fault.GOAL_OUTSIDE: 1}
    assert [arrival.goal.tolist() for arrival in run.arrivals] == [GOALS[1].tolist()]


def test_only_goal_outside_moves_nothing():
    arm = LinearArm()
    run = go(arm, goals=[FAR])
    assert run.phase is Phase.DONE and "times as far" in run.events[0].message
    np.testing.assert_array_equal(arm.written, 0.0)


def test_distance_to_reachable_poses():
    reward = RewardConfig()
    pose = np.array([[0, 0, -600, 0, 0, 0], [0, 0, -590, 0, 0, 0], [0, 30, -600, 0, 0, 0]], float)
    found = Reachable.from_poses(pose, reward)
    assert found.limit == pytest.approx(30 * reward.weight_per_mm)
    near, distance = nearest(found, np.array([0, 60, -600, 0, 0, 0]), reward)
    np.testing.assert_array_equal(near, pose[2])
    assert distance == pytest.approx(1.0)
    _, turned = nearest(found, np.array([0, 0, -600, 0, 0, 90]), reward)
    assert turned == pytest.approx(90 * reward.weight_per_deg / found.limit)


# --- time ------------------------------------------------------------------------------------------


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
    arm = Slow(range(20, 60), refuse)
    run = go(arm)
    assert run.phase is Phase.HOLD
    assert run.counts() == {Fault.MISSED_DEADLINE: faults.LATE_TICKS, Fault.ARM_LATE: 1}


def test_refused_pressures_hold():
    class Strict(LinearArm):
        def write_pressures(self, pressure_kpa):
            if pressure_kpa.min() < -5.0:
                raise ValueError("below -5 kPa")
            super().write_pressures(pressure_kpa)

    run = go(Strict())
    assert run.phase is Phase.HOLD and "write_pressures: below -5 kPa" in run.events[0].message
    assert len(run.log) > 0


def test_dead_pumps_do_not_vent_for_ever():
    arm = Slow(range(100, 10**6), refuse=True)
    run = go(arm, duration_s=1.99)
    assert run.phase is Phase.HOLD and Fault.ARM_LOST in run.counts()


def test_real_arm_is_waited_for(monkeypatch):
    now = [5.0]
    slept = []
    monkeypatch.setattr(session.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(session.time, "sleep", lambda s: (slept.append(s), now.__setitem__(0, now[0] + s)))

    class Real:
        """Without a clock; each tick takes it 4 ms."""

        read_frequencies = staticmethod(LinearArm().read_frequencies)

        def write_pressures(self, pressure_kpa):
            now[0] += 0.004

    run = go(Real(), duration_s=1.0)
    assert run.events == ()
    np.testing.assert_allclose(slept, DT_S - 0.004, atol=1e-9)
    np.testing.assert_allclose(np.diff(run.log.time_s), DT_S, atol=1e-9)


def test_interrupt_vents_and_keeps_the_log():
    class Interrupted(LinearArm):
        n_interrupts = 1

        def read_frequencies(self):
            if self.tick == 60 and self.n_interrupts > 0:
                self.n_interrupts -= 1
                raise KeyboardInterrupt
            return super().read_frequencies()

    arm = Interrupted()
    run = go(arm)
    assert run.interrupted and run.phase is Phase.DONE and len(run.log) > 60
    np.testing.assert_array_equal(arm.command_kpa, 0.0)
    twice = Interrupted()
    twice.n_interrupts = 2
    run = go(twice)
    assert run.interrupted and run.phase is Phase.VENT and len(run.log) == 60


# --- responses -------------------------------------------------------------------------------------


def test_every_fault_has_a_response_and_stands_in_the_table():
    assert set(RESPONSE) == set(Fault)
    for fault, response in RESPONSE.items():
        [line] = [line for line in faults.__doc__.splitlines() if line.strip().startswith(fault.name + " ")]
        following = faults.__doc__.split(line)[1].split("\n")[1]
        word = {Response.SKIP: "skip"}.get(response, response.value)
        assert word in line[80:] + following[80:], fault


def test_s2r_corrects_the_estimate_and_extrapolation_is_counted():
    rng, edge = np.random.default_rng(3), np.ones(N_POSE_INPUTS + N, np.float32)
    network = S2R(
        layers=tuple(
            (rng.normal(0.0, 0.2, shape).astype(np.float32), np.zeros(shape[1], np.float32))
            for shape in ((len(edge), 16), (16, N_POSE_OUTPUTS))
        ),
        input_low=-edge,
        input_high=edge,
        output_low=np.float32([-9.0] * 3 + [-0.1] * 3),
        output_high=np.float32([9.0] * 3 + [0.1] * 3),
        anchors=edge[None],
        limit=np.float32(0.002),
    )
    controller = Controller.of(dataclasses.replace(POLICY, s2r=network), exact_plan)
    run = go(LinearArm(), goals=GOALS[:1], controller=controller)
    assert run.counts() == {Fault.EXTRAPOLATION: N_ACTIONS}
    spring_m = read_m(run.log).astype(np.float32)
    simulated = estimate(POLICY.estimator, spring_m)
    corrected = correct(network, simulated, spring_m)
    assert np.abs(corrected - simulated).max() > 0.5
    np.testing.assert_allclose(run.log.estimate, corrected, atol=2e-3)
    away = extrapolation(network, simulated[0], spring_m[0])  # of the simulated pose, not the corrected one
    assert abs(away - extrapolation(network, corrected[0], spring_m[0])) > 0.1
    assert run.events[0].message.startswith(f"{away:.1f} times")


# --- recording -------------------------------------------------------------------------------------


def test_random_pressures_follow_the_arcsine_law():
    kpa = random_pressures(SPEC, 20_000, 0)
    assert kpa.min() >= LOW_KPA and kpa.max() <= HIGH_KPA
    share = (kpa - LOW_KPA) / (HIGH_KPA - LOW_KPA)
    for x in (0.05, 0.3, 0.5, 0.9):
        assert np.mean(share < x) == pytest.approx(2 / np.pi * np.arcsin(np.sqrt(x)), abs=0.01)
    np.testing.assert_array_equal(kpa[:5], random_pressures(SPEC, 20_000, 0)[:5])


def test_recorded_poses_are_at_rest(tmp_path):
    arm, targets_kpa = LinearArm(), random_pressures(SPEC, 5, 3)
    result = record(arm, SPEC, targets_kpa)
    assert (result.n_poses, result.n_unsettled, result.problem) == (5, 0, "")
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
    assert "readings lost in 3 ticks in a row: spring4: read nan Hz" in result.problem
    assert 0 < result.n_poses == len(result.log) < 50
    np.testing.assert_array_equal(arm.command_kpa, 0.0)


# --- arms by name and command line -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("twin", "got 'twin', expected twin:SEED or package.module:Class"),
        ("twin:-1", "got '-1', expected an integer >= 0"),
        ("no_such_module:Arm", "no_such_module cannot be imported: No module named 'no_such_module'"),
        ("mjx_softarm.deploy.loop:Nothing", "module mjx_softarm.deploy.loop has no 'Nothing'"),
        ("mjx_softarm.deploy.loop:Phase", "has no method read_frequencies or write_pressures"),
    ],
)
def test_arm_that_cannot_be_had(name, message):
    with pytest.raises(ArmError, match=message):
        open_arm(name)


DRIVER = """
import numpy as np

class Arm:
    time_s = 0.0
    def read_frequencies(self):
        return np.full(9, {frequency_hz}) + np.random.default_rng(round(50 * self.time_s)).normal(0, 300, 9)
    def write_pressures(self, pressure_kpa):
        self.time_s += 0.02
"""
WITHOUT_JAX = """
import sys
from mjx_softarm.deploy.__main__ import main

status = main(sys.argv[1:])
loaded = sorted({name.split(".")[0] for name in sys.modules} & {"jax", "mujoco", "train", "calib"})
print(status, loaded)
"""


@pytest.fixture
def folder(tmp_path):
    frequency_hz = frequency_from_length(np.full(N, REST_M), SENSOR)[0]
    (tmp_path / "driver.py").write_text(DRIVER.format(frequency_hz=frequency_hz))
    save_policy(tmp_path / "policy.npz", POLICY)
    return tmp_path


def command(folder, *args):
    return subprocess.run(
        [sys.executable, "-c", WITHOUT_JAX, *args],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_command_line_runs_without_jax(folder):
    goal = "--goal=" + ",".join(map(str, POLICY.workspace[0]))
    done = command(
        folder, "run", "policy.npz", "--arm", "driver:Arm", goal, "--log", "a.csv", "--duration", "1"
    )
    assert done.stderr == "" and done.stdout.endswith("0 []\n")
    assert "from readings to pressures: median" in done.stdout and "the arm is vented" in done.stdout
    assert len(read_log(folder / "a.csv")[0]) > 0
    done = command(folder, "record", "--arm", "driver:Arm", "--out", "b.csv", "--poses", "2")
    assert done.stderr == "" and done.stdout.endswith("0 []\n") and "no motion capture" in done.stdout
    assert (folder / "b.csv").read_text().count("\n") == 3


def test_command_line_tells_what_is_wrong(folder):
    goal = ("--goal", "0,0,-600,0,0,0")
    for args, message in (
        (("run", "no.npz", "--arm", "driver:Arm", *goal), "no.npz: cannot be read"),
        (("run", "policy.npz", "--arm", "driver:Arms", *goal), "module driver has no 'Arms'"),
        (("run", "policy.npz", "--arm", "driver:Arm", *goal, "--log", "no/a.csv"), "--log: no is no folder"),
    ):
        done = command(folder, *args)
        assert done.stdout.startswith("2 ") and message in done.stderr and done.stderr.count("\n") == 1
    far = "--goal=" + ",".join(map(str, FAR))
    done = command(folder, "run", "policy.npz", "--arm", "driver:Arm", far)
    assert done.stdout.endswith("3 []\n") and "goal outside the workspace" in done.stdout


def test_loop_drives_the_twin():
    twin = open_arm("twin:0")
    run = go(twin, goals=GOALS[:1], duration_s=1.0)
    assert run.phase is Phase.DONE and set(run.counts()) <= {Fault.SATURATED}
    assert run.log.tip_m.shape == (len(run.log), 3) and np.isfinite(run.log.tip_quaternion).all()
    assert np.ptp(run.log.tip_m, axis=0).max() > 1e-3  # it moved
    np.testing.assert_allclose(np.diff(run.log.time_s), DT_S, atol=1e-9)
