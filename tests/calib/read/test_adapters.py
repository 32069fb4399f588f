"""The adapters find what is known to be wrong with the real logs, and what was planted in small ones."""

from pathlib import Path

import numpy as np
import pytest

from calib.read.adapters import read_asu, read_trunk, wire_length_m
from mjx_softarm.logs import checks
from mjx_softarm.logs.checks import LogError

DATA = Path(__file__).parents[3].parent / "shared/data"
real = pytest.mark.skipif(not DATA.is_dir(), reason="the real logs are not beside the checkout")
PSI = 6.894757293


def found(findings, text):
    """Column -> how many rows, of the findings with some text."""
    return {f.column: int(f.problem.split(" x ")[0]) for f in findings if text in f.problem}


@real
@pytest.mark.parametrize(("number", "n_rows", "n_stale"), [(1, 15_001, 14), (11, 6_001, 281)])
def test_trunk_stale_tip(number, n_rows, n_stale):
    path = DATA / f"asl_trunk/observations_controlled_{number}.csv"
    log, findings = read_trunk(path)
    raw = np.genfromtxt(path, delimiter=",", names=True)
    assert len(log.fresh) == n_rows
    assert found(findings, "equal to the row before")["body 2"] == n_stale == np.count_nonzero(~log.fresh)
    assert {f.n_dropped for f in findings if f.column == "body 2" and "equal" in f.problem} == {n_stale}
    np.testing.assert_array_equal(log.position_m[:, 2, 1], raw["y3"])
    np.testing.assert_array_equal(log.motor_deg[:, 4], raw["phi5"])


@real
def test_trunk_turned_tip():
    path = DATA / "asl_trunk/observations_controlled_11.csv"
    log, findings = read_trunk(path)
    raw = np.genfromtxt(path, delimiter=",", names=True)
    turned = np.isnan(log.quaternion[:, 2]).any(axis=1)
    assert found(findings, "turned by 180")["body 2 quaternion"] == 51 == np.count_nonzero(turned)
    assert found(findings, "turned by 180").keys() == {"body 1 quaternion", "body 2 quaternion"}
    # What is left is one continuous motion, the same rotations as in the file.
    kept = log.quaternion[~turned, 2]
    assert ((kept[1:] * kept[:-1]).sum(axis=1) > np.cos(np.radians(15.0))).all()
    file = np.stack([raw[name] for name in ("w3", "qx3", "qy3", "qz3")], axis=1)[~turned]
    np.testing.assert_allclose(np.abs((kept * file).sum(axis=1)), 1.0, atol=1e-6)
    assert read_trunk(DATA / "asl_trunk/observations_controlled_1.csv")[0].quaternion is None


@real
@pytest.mark.parametrize(
    ("name", "n_rows", "share", "jumps"),
    [("apr5", 4_338, 0.70, {1: 0, 2: 40}), ("apr4", 1_773, 0.59, {1: 6, 2: 298})],
)
def test_asu_faults_and_units(name, n_rows, share, jumps):
    path = DATA / f"asu_softarm/{name}_data_collect_1.txt"
    log, findings = read_asu(path)
    raw = np.loadtxt(path, delimiter=",")
    assert len(log.fresh) == n_rows
    assert np.mean(~log.fresh) == pytest.approx(share, abs=0.005)
    turned = found(findings, "turned by 180")
    for body, n_jumps in jumps.items():
        bad = np.isnan(log.quaternion[:, body]).any(axis=1)
        assert np.count_nonzero(np.diff(bad.astype(int))) == n_jumps
        assert turned.get(f"body {body} quaternion", 0) == np.count_nonzero(bad) < n_rows / 2
        kept = log.quaternion[~bad, body]
        assert ((kept[1:] * kept[:-1]).sum(axis=1) > 0.9).all()
        file = raw[~bad][:, 17 + 7 * body + np.array([6, 3, 4, 5])]  # scalar last
        np.testing.assert_allclose(np.abs((kept * file).sum(axis=1)), 1.0, atol=1e-5)
    assert not np.isnan(log.quaternion[:, 0]).any()

    # Pressures step between 1 and 15 psi; the wires of section 1 move as the distance of base and middle.
    assert log.desired_kpa.min() == pytest.approx(PSI) and log.desired_kpa.max() == pytest.approx(15.0 * PSI)
    np.testing.assert_allclose(log.desired_kpa / PSI, raw[:, [1, 2, 3, 7, 8, 9]], rtol=1e-9)
    np.testing.assert_allclose(log.pressure_kpa / PSI, raw[:, [4, 5, 6, 10, 11, 12]], rtol=1e-9)
    wire_m = wire_length_m(log.wire_v[:, :2]).mean(axis=1)
    section_m = np.linalg.norm(log.position_m[:, 1] - log.position_m[:, 0], axis=1)
    slope, _ = np.polyfit(wire_m[log.fresh], section_m[log.fresh], 1)
    assert 0.8 < slope < 1.1
    assert (np.diff(log.time_s) > 0.0).all()


