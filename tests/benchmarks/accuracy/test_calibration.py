"""Readers of public logs, what detectors and fits find in the real ones; the planted arm."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.accuracy import calibration as logs
from benchmarks.accuracy.calibration import planted_arm, read_asu, read_trunk
from mjx_softarm.logs import checks

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
    assert logs.wires_error(DATA, name) <= wire_mm


@pytest.mark.slow
def test_numbers_of_a_planted_arm_are_identified():
    errors = planted_arm()
    assert errors["beta, largest error [%]"] < 0.5 and errors["stiffness, largest error [%]"] < 5.0
    assert 3.0 * errors["tip at held-out poses, calibrated"] < errors["tip at held-out poses, before"]
