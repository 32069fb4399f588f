"""Rows of a log that show the arm at rest, on logs whose static poses are known."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from calib.read.static_poses import find_static_poses, nearest_rotation
from mjx_softarm import ArmSpec
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.session import trace
from mjx_softarm.logs.schema import Log
from tests.linear_arm import CONTROLLER, GOALS, POLICY, SENSOR, LinearArm, between, go, read_m

SPEC = ArmSpec.default()


def make_log(time_s, pressure_kpa, tip_m, noise=0.0, **changes):
    """All chambers at one pressure; the tip moves along x."""
    rng, n = np.random.default_rng(0), len(time_s)
    log = Log(
        source="a.csv",
        row=np.arange(n) + 2,
        time_s=np.asarray(time_s, float),
        pressure_kpa=np.reshape(pressure_kpa, (n, 1)) + noise * rng.normal(scale=0.1, size=(n, 9)),
        tip_m=np.column_stack([tip_m, np.zeros((n, 2))]) + noise * rng.normal(scale=5e-4, size=(n, 3)),
        tip_quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
    )
    return dataclasses.replace(log, **changes)


def steps(noise=1.0, tau_s=0.3, **changes):
    """Five seconds at each of three pressures, 50 rows a second; the tip follows."""
    time_s = np.arange(750) / 50.0
    pressure = np.repeat([0.0, 10.0, -20.0], 250)
    fade = np.tile(np.exp(-np.arange(250) / 50.0 / tau_s), 3)
    tip = np.repeat([0.0, 0.05, -0.1], 250) - fade * np.repeat([0.0, 0.05, -0.15], 250)
    return make_log(time_s, pressure, tip, noise, **changes)


def test_each_hold_is_one_pose_averaged_over_its_last_second():
    log = steps()
    poses, row_uses = find_static_poses([log], SPEC)
    assert poses.n == 3
    np.testing.assert_allclose(poses.pressure_kpa[:, 0], [0.0, 10.0, -20.0], atol=0.1)
    np.testing.assert_allclose(poses.tip_m[:, 0], [0.0, 0.05, -0.1], atol=3e-4)  # noise of a row is 5e-4
    np.testing.assert_allclose(poses.tip_m[1], log.tip_m[449:500].mean(0), atol=1e-12)
    assert (poses.n_rows == 51).all()
    n = 3 * 51
    assert {use: m for use, m in row_uses.items() if m} == {
        "used": n,
        "pressures not held long enough": 750 - n,
    }


def test_an_arm_that_is_still_on_its_way_is_left_out():
    poses, row_uses = find_static_poses([steps(tau_s=2.0)], SPEC)
    np.testing.assert_allclose(poses.pressure_kpa[:, 0], [0.0], atol=0.1)  # where it did not have to go
    assert row_uses["tip still moving"] == 2 * 51


def test_a_swinging_arm_and_slowly_changing_pressures_are_no_rest():
    time_s = np.arange(1000) / 50.0
    for rate_kpa_s, amplitude_m, n in ((0.0, 0.01, 0), (0.0, 0.0003, 1), (1.0, 0.0, 0)):
        swing = amplitude_m * np.sin(2 * np.pi * time_s)
        assert find_static_poses([make_log(time_s, rate_kpa_s * time_s, swing)], SPEC)[0].n == n


def test_poses_logged_one_by_one_were_held_meanwhile():
    log = make_log(5.0 * np.arange(6), [0, 20, -40, 3, 3, 5], 0.1 * np.arange(6))
    poses, row_uses = find_static_poses([log], SPEC)
    np.testing.assert_array_equal(poses.pressure_kpa[:, 0], [0, 20, -40, 3, 3, 5])
    assert (poses.n_rows == 1).all()
    assert row_uses["used"] == 6 and row_uses["pressures not held long enough"] == 0
    faster, _ = find_static_poses([make_log(2.0 * np.arange(6), [0, 20, -40, 3, 3, 5], np.zeros(6))], SPEC)
    assert faster.n == 0


def test_another_payload_is_another_hold():
    payload = np.repeat([0.0, 0.1, 0.2], [250, 250, 250])
    log = make_log(np.arange(750) / 50.0, np.zeros(750), np.zeros(750), payload_kg=payload)
    poses, _ = find_static_poses([log], SPEC)
    np.testing.assert_array_equal(poses.payload_kg, [0.0, 0.1, 0.2])
    loaded = SPEC.replace(mass={"payload_kg": 0.3})
    np.testing.assert_array_equal(find_static_poses([steps()], loaded)[0].payload_kg, [0.3] * 3)


def test_rows_that_are_not_finite_are_left_out_and_counted():
    log = steps()
    log.tip_m[260], log.pressure_kpa[10, 3] = np.nan, np.inf
    poses, row_uses = find_static_poses([log], SPEC)
    assert poses.n == 3 and row_uses["not finite"] == 2
    assert sum(row_uses.values()) == 750


def test_springs_are_read_from_frequencies_by_the_sensors_of_the_spec():
    length_m = np.full((750, 9), 0.18)
    hz = SPEC.spring_sensor.readings(length_m)
    poses, _ = find_static_poses([steps(readings=hz)], SPEC)
    assert np.isnan(poses.spring_m).all()
    np.testing.assert_allclose(poses.with_lengths(SPEC).spring_m, 0.18, rtol=1e-6)
    hz[460, 2] = 1.0
    poses, _ = find_static_poses([steps(readings=hz)], SPEC)
    assert np.argwhere(np.isnan(poses.with_lengths(SPEC).spring_m)).tolist() == [[1, 2]]
    calibrated = SPEC.replace(sensor={"delta_m": SPEC.sensor.delta_m + 1e-3})
    np.testing.assert_allclose(poses.with_lengths(calibrated).spring_m[0], 0.181, rtol=1e-6)
    assert np.isnan(find_static_poses([steps()], SPEC)[0].spring_m).all()


def test_logs_with_and_without_markers_or_poses_go_together():
    seen = steps(marker_m=np.ones((750, 9, 3)))
    poses, _ = find_static_poses([seen, steps()], SPEC)
    assert poses.marker_m.shape == (6, 9, 3)
    assert np.isfinite(poses.marker_m[:3]).all() and np.isnan(poses.marker_m[3:]).all()
    none, _ = find_static_poses([make_log([0.0], [0.0], [0.0])], SPEC)
    assert none.n == 0 and none.pressure_kpa.shape == (0, 9) and none.marker_m.shape == (0, 0, 3)


def test_the_mean_of_two_rotations_is_halfway():
    axis = np.array([0.48, 0.6, 0.64])
    first, middle, last = (Rotation.from_rotvec(angle * axis).as_matrix() for angle in (0.1, 0.3, 0.5))
    np.testing.assert_allclose(nearest_rotation(0.5 * (first + last)), middle, atol=1e-12)


def test_a_log_of_the_loop_has_a_pose_at_each_arrival():
    """Without motion capture, tips are not known; the last goal ends with the log."""
    run = go(LinearArm())
    poses, row_uses = find_static_poses([run.log], SPEC)
    assert poses.n == len(run.arrivals) == 2 and row_uses["used"] == 2 * CONTROLLER.window
    for k, arrival in enumerate(run.arrivals):
        rows = slice(arrival.row + 1 - CONTROLLER.window, arrival.row + 1)
        np.testing.assert_allclose(poses.pressure_kpa[k], run.log.pressure_kpa[rows].mean(axis=0))
        np.testing.assert_allclose(poses.with_lengths(SPEC).spring_m[k], read_m(run.log)[rows].mean(axis=0))
    assert np.isnan(poses.tip_m).all() and np.isnan(poses.tip_rotation).all()
    waiting = dataclasses.replace(
        run.log, readings=SENSOR.readings(read_m(run.log) + 1e-4 * run.log.row[:, None])
    )
    assert find_static_poses([waiting], SPEC)[0].n == 0


def test_a_log_of_a_moving_goal_has_poses_at_its_stops_only():
    """Between the stops the springs are still by the loop's rule, as the goal moves slowly."""
    slow = np.linspace(GOALS[0], 0.75 * GOALS[0] + 0.25 * GOALS[1], 2)
    run = trace(LinearArm(), Controller.of(POLICY, between), slow, pace_s=10.0)
    assert run.ways and len(run.log) > 400
    poses, row_uses = find_static_poses([run.log], SPEC)
    assert poses.n == len(run.arrivals) == 2 and sum(row_uses.values()) == len(run.log)
    for k, arrival in enumerate(run.arrivals):
        at_m = read_m(run.log)[arrival.row + 1 - CONTROLLER.window : arrival.row + 1].mean(axis=0)
        np.testing.assert_allclose(poses.with_lengths(SPEC).spring_m[k], at_m, atol=1e-4)