@real
def test_real_motion_has_next_to_no_outliers():
    """The detector of `read_log`, on step responses and on fast swings: positions, pressures, draw-wires."""
    for name in ("apr5", "apr4"):
        log, _ = read_asu(DATA / f"asu_softarm/{name}_data_collect_1.txt")
        columns = [*log.position_m[log.fresh].reshape(-1, 9).T, *wire_length_m(log.wire_v).T]
        assert sum(np.count_nonzero(checks.outlier_rows(column, 2e-3)) for column in columns) <= 1
        assert sum(np.count_nonzero(checks.outlier_rows(column, 10.0)) for column in log.pressure_kpa.T) == 0
    for number in (1, 11):
        log, _ = read_trunk(DATA / f"asl_trunk/observations_controlled_{number}.csv")
        tip = log.position_m[log.fresh, 2]
        assert not any(checks.outlier_rows(tip[:, axis], 2e-3).any() for axis in range(3))


def quaternions(n, turned=(), flipped=()):
    """A slow turn about x (n, 4), scalar last; some rows turned by 180 degrees about z, or sign flipped."""
    half = 0.3 * np.sin(np.arange(n) / 10.0)
    quaternion = np.stack([np.sin(half), 0.0 * half, 0.0 * half, np.cos(half)], axis=1)
    x, y, z, w = quaternion[list(turned)].T
    quaternion[list(turned)] = np.stack([y, -x, w, -z], axis=1)
    quaternion[list(flipped)] *= -1.0
    return quaternion


@pytest.fixture
def asu_file(tmp_path):
    def write(turned=(), flipped=(), stale=(), n=60, cell=None):
        rng = np.random.default_rng(0)
        table = np.zeros((n, 38))
        table[:, 0] = 0.01 * np.arange(n)
        table[:, 1:17] = np.arange(1, 17) + 0.01 * rng.standard_normal((n, 16))
        for body in range(3):
            table[:, 17 + 7 * body : 20 + 7 * body] = -0.1 * body + 0.001 * rng.standard_normal((n, 3))
            table[:, 20 + 7 * body : 24 + 7 * body] = quaternions(n, turned if body == 2 else (), flipped)
        for row in stale:
            table[row, 17:] = table[row - 1, 17:]
        if cell:
            table[cell] = np.nan
        np.savetxt(tmp_path / "asu.txt", table, "%.9g", ", ")
        return tmp_path / "asu.txt"

    return write


def test_asu_columns(asu_file):
    log, findings = read_asu(asu_file())
    assert findings == [] and log.fresh.all()
    np.testing.assert_array_equal(log.row, np.arange(60) + 1)
    np.testing.assert_allclose(log.desired_kpa.mean(axis=0) / PSI, [1, 2, 3, 7, 8, 9], atol=0.01)
    np.testing.assert_allclose(log.pressure_kpa.mean(axis=0) / PSI, [4, 5, 6, 10, 11, 12], atol=0.01)
    np.testing.assert_allclose(wire_length_m(log.wire_v).mean(axis=0), np.arange(13, 17) / 5.0, atol=0.01)
    np.testing.assert_allclose(log.position_m.mean(axis=0), [[0.0] * 3, [-0.1] * 3, [-0.2] * 3], atol=0.001)
    np.testing.assert_allclose(log.quaternion[:, 1], quaternions(60)[:, [3, 0, 1, 2]], atol=1e-8)


