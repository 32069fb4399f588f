"""Pumps, valves and air in the chambers against hand calculations."""

import numpy as np
import pytest

from mjx_softarm import pneumatics
from mjx_softarm.pneumatics import ATMOSPHERE_KPA, VALVE_S
from mjx_softarm.twin.pneumatics import Pneumatics

AREA_M2, SLOPE_M, REST_M, DT_S = 1.62e-3, -4.06e-3, 0.2, 0.001


def air(n=9, length_m=0.2):
    return Pneumatics(np.full(n, AREA_M2), np.full(n, SLOPE_M), REST_M, np.full(n, length_m), DT_S)


@pytest.mark.parametrize("n_filled", [1, 9])
@pytest.mark.parametrize("target_kpa", [20.0, -40.0])
def test_pump_fills_as_fast_as_by_hand(n_filled, target_kpa):
    """12 L/min into each 0.324 L chamber held at its length: half of the way after V p / (2 p_atm) / Q."""
    system = air()
    system.command(np.where(np.arange(9) < n_filled, target_kpa, 0.0))
    half_s = (1.62e-3 * 0.2) * 0.5 * abs(target_kpa) / 101.325 / (12e-3 / 60)
    track = [system.step(np.full(9, 0.2)).copy() for _ in range(round((half_s + VALVE_S) / DT_S))]
    np.testing.assert_allclose(track[-1][:n_filled], 0.5 * target_kpa, rtol=0.03)
    np.testing.assert_array_equal(track[-1][n_filled:], 0.0)


def test_valve_answers_after_its_dead_time():
    system = air()
    system.command(np.full(9, -5.0))
    track = np.array([system.step(np.full(9, 0.2)).copy() for _ in range(20)])
    np.testing.assert_array_equal(track[:10], 0.0)  # 10 ms, as in the paper
    assert (track[10:] < 0.0).all()


def test_pressures_arrive_and_stay():
    system, target_kpa = air(), np.linspace(-40.0, 20.0, 9)
    system.command(target_kpa)
    for _ in range(8000):
        system.step(np.full(9, 0.2))
    np.testing.assert_allclose(system.pressure_kpa, target_kpa, atol=1e-9)


def test_volume_grows_by_the_effective_area():
    length_m, h = np.linspace(0.1, 0.27, 9), 1e-6
    system = air(length_m=0.2)
    slope = (system.volume_m3(length_m + h) - system.volume_m3(length_m - h)) / (2 * h)
    np.testing.assert_allclose(slope, AREA_M2 + SLOPE_M * (length_m - REST_M), rtol=1e-8)
    np.testing.assert_allclose(system.volume_m3(np.full(9, 0.2)), AREA_M2 * 0.2)


def test_chamber_cut_off_from_the_pump_follows_boyle(monkeypatch):
    monkeypatch.setattr(pneumatics, "PUMP_M3_PER_S", 0.0)
    system = air()
    before = system.volume_m3(np.full(9, 0.2))
    after = system.volume_m3(np.full(9, 0.17))
    pressure = ATMOSPHERE_KPA + system.step(np.full(9, 0.17))
    np.testing.assert_allclose(pressure * after, ATMOSPHERE_KPA * before)