def test_equal_goals_in_a_row_give_the_last_pose_with_each_payload():
    run = go(LinearArm(), goals=[GOALS[0], GOALS[0], GOALS[1]])
    poses, row_uses = find_static_poses([run.log], SPEC)
    assert poses.n == 2 < len(run.arrivals) and sum(row_uses.values()) == len(run.log)
    for pressure_kpa, arrival in zip(poses.pressure_kpa, run.arrivals[1:], strict=True):
        rows = slice(arrival.row + 1 - CONTROLLER.window, arrival.row + 1)
        np.testing.assert_allclose(pressure_kpa, run.log.pressure_kpa[rows].mean(axis=0))
    carried_kg = np.where(np.arange(len(run.log)) > run.arrivals[0].row, 0.1, 0.0)
    carried = dataclasses.replace(run.log, payload_kg=carried_kg)
    np.testing.assert_array_equal(find_static_poses([carried], SPEC)[0].payload_kg, [0.0, 0.1, 0.1])


def test_springs_under_a_slow_law_are_watched_for_longer_and_those_near_the_axis_more_closely():
    """As the loop itself watches them."""
    log = go(LinearArm(), goals=[GOALS[0]]).log
    log = log.take(np.append(np.arange(len(log)), np.full(1000, len(log) - 1)))  # it stands there
    slow = SPEC.replace(control={"ki_kpa_per_ms": 0.1 * SPEC.control.ki_kpa_per_ms})
    (at_once,), (later,) = (find_static_poses([log], spec)[0].n_rows for spec in (SPEC, slow))
    assert at_once == CONTROLLER.window and later > 2 * CONTROLLER.window
    creeping = read_m(log) + 1e-5 * np.arange(len(log))[:, None]  # halves of a window are 0.12 mm apart
    creep = dataclasses.replace(log, readings=SENSOR.readings(creeping))
    radius_m = 0.25 * np.mean(SPEC.geometry.spring_radius_m)
    slim = SPEC.replace(geometry={"spring_radius_m": float(radius_m)})
    assert [find_static_poses([creep], spec)[0].n for spec in (SPEC, slim)] == [1, 0]