def test_asu_planted_faults(asu_file):
    log, findings = read_asu(asu_file(turned=range(20, 26), flipped=(40, 41), stale=(5, 6, 50)))
    assert np.flatnonzero(~log.fresh).tolist() == [5, 6, 50]
    assert np.flatnonzero(np.isnan(log.quaternion[:, 2, 0])).tolist() == list(range(20, 26))
    assert found(findings, "equal to the row before") == {f"body {k}": 3 for k in range(3)}
    assert found(findings, "turned") == {"body 2 quaternion": 6}
    assert found(findings, "sign flipped") == {f"body {k} quaternion": 2 for k in range(3)}
    assert {f.rows for f in findings if "turned" in f.problem} == {(21, 26)}
    np.testing.assert_allclose(log.quaternion[38:44, 0], quaternions(60)[38:44][:, [3, 0, 1, 2]], atol=1e-8)


@pytest.fixture
def trunk_file(tmp_path):
    def write(turned=(), stale=(), n=60, without=()):
        rng = np.random.default_rng(0)
        columns = {"ID": np.arange(n)}
        for disk in (1, 2, 3):
            columns |= {f"{axis}{disk}": disk + 0.01 * rng.standard_normal(n) for axis in "xyz"}
        for disk in (1, 2, 3):
            parts = quaternions(n, turned if disk == 3 else ()).T
            columns |= {f"{n}{disk}": q for n, q in zip(("qx", "qy", "qz", "w"), parts, strict=True)}
        columns |= {f"phi{k}": 10.0 * k + rng.standard_normal(n) for k in range(1, 7)}
        for row in stale:
            for name in ("x3", "y3", "z3"):
                columns[name][row] = columns[name][row - 1]
        columns = {name: column for name, column in columns.items() if name not in without}
        table = np.stack(list(columns.values()), axis=1)
        np.savetxt(tmp_path / "trunk.csv", table, "%.9g", ",", header=",".join(columns), comments="")
        return tmp_path / "trunk.csv"

    return write


def test_trunk_planted_faults(trunk_file):
    log, findings = read_trunk(trunk_file(turned=(30, 31), stale=(10, 59)))
    assert np.flatnonzero(~log.fresh).tolist() == [10, 59]
    assert np.flatnonzero(np.isnan(log.quaternion[:, 2, 0])).tolist() == [30, 31]
    faults = [(f.column, f.rows, f.n_dropped) for f in findings]
    assert faults == [("body 2", (12, 61), 2), ("body 2 quaternion", (32, 33), 0)]
    np.testing.assert_allclose(log.quaternion[:, 0], quaternions(60)[:, [3, 0, 1, 2]], atol=1e-8)
    np.testing.assert_allclose(log.motor_deg.mean(axis=0), 10.0 * np.arange(1, 7), atol=0.5)
    np.testing.assert_allclose(log.position_m.mean(axis=0), np.outer([1, 2, 3], np.ones(3)), atol=0.01)


def test_files_that_are_not_such_logs(asu_file, trunk_file, tmp_path):
    with pytest.raises(LogError, match="trunk.csv: line 1: y2, w3: got"):
        read_trunk(trunk_file(without=("y2", "w3")))
    with pytest.raises(LogError, match="line 1: .*got no such columns, expected a log of the trunk"):
        read_trunk(asu_file())
    with pytest.raises(LogError, match="trunk.csv: line 1: got 28 cells, expected 38"):
        read_asu(trunk_file())
    with pytest.raises(LogError, match="asu.txt: line 8: measured0: 1 x NaN or inf"):
        read_asu(asu_file(cell=(7, 4)))
    with pytest.raises(LogError, match="no.txt: got .No such file"):
        read_asu(tmp_path / "no.txt")
