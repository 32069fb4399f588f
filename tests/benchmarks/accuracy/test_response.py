"""The response of a section, on a planted one."""

import numpy as np

from benchmarks.accuracy.response import fit_response


def steps(n=600, dt_s=0.05, seed=0):
    """Times, and pressures of three chambers [kPa] that step every three seconds."""
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.uniform(0.5 * dt_s, 1.5 * dt_s, n))
    levels = rng.uniform(0.0, 100.0, (n, 3))
    return time_s, levels[(time_s // 3).astype(int)]


def by_hand(taus_s, play_kpa, polynomial, time_s, pressure_kpa):
    drive = pressure_kpa.mean(axis=1)
    lagged, held, lengths = drive[0], drive[0] - play_kpa, []
    for k, now in enumerate(drive):
        step = time_s[k] - time_s[k - 1] if k else 0.0
        lagged = now + (lagged - now) * np.exp(-step / taus_s[0 if now > lagged else 1])
        held = min(max(held, lagged - play_kpa), lagged + play_kpa)
        lengths.append(np.polyval(polynomial, held))
    return np.array(lengths)


def test_planted_section_comes_back():
    time_s, pressure = steps()
    truth = by_hand((0.4, 1.5), 6.0, (-1e-6, 6e-4, 0.15), time_s, pressure)
    length = truth + 2e-4 * np.random.default_rng(1).standard_normal(len(truth))
    length[100:110] = np.nan
    fit = fit_response(time_s, pressure, length)
    np.testing.assert_allclose([fit.tau_fill_s, fit.tau_vent_s], [0.4, 1.5], rtol=0.03)
    np.testing.assert_allclose(fit.play_kpa, 6.0, atol=0.5)
    assert np.sqrt(np.mean((fit.held_out_m - truth) ** 2)) < 1.5e-4
    assert np.sqrt(np.mean((fit.line_held_out_m - truth) ** 2)) > 2e-3
