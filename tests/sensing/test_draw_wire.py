"""Another sensor, from one end to the other: an arm whose springs are read by draw-wire encoders."""

import dataclasses

import jax
import numpy as np
import pytest

from calib.fit.springs import fit_springs
from calib.read.logs import read_log
from mjx_softarm import ArmSpec
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.record import record
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.logs.checks import LogError
from mjx_softarm.logs.schema import write_log
from mjx_softarm.policy.file import load_policy, save_policy
from tests.linear_arm import GOALS, LinearArm, exact_plan, go, make_policy

WIRE = {"kind": "draw_wire", "m_per_v": 0.2, "voltage_min_v": 0.05, "voltage_max_v": 4.95}
SPEC = ArmSpec.default().replace(sensor=WIRE | {"beta": 1.0, "delta_m": 0.0})
BETA, DELTA_M = np.linspace(0.94, 1.03, 9), np.linspace(-0.13, 0.02, 9)
PLANTED = dataclasses.replace(SPEC.spring_sensor, beta=BETA, delta_m=DELTA_M)


class WireArm(LinearArm):
    """The linear arm with draw wires, seen by cameras."""

    def __init__(self):
        super().__init__(sensor=PLANTED)

    def motion_capture(self):
        return Capture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros((1, 3)), self.spring_m)


def test_voltages_are_lengths_by_scale_and_calibration():
    volts = np.array([0.5, 1.0, 1.5, 2.0, 0.04, 5.0, np.nan, 2.0, 2.0])
    length_m, lost = PLANTED.lengths(volts, 0.1)
    good = ~lost
    # The lost ones are too short by the calibration, too low, too high, and not a number.
    np.testing.assert_array_equal(good, [0, 1, 1, 1, 0, 0, 0, 1, 1])
    np.testing.assert_allclose(length_m[lost], 0.1)
    np.testing.assert_allclose(length_m[good], (BETA * volts / 5.0 * 1.0 + DELTA_M)[good])
    np.testing.assert_allclose(PLANTED.readings(length_m)[good], volts[good])
    assert "spring4: got 0.04 V, expected 0.05 to 4.95 V" in PLANTED.describe_lost(volts, lost)


def test_actions_are_voltages_and_lead_where_they_say(quick_compiler):
    short = SPEC.replace(structure={"n_sections": 1, "links_per_section": 2})
    env = ReachEnv(short, EnvConfig(engine="chain", n_poses=16))
    shortest_v, middle_v, longest_v = 0.085 / 0.2, 0.18 / 0.2, 0.275 / 0.2  # beta is 1, delta 0
    expected = np.outer([shortest_v, middle_v, longest_v], np.ones(3))
    np.testing.assert_allclose(env.action_map.readings(np.linspace(-1, 1, 3)[:, None]), expected, rtol=1e-6)
    state = jax.jit(env.reset)(jax.random.key(0))
    goal_m = env.pool.spring_m[3]
    after = jax.jit(env.step)(state, env.action_of(goal_m))
    assert after.info["valid"]
    np.testing.assert_allclose(after.pipeline_state.spring_m, goal_m, atol=1e-4)
    np.testing.assert_allclose(after.pipeline_state.pose[:3], env.pool.pose[3, :3], atol=0.5)


def test_recorded_voltages_calibrate_the_wires(tmp_path):
    targets_kpa = np.random.default_rng(0).uniform(-20.0, 10.0, (20, 9))
    log = record(WireArm(), SPEC.replace(springs={"length_min_m": 0.1}), targets_kpa).log
    log = dataclasses.replace(log, tip_m=None, tip_quaternion=None, marker_m=None)
    write_log(tmp_path / "springs.csv", log)
    assert "voltage0 [V]" in (tmp_path / "springs.csv").read_text().splitlines()[0]
    log, _ = read_log(tmp_path / "springs.csv", SPEC)
    fit = fit_springs(log.readings, log.spring_m, SPEC.spring_sensor)
    np.testing.assert_allclose(fit.slope, BETA, rtol=5e-3)
    np.testing.assert_allclose(fit.offset, DELTA_M, atol=1e-3)
    with pytest.raises(LogError, match="voltage0: got readings of another sensor, expected frequency"):
        read_log(tmp_path / "springs.csv")
    with pytest.raises(LogError, match="voltage0: got readings of another sensor, expected frequency"):
        log.lengths_m(ArmSpec.default().spring_sensor)


def test_policy_is_written_read_and_run(tmp_path):
    spec = SPEC.replace(sensor={"beta": tuple(BETA), "delta_m": tuple(DELTA_M)})
    save_policy(tmp_path / "policy.npz", make_policy(spec))
    policy = load_policy(tmp_path / "policy.npz")
    np.testing.assert_array_equal(policy.sensor.beta, BETA)
    run = go(WireArm(), GOALS[:1], Controller.of(policy, exact_plan))
    assert len(run.arrivals) == 1 and run.log.reading_name == "voltage"
    np.testing.assert_allclose(run.arrivals[0].estimate[:3], GOALS[0, :3], atol=0.5)

    class Unplugged(WireArm):
        def read_sensors(self):
            volts = super().read_sensors()
            return np.where((np.arange(9) == 2) & (self.tick > 20), 0.0, volts)

    run = go(Unplugged(), GOALS[:1], Controller.of(policy, exact_plan))
    assert {Fault.LOST_READING, Fault.SENSOR_LOST} <= set(run.counts())
    assert "spring2: got 0 V" in run.events[0].message
