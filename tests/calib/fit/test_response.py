from pathlib import Path

import numpy as np
import pytest

from calib.fit.response import Response, fit_response, simulate

DATA = Path(__file__).parents[3].parent / "shared/data/asu_softarm"


def steps(n=600, dt_s=0.05, seed=0):
    """Times, and pressures of three chambers [kPa] that step every three seconds."""
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.uniform(0.5 * dt_s, 1.5 * dt_s, n))
    levels = rng.uniform(0.0, 100.0, (n, 3))
    return time_s, levels[(time_s // 3).astype(int)]


def by_hand(response, time_s, pressure_kpa):
    drive = pressure_kpa.mean(axis=1)
    lagged, held, lengths = drive[0], drive[0] - response.play_kpa, []
    for k, now in enumerate(drive):
        step = time_s[k] - time_s[k - 1] if k else 0.0
        tau = response.tau_fill_s if now > lagged else response.tau_vent_s
        lagged = now + (lagged - now) * np.exp(-step / tau)
        held = min(max(held, lagged - response.play_kpa), lagged + response.play_kpa)
        c0, c1, c2 = response.length_m
        lengths.append(c0 + c1 * held + c2 * held**2)
    return np.array(lengths)


PLANTED = Response(0.4, 1.5, 6.0, np.array([0.15, 6e-4, -1e-6]))


def test_planted_section_comes_back():
    time_s, pressure = steps()
    rng = np.random.default_rng(1)
    truth = by_hand(PLANTED, time_s, pressure)
    np.testing.assert_allclose(simulate(PLANTED, time_s, pressure), truth, rtol=1e-12)
    length = truth + 2e-4 * rng.standard_normal(len(truth))
    length[100:110] = np.nan
    fit = fit_response(time_s, pressure, length)
    got = fit.response
    np.testing.assert_allclose([got.tau_fill_s, got.tau_vent_s], [0.4, 1.5], rtol=0.03)
    np.testing.assert_allclose(got.play_kpa, 6.0, atol=0.5)
    np.testing.assert_allclose(simulate(got, time_s, pressure), truth, atol=3e-4)
    assert 1.8e-4 < fit.rms_m < 2.2e-4 and fit.held_out_rms_m < 2.5e-4 and fit.n_rows == 590
    assert fit.warnings == ()


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no logs of the two-section arm in {DATA}")
@pytest.mark.parametrize(("name", "line_mm"), [("apr5", 4.45), ("apr4", 5.04)])
def test_real_section_is_twice_as_good_as_a_line(name, line_mm):
    from calib.read.adapters import read_asu

    log, _ = read_asu(DATA / f"{name}_data_collect_1.txt")
    rows = log.fresh
    length_m = np.linalg.norm(log.position_m[:, 1] - log.position_m[:, 0], axis=1)
    fit = fit_response(log.time_s[rows], log.pressure_kpa[rows, :3], length_m[rows])
    assert 1e3 * fit.line_held_out_rms_m == pytest.approx(line_mm, rel=0.02)
    assert fit.held_out_rms_m < fit.line_held_out_rms_m / 2
    assert 0.3 < fit.response.tau_fill_s < 2.0 and 0.3 < fit.response.tau_vent_s < 2.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, p, x: (t[::-1], p, x), "time_s row 1: .* expected a time after the row before"),
        (lambda t, p, x: (t, np.where(p == p[3], np.nan, p), x), "pressure_kpa row 0: .* finite numbers"),
        (lambda t, p, x: (t, p, x[:5]), r"expected \(600, n_chambers\) and \(600,\)"),
        (lambda t, p, x: (t, p, x * np.nan), "got 0 measured lengths"),
        (lambda t, p, x: (t, 0 * p, x), "never change"),
    ],
)
def test_refuses(change, message):
    time_s, pressure = steps()
    with pytest.raises(ValueError, match=message):
        fit_response(*change(time_s, pressure, pressure[:, 0] * 1e-3))
