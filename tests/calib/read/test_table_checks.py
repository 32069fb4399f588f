"""Planted faults in logs: each is found, named with line and column, and costs what it must."""

import numpy as np
import pytest

from calib.read.logs import read_log
from mjx_softarm.logs.checks import LogError
from mjx_softarm.logs.schema import UNITS, log_table, write_log
from tests.calib.read.arm_logs import N, arm_log, csv

# Rows at fault: group, rows, index of the column in the group, value; of the finding: column,
# problem, lines, rows that it costs.
FAULTS = {
    "NaN": ("readings", [7, 9], (3,), np.nan, "frequency3", "2 x NaN or inf", (9, 11), 2),
    "inf": ("spring_m", [0], (8,), np.inf, "spring8", "1 x NaN or inf", (2, 2), 1),
    "lost": ("readings", [50], (0,), 0.0, "frequency0", "first 0 Hz, expected 10000 Hz", (52, 52), 1),
    "spring": ("spring_m", [60, 61], (2,), 0.26, "spring2", "2 x outlier, first 260 mm", (62, 63), 2),
    "tip": ("tip_m", [200], (1,), 0.5, "tip_y", "1 x outlier, first 500 mm", (202, 202), 1),
    "marker": ("marker_m", [10], (0, 2), -1.0, "marker0_z", "1 x outlier, first -1000 mm", (12, 12), 1),
    "pressure": ("pressure_kpa", [33], (4,), 100.0, "pressure4", "1 x outlier, first 100 kPa", (35, 35), 1),
    "no rotation": ("tip_quaternion", [5, 6], (), 0.3, "tip_qw..qz", "2 x length not 1", (7, 8), 2),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_fault_is_found_and_costs_its_rows(file, fault):
    group, rows, index, value, column, problem, lines, cost = FAULTS[fault]
    values = np.array(getattr(arm_log(), group))
    values[(rows, *index)] = value
    path = file(**{group: values})
    log, findings = read_log(path)
    assert len(findings) == 1, list(map(str, findings))
    found = findings[0]
    assert (found.file, found.column, found.rows, found.n_dropped) == (str(path), column, lines, cost)
    assert problem in found.problem
    assert len(log) == N - cost and not set(np.array(rows) + 2) & set(log.row)


def test_stale_motion_capture(file):
    log = arm_log()
    tip_m, quaternion = log.tip_m.copy(), log.tip_quaternion.copy()
    for k in (100, 101, 250):
        tip_m[k], quaternion[k] = tip_m[k - 1], quaternion[k - 1]
    tip_m[300] = tip_m[299]  # the orientation goes on: seen, though at the same place
    log.marker_m[:, 0] = [0.0, 0.0, 0.01]  # at rest
    read, findings = read_log(file(tip_m=tip_m, tip_quaternion=quaternion, marker_m=log.marker_m))
    assert [(f.column, f.rows, f.n_dropped) for f in findings] == [("tip_x..z", (102, 252), 3)]
    assert set(log.row) - set(read.row) == {102, 103, 252}


def test_sign_flips_are_repaired_and_cost_nothing(file):
    quaternion = arm_log().tip_quaternion
    quaternion[150:170] *= -1.0
    quaternion[300] *= -1.0
    log, findings = read_log(file(tip_quaternion=quaternion))
    assert [(f.rows, f.n_dropped) for f in findings] == [((152, 303), 0)]
    assert findings[0].problem.startswith("4 x sign flipped")
    np.testing.assert_allclose(log.tip_quaternion, arm_log().tip_quaternion, atol=1e-8)


def test_turns_that_jump_back_are_dropped(file):
    w, x, y, z = arm_log().tip_quaternion.T
    turned = np.stack([-z, y, -x, w], axis=1)  # q k: about the body's own z axis
    quaternion = arm_log().tip_quaternion
    rows = [*range(40, 60), *range(200, 203)]
    quaternion[rows] = turned[rows]
    log, findings = read_log(file(tip_quaternion=quaternion))
    assert findings[0].problem.startswith("23 x turned by 180 degrees") and findings[0].n_dropped == 23
    assert sorted(set(arm_log().row) - set(log.row)) == [row + 2 for row in rows]
    np.testing.assert_allclose(log.tip_quaternion[:, 0], np.delete(w, rows), atol=1e-8)


@pytest.mark.parametrize(
    ("change", "late"),
    [
        ({10: 0.18}, {10}),  # repeated
        ({10: 0.0}, {10}),  # one row back
        ({10: 99.0}, {10}),  # one row ahead costs itself, not all that follow
        ({20: 0.1, 21: 0.12, 22: 0.14}, {20, 21, 22}),
    ],
)
def test_times_that_do_not_increase(file, change, late):
    time_s = arm_log().time_s
    for row, value in change.items():
        time_s[row] = value
    log, findings = read_log(file(time_s=time_s))
    times = [f for f in findings if "repeated or going back" in f.problem]
    assert len(times) == 1 and times[0].n_dropped == len(late)
    assert set(arm_log().row - 2) - set(log.row - 2) == late
    assert (np.diff(log.time_s) > 0.0).all()


def test_gaps_and_constant_columns_are_reported_alone(file):
    time_s = arm_log().time_s
    time_s[100:] += 3.0
    pressure_kpa = arm_log().pressure_kpa
    pressure_kpa[:, 5] = 7.5
    frozen_m = np.tile([0.0, 0.0, -0.6], (N, 1))  # constant, and not stale
    log, findings = read_log(file(time_s=time_s, pressure_kpa=pressure_kpa, tip_m=frozen_m))
    found = [(f.column, f.rows, f.n_dropped) for f in findings]
    assert found == [("time", (102, 102), 0), ("pressure5", (2, N + 1), 0), ("tip_x..z", (2, N + 1), 0)]
    assert "longest 3.02 s, expected steps near 0.02 s" in findings[0].problem
    assert "the same value, 7.5 kPa," in findings[1].problem
    assert len(log) == N


@pytest.mark.parametrize(
    ("name", "unit", "said", "column"),
    [
        ("spring0", "m", "mm", "spring0"),
        ("frequency0", "MHz", "Hz", "frequency0"),
        ("pressure", "Pa", "kPa", "pressure0"),
        ("pressure", "kPa", "Pa", "pressure_kpa"),
        ("tip", "cm", "mm", "tip_m"),
        ("payload", "kg", "g", "payload_kg"),
        ("time", "ms", "s", "time"),
    ],
)
def test_wrong_unit_is_refused_by_name(text, name, unit, said, column):
    columns, table = log_table(arm_log())
    headers = [c.header for c in columns]
    for k, c in enumerate(columns):
        if c.name.startswith(name) and c.kind != "number":
            table[:, k] *= UNITS[c.kind][c.unit] / UNITS[c.kind][unit]
            headers[k] = f"{c.name} [{said}]"
    with pytest.raises(LogError) as error:
        read_log(text(csv(headers, table)))
    assert column in {f.column for f in error.value.findings}
    assert "wrong unit" in str(error.value) or "z is up" in str(error.value)


SWAPPED = [("spring0", "frequency0"), ("spring4", "pressure4")]
SWAPPED += [("time", "tip_z"), ("tip_x", "tip_z"), ("tip_qw", "tip_z")]


@pytest.mark.parametrize(("one", "other"), SWAPPED)
def test_swapped_columns_are_refused(text, one, other):
    columns, table = log_table(arm_log())
    names = [c.name for c in columns]
    k, j = names.index(one), names.index(other)
    table[:, [k, j]] = table[:, [j, k]]
    with pytest.raises(LogError) as error:
        read_log(text(csv([c.header for c in columns], table)))
    assert {one, other} & {f.column for f in error.value.findings}


def test_poses_recorded_by_hand_may_be_far_apart(tmp_path):
    slow = arm_log(n=40, rate_hz=1 / 30)
    write_log(tmp_path / "slow.csv", slow)
    assert len(read_log(tmp_path / "slow.csv")[0]) > 30
    long = arm_log(n=600, rate_hz=1 / 20)  # 50 Hz in milliseconds
    write_log(tmp_path / "long.csv", long)
    with pytest.raises(LogError, match=r"time: got a median step of 20 s \(plausible in ms\)"):
        read_log(tmp_path / "long.csv")
