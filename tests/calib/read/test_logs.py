"""Logs: whole files come back, templates are valid, logs of different arms are refused."""

import dataclasses

import numpy as np
import pytest

from calib.read.logs import read_log, template
from calib.read.measurements import measure
from mjx_softarm.logs.checks import LogError
from mjx_softarm.logs.schema import UNITS, log_columns, log_table
from tests.calib.read.arm_logs import N, arm_log, csv


@pytest.mark.parametrize("name", ["arm.csv", "arm.npz"])
def test_clean_log_comes_back_without_findings(file, name):
    expected = arm_log(sequence=np.repeat(np.arange(8.0), N // 8))
    log, findings = read_log(file(name, sequence=expected.sequence))
    assert findings == []
    np.testing.assert_array_equal(log.row, expected.row)
    np.testing.assert_allclose(log_table(log)[1], log_table(expected)[1], rtol=1e-8, atol=1e-6)
    assert log.goal is None and log.estimate is None and log.reference_m is None


@pytest.mark.parametrize("rows", [slice(0, 30), slice(None)])
def test_log_of_a_run_may_lack_references_goals_and_estimates(file, rows):
    goal = np.tile([80.0, 0.0, -575.0, 0.0, 0.0, 0.0], (N, 1))
    goal[rows], reference_m = np.nan, 0.2 * goal[:, [0] * 9] / 80.0
    log, findings = read_log(file(goal=goal, reference_m=reference_m, estimate=goal))
    assert findings == [] and len(log) == N
    np.testing.assert_allclose(log.goal, goal)
    goal[5] = np.inf
    assert len(read_log(file(goal=goal))[0]) == N - 1


@pytest.mark.parametrize("seed", range(3))
def test_a_row_per_pose_comes_back_without_findings(file, seed):
    """Separate poses, seconds apart, some of them held: no motion, so no jump, turn or spike."""
    rng = np.random.default_rng(seed)
    hold = np.repeat(np.arange(N // 2), rng.integers(2, 4, N // 2))[:N]
    quaternion = rng.standard_normal((N, 4)) * [1.0, 1.0, 1.0, 0.1]
    quaternion[:, 0] = 0.5 + np.abs(quaternion[:, 0])
    poses = {
        "spring_m": rng.uniform(0.105, 0.235, (N, 9))[hold],
        "readings": rng.uniform(3e6, 5e6, (N, 9))[hold],
        "pressure_kpa": rng.choice([-40.0, 0.0, 20.0], (N, 9))[hold],
        "tip_m": rng.uniform([-0.2, -0.2, -0.8], [0.2, 0.2, -0.4], (N, 3))[hold]
        + rng.normal(0.0, 1e-5, (len(hold), 3)),
        "tip_quaternion": (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))[hold],
        "marker_m": None,
        "time_s": 3.0 * np.arange(N),
    }
    assert read_log(file(**poses))[1] == []


def test_units_and_order_of_the_file_do_not_matter(text):
    """Each unit of UNITS gives the same log, against factors known apart from the code."""
    known = {"ms": 1e-3, "kHz": 1e3, "MHz": 1e6, "mm": 1e-3, "cm": 1e-2, "Pa": 1e-3, "bar": 1e2, "mbar": 0.1}
    known |= {"psi": 6.894757293, "g": 1e-3, "rad": 57.29577951}
    pose_mm = {"m": 1e3, "cm": 10.0, "mm": 1.0}
    expected = arm_log(n=20, goal=np.tile([0.0, 120.0, -500.0, 10.0, -20.0, 30.0], (20, 1)))
    columns, table = log_table(expected)
    inside = table * [UNITS[c.kind][c.unit] for c in columns]
    rng = np.random.default_rng(0)
    for trial in range(8):
        units = [rng.choice(list(UNITS[c.kind])) for c in columns]
        pairs = zip(columns, units, strict=True)
        factors = [pose_mm[u] if c.kind == "pose_length" else known.get(u, 1.0) for c, u in pairs]
        order = rng.permutation(len(columns))
        headers = [f"{columns[k].name} [{units[k]}]" for k in order]
        content = csv(headers, (inside / factors)[:, order])
        log, findings = read_log(text(content, f"{trial}.csv"))
        assert findings == []
        np.testing.assert_allclose(log_table(log)[1], table, rtol=1e-8, atol=1e-7)


def test_template_is_valid_and_its_text_names_all_columns(tmp_path):
    path = tmp_path / "template.csv"
    words = template(path)
    log, findings = read_log(path)
    assert findings == [] and len(log) == 10
    groups = {(c.group, c.kind): c.name for c in reversed(log_columns(9, 9, 3))}
    assert all(f"\n{name} " in words for name in groups.values())
    with pytest.raises(FileExistsError, match="template.csv"):
        template(path)


def test_logs_of_one_arm_and_of_two(spec):
    first = arm_log(source="a.csv")
    measure([first, arm_log(seed=1, source="b.csv"), arm_log(seed=2, source="c.csv")], spec)
    for change, message in [
        ({"spring_m": 3.0 * first.spring_m}, "spring_m: got 0.1.* and 0.5"),
        ({"readings": 0.5 * first.readings}, "readings: "),
        ({"tip_m": 2.0 * first.tip_m}, "tip_m: "),
        ({"pressure_kpa": first.pressure_kpa[:, :6]}, "pressure_kpa: got 9 and 6 in a row"),
        ({"marker_m": first.marker_m[:, :2]}, "marker_m: got 3 and 2 in a row"),
    ]:
        other = dataclasses.replace(first, source="b.csv", **change)
        with pytest.raises(LogError, match="a.csv and b.csv: " + message):
            measure([first, first, other], spec)
    bare = dataclasses.replace(first, source="d.csv", marker_m=None, tip_m=None, tip_quaternion=None)
    measure([bare, first], spec)  # a log need not have everything


def test_too_few_rows_left_are_refused_with_the_reasons(file):
    spring_m = arm_log().spring_m
    spring_m[1:, 0] = np.nan
    with pytest.raises(LogError, match="spring0: 399 x NaN or inf.*\n.*1 rows left, expected 2 at least"):
        read_log(file(spring_m=spring_m))
