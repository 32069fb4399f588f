"""Readers of public logs: their columns and units, and what detectors and fits find in the real ones."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration import logs
from benchmarks.calibration.logs import read_asu, read_trunk
from mjx_softarm.logs import checks
from mjx_softarm.logs.checks import LogError

DATA = Path(__file__).parents[3].parent / "shared/data"
real = pytest.mark.skipif(not DATA.is_dir(), reason="the real logs are not beside the checkout")
PSI = 6.894757293


@real
@pytest.mark.parametrize(("number", "n_rows", "n_stale"), [(1, 15_001, 14), (11, 6_001, 281)])
def test_real_trunk(number, n_rows, n_stale):
    path = DATA / f"asl_trunk/observations_controlled_{number}.csv"
    log, raw = read_trunk(path), np.genfromtxt(path, delimiter=",", names=True)
    assert len(log.fresh) == n_rows and np.count_nonzero(~log.fresh) == n_stale
    np.testing.assert_array_equal(log.position_m[:, 2, 1], raw["y3"])
    np.testing.assert_array_equal(log.motor_deg[:, 4], raw["phi5"])


@real
def test_real_trunk_turned_tip():
    log = read_trunk(DATA / "asl_trunk/observations_controlled_11.csv")
    assert [np.count_nonzero(checks.turned_rows(log.quaternion[:, k])) > 0 for k in range(3)] == [0, 1, 1]
    turned = checks.turned_rows(log.quaternion[:, 2])
    assert np.count_nonzero(turned) == 51
    kept, _ = checks.same_sign(log.quaternion[~turned, 2])  # one continuous motion
    assert ((kept[1:] * kept[:-1]).sum(axis=1) > np.cos(np.radians(15.0))).all()
    assert read_trunk(DATA / "asl_trunk/observations_controlled_1.csv").quaternion is None


@real
@pytest.mark.parametrize(
    ("name", "n_rows", "share", "jumps"),
    [("apr5", 4_338, 0.70, (0, 0, 40)), ("apr4", 1_773, 0.59, (0, 6, 298))],
)
def test_real_asu(name, n_rows, share, jumps):
    path = DATA / f"asu_softarm/{name}_data_collect_1.txt"
    log, raw = read_asu(path), np.loadtxt(path, delimiter=",")
    assert len(log.fresh) == n_rows and np.mean(~log.fresh) == pytest.approx(share, abs=0.005)
    for body, n_jumps in enumerate(jumps):
        turned = checks.turned_rows(log.quaternion[:, body])
        assert np.count_nonzero(np.diff(turned.astype(int))) == n_jumps and np.mean(turned) < 0.5
        kept, _ = checks.same_sign(log.quaternion[~turned, body])
        assert ((kept[1:] * kept[:-1]).sum(axis=1) > 0.9).all()
    np.testing.assert_allclose(log.pressure_kpa / PSI, raw[:, [4, 5, 6, 10, 11, 12]], rtol=1e-9)
    # The wires of section 1 move as the distance of base and middle.
    slope, _ = np.polyfit(log.wire_m[log.fresh, :2].mean(axis=1), log.section_m[log.fresh], 1)
    assert 0.8 < slope < 1.1 and (np.diff(log.time_s) > 0.0).all()


@real
def test_real_motion_has_next_to_no_outliers():
    """The detector of `read_log`, on step responses and on fast swings: positions, pressures, draw-wires."""
    for name in logs.ASU_LOGS.values():
        log = read_asu(DATA / name)
        columns = [*log.position_m[log.fresh].reshape(-1, 9).T, *log.wire_m.T]
        assert sum(np.count_nonzero(checks.outlier_rows(column, 2e-3)) for column in columns) <= 1
        assert sum(np.count_nonzero(checks.outlier_rows(column, 10.0)) for column in log.pressure_kpa.T) == 0
    for number in (1, 11):
        log = read_trunk(DATA / logs.TRUNK_LOG.format(number))
        tip = log.position_m[log.fresh, 2]
        assert not any(checks.outlier_rows(tip[:, axis], 2e-3).any() for axis in range(3))


@real
@pytest.mark.parametrize(("name", "wire_mm"), [("apr5", 0.62), ("apr4", 0.25)])
def test_real_draw_wires(name, wire_mm):
    assert logs.wires(DATA, name)["fresh rows at rest"] <= wire_mm


def asu_table(n=60):
    """Column k of pressures and wires is about k; the bodies hang one below the other."""
    rng = np.random.default_rng(0)
    table = np.zeros((n, 38))
    table[:, 0] = 0.01 * np.arange(n)
    table[:, 1:17] = np.arange(1, 17) + 0.01 * rng.standard_normal((n, 16))
    for body in range(3):
        table[:, 17 + 7 * body : 20 + 7 * body] = -0.1 * body + 0.001 * rng.standard_normal((n, 3))
        table[:, 20 + 7 * body : 24 + 7 * body] = [0.0, 0.6, 0.0, 0.8]
    return table


def save(path, table, names=()):
    np.savetxt(path, table, "%.9g", ",", header=",".join(names), comments="")
    return path


def test_asu_columns_and_stale_rows(tmp_path):
    table = asu_table()
    table[[5, 50], 17:] = table[[4, 49], 17:]
    np.savetxt(path := tmp_path / "asu.txt", table, "%.9g", ", ")
    log = read_asu(path)
    assert np.flatnonzero(~log.fresh).tolist() == [5, 50]
    np.testing.assert_allclose(log.pressure_kpa.mean(axis=0) / PSI, [4, 5, 6, 10, 11, 12], atol=0.01)
    np.testing.assert_allclose(log.wire_m.mean(axis=0), np.arange(13, 17) / 5.0, atol=0.01)
    np.testing.assert_allclose(log.position_m.mean(axis=0), [[0.0] * 3, [-0.1] * 3, [-0.2] * 3], atol=0.001)
    np.testing.assert_array_equal(log.quaternion[0], [[0.8, 0.0, 0.6, 0.0]] * 3)
    np.testing.assert_allclose(log.section_m, 0.1 * np.sqrt(3.0), atol=0.01)


def trunk_columns(n=60):
    rng = np.random.default_rng(0)
    columns = {"ID": np.arange(n)}
    for disk in (1, 2, 3):
        columns |= {f"{axis}{disk}": disk + 0.01 * rng.standard_normal(n) for axis in "xyz"}
        columns |= {
            f"{part}{disk}": np.full(n, q)
            for part, q in zip(("qx", "qy", "qz", "w"), (0, 0.6, 0, 0.8), strict=True)
        }
    return columns | {f"phi{k}": 10.0 * k + rng.standard_normal(n) for k in range(1, 7)}


def test_trunk_columns_and_stale_rows(tmp_path):
    columns = trunk_columns()
    for name in ("x3", "y3", "z3"):
        columns[name][10] = columns[name][9]
    log = read_trunk(save(tmp_path / "trunk.csv", np.stack(list(columns.values()), axis=1), columns))
    assert np.flatnonzero(~log.fresh).tolist() == [10]
    np.testing.assert_array_equal(log.quaternion[0], [[0.8, 0.0, 0.6, 0.0]] * 3)
    np.testing.assert_allclose(log.motor_deg.mean(axis=0), 10.0 * np.arange(1, 7), atol=0.5)
    np.testing.assert_allclose(log.position_m.mean(axis=0), np.outer([1, 2, 3], np.ones(3)), atol=0.01)


def test_files_that_are_not_such_logs(tmp_path):
    columns = {name: x for name, x in trunk_columns().items() if name not in ("y2", "w3")}
    trunk = save(tmp_path / "trunk.csv", np.stack(list(columns.values()), axis=1), columns)
    with pytest.raises(LogError, match="trunk.csv: line 1: y2, w3: got no such columns, expected"):
        read_trunk(trunk)
    with pytest.raises(LogError, match="trunk.csv: line 1: got 26 cells, expected 38"):
        read_asu(trunk)
    table = asu_table()
    table[7, 4] = np.nan
    with pytest.raises(LogError, match="asu.txt: line 8: measured0: got nan, expected a finite number"):
        read_asu(save(tmp_path / "asu.txt", table))
    with pytest.raises(LogError, match="no.txt: got .No such file"):
        read_asu(tmp_path / "no.txt")
