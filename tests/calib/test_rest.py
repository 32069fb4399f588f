"""Which rows show the arm at rest, on logs whose rests are known."""

import numpy as np

from calib.rest import REST_S, rows_at_rest
from mjx_softarm.logs import Log


def make_log(time_s, pressure_kpa=None, tip_m=None):
    n = len(time_s)
    return Log(
        source="a.csv",
        row=np.arange(n) + 2,
        time_s=np.asarray(time_s, float),
        pressure_kpa=None if pressure_kpa is None else np.repeat(np.reshape(pressure_kpa, (n, 1)), 9, axis=1),
        tip_m=None if tip_m is None else np.column_stack([tip_m, np.zeros((n, 2))]),
    )


def test_poses_logged_one_by_one_are_all_at_rest():
    time_s = 5.0 * np.arange(6)
    rows = rows_at_rest(make_log(time_s, pressure_kpa=[0, 20, -40, 3, 4, 5]))
    np.testing.assert_array_equal(rows, np.arange(6))


def test_steps_at_the_control_rate_give_one_row_each_the_last():
    """Five seconds at each of three pressures, 50 rows a second; the tip follows within a second."""
    time_s = np.arange(750) / 50.0
    pressure = np.repeat([0.0, 10.0, -20.0], 250)
    tip = np.repeat([0.0, 0.05, -0.1], 250)
    tip[250:300] = np.linspace(0.0, 0.05, 50)
    tip[500:550] = np.linspace(0.05, -0.1, 50)
    np.testing.assert_array_equal(rows_at_rest(make_log(time_s, pressure, tip)), [249, 499, 749])


def test_a_tip_that_swings_is_not_at_rest():
    time_s = np.arange(500) / 50.0
    swinging = 0.01 * np.sin(2 * np.pi * time_s)
    assert len(rows_at_rest(make_log(time_s, np.zeros(500), swinging))) == 0
    assert len(rows_at_rest(make_log(time_s, np.zeros(500), 0.01 * swinging))) == 1


def test_slow_drift_within_tolerance_from_row_to_row_is_not_rest():
    time_s = np.arange(1000) / 50.0
    assert len(rows_at_rest(make_log(time_s, time_s))) == 0  # 1 kPa a second, 2 kPa over the window


def test_a_rest_shorter_than_the_window_does_not_count():
    time_s = np.arange(0.0, REST_S, 0.02)
    assert len(rows_at_rest(make_log(time_s, np.zeros(len(time_s))))) == 0


def test_short_logs():
    assert len(rows_at_rest(make_log([]))) == 0
    np.testing.assert_array_equal(rows_at_rest(make_log([0.0], [1.0])), [0])
