"""Real logs: their readers, what detectors and fits find in them; the planted arm."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.accuracy import calibration as logs
from benchmarks.accuracy.calibration import planted_arm, read_asu, read_trunk
from mjx_softarm.logs import checks

DATA = Path(__file__).parents[3].parent / "shared/data"
real = pytest.mark.skipif(not DATA.is_dir(), reason="the real logs are not beside the checkout")
PSI_KPA = 6.894757293


def assert_one_motion(quaternion, least):
    """Once they have one sign, quaternions (n, 4) change little from row to row."""
    kept, _ = checks.same_sign(quaternion)
    assert ((kept[1:] * kept[:-1]).sum(axis=1) > least).all()


@real
@pytest.mark.parametrize(("number", "n_rows", "n_stale"), [(1, 15_001, 14), (11, 6_001, 281)])
def test_real_trunk(number, n_rows, n_stale):
    log = read_trunk(DATA / logs.TRUNK_LOG.format(number))
    assert len(log.fresh) == len(log.motor_deg) == n_rows and np.count_nonzero(~log.fresh) == n_stale


@real
def test_real_trunk_turned_tip():
    table = np.genfromtxt(DATA / logs.TRUNK_LOG.format(11), delimiter=",", names=True)
    parts = [table[f"{part}{disk}"] for disk in (1, 2, 3) for part in ("w", "qx", "qy", "qz")]
    quaternion = np.stack(parts, axis=1).reshape(-1, 3, 4)
    turned = [checks.turned_rows(quaternion[:, k]) for k in range(3)]
    assert [np.count_nonzero(rows) > 0 for rows in turned] == [0, 1, 1]
    assert np.count_nonzero(turned[2]) == 51
    assert_one_motion(quaternion[~turned[2], 2], np.cos(np.radians(15.0)))


@real
@pytest.mark.parametrize(
    ("name", "n_rows", "share", "jumps"),
    [("apr5", 4_338, 0.70, (0, 0, 40)), ("apr4", 1_773, 0.59, (0, 6, 298))],
)
def test_real_asu(name, n_rows, share, jumps):
    log, raw = read_asu(DATA / logs.ASU_LOGS[name]), np.loadtxt(DATA / logs.ASU_LOGS[name], delimiter=",")
    assert len(log.fresh) == n_rows and np.mean(~log.fresh) == pytest.approx(share, abs=0.005)
    quaternion = raw[:, 17:].reshape(-1, 3, 7)[..., [6, 3, 4, 5]]
    for body, n_jumps in enumerate(jumps):
        turned = checks.turned_rows(quaternion[:, body])
        assert np.count_nonzero(np.diff(turned.astype(int))) == n_jumps and np.mean(turned) < 0.5
        assert_one_motion(quaternion[~turned, body], 0.9)
    # The wires of section 1 move as the distance of base and middle.
    slope, _ = np.polyfit(log.wire_m[log.fresh], log.section_m[log.fresh], 1)
    assert 0.8 < slope < 1.1 and (np.diff(log.time_s) > 0.0).all()


@real
def test_real_motion_has_next_to_no_outliers():
    """The detector of `read_log`, on step responses and on fast swings: positions, pressures, draw-wires."""
    for name in logs.ASU_LOGS.values():
        raw, fresh = np.loadtxt(DATA / name, delimiter=","), read_asu(DATA / name).fresh
        positions_m = raw[fresh, 17:].reshape(-1, 3, 7)[..., :3].reshape(-1, 9)
        columns = [*positions_m.T, *(logs.WIRE_M_PER_V * raw[:, 13:17]).T]
        assert sum(np.count_nonzero(checks.outlier_rows(column, 2e-3)) for column in columns) <= 1
        pressure_kpa = PSI_KPA * raw[:, [4, 5, 6, 10, 11, 12]]
        assert sum(np.count_nonzero(checks.outlier_rows(column, 10.0)) for column in pressure_kpa.T) == 0
    for number in (1, 11):
        log = read_trunk(DATA / logs.TRUNK_LOG.format(number))
        tip_m = log.tip_m[log.fresh]
        assert not any(checks.outlier_rows(tip_m[:, axis], 2e-3).any() for axis in range(3))


@real
@pytest.mark.parametrize(("name", "wire_mm"), [("apr5", 0.62), ("apr4", 0.25)])
def test_real_draw_wires(name, wire_mm):
    assert logs.wires_error(DATA, name) <= wire_mm


@pytest.mark.slow
def test_numbers_of_a_planted_arm_are_identified():
    errors = planted_arm()
    assert errors["beta, largest error [%]"] < 0.5 and errors["stiffness, largest error [%]"] < 5.0
    assert 3.0 * errors["tip at held-out poses, calibrated"] < errors["tip at held-out poses, before"]
