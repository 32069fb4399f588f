"""Pumps, regulators and air in the chambers against hand calculations."""

import dataclasses

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.pneumatics import ATMOSPHERE_KPA, PAPER_PUMP, Pneumatics, Pump, Regulator

AREA_M2, SLOPE_M, REST_M, DT_S = 1.62e-3, -4.06e-3, 0.2, 0.001
REGULATOR = Regulator(0.5, 0.2, fill_kpa_per_s=50.0, vent_kpa_per_s=20.0, deadband_kpa=0.3)


def air(n=9, length_m=0.2, actuators=PAPER_PUMP):
    bellows = np.full(n, AREA_M2), np.full(n, SLOPE_M), REST_M
    return Pneumatics(*bellows, np.full(n, length_m), DT_S, actuators)


def stepped(system, time_s):
    """Pressures (steps, n) at lengths of 0.2 m."""
    return np.array([system.step(np.full(9, 0.2)).copy() for _ in range(round(time_s / DT_S))])


@pytest.mark.parametrize("n_filled", [1, 9])
@pytest.mark.parametrize("target_kpa", [20.0, -40.0])
def test_pump_fills_as_fast_as_by_hand(n_filled, target_kpa):
    """12 L/min into each 0.324 L chamber held at its length: half of the way after V p / (2 p_atm) / Q."""
    system = air()
    system.command(np.where(np.arange(9) < n_filled, target_kpa, 0.0))
    half_s = (1.62e-3 * 0.2) * 0.5 * abs(target_kpa) / 101.325 / (12e-3 / 60)
    track = stepped(system, half_s + PAPER_PUMP.valve_s)
    np.testing.assert_allclose(track[-1][:n_filled], 0.5 * target_kpa, rtol=0.03)
    np.testing.assert_array_equal(track[-1][n_filled:], 0.0)


def test_valve_answers_after_its_dead_time():
    system = air()
    system.command(np.full(9, -5.0))
    track = stepped(system, 0.02)
    np.testing.assert_array_equal(track[:10], 0.0)  # 10 ms, as in the paper
    assert (track[10:] < 0.0).all()


def test_volume_grows_by_the_effective_area():
    length_m, h = np.linspace(0.1, 0.27, 9), 1e-6
    system = air(length_m=0.2)
    slope = (system.volume_m3(length_m + h) - system.volume_m3(length_m - h)) / (2 * h)
    np.testing.assert_allclose(slope, AREA_M2 + SLOPE_M * (length_m - REST_M), rtol=1e-8)
    np.testing.assert_allclose(system.volume_m3(np.full(9, 0.2)), AREA_M2 * 0.2)


@pytest.mark.parametrize("actuators", [Pump(1e-30, 0.01), dataclasses.replace(REGULATOR, deadband_kpa=50.0)])
def test_chamber_cut_off_from_its_actuator_follows_boyle(actuators):
    system = air(actuators=actuators)
    before = system.volume_m3(np.full(9, 0.2))
    after = system.volume_m3(np.full(9, 0.17))
    pressure = ATMOSPHERE_KPA + system.step(np.full(9, 0.17))
    np.testing.assert_allclose(pressure * after, ATMOSPHERE_KPA * before)


def test_regulator_waits_then_goes_at_its_rate_then_decays_to_its_deadband():
    """By hand: at the rate r until the lag T asks for less, e = r T, then exp(-t / T) to the deadband."""
    system, sign = air(actuators=REGULATOR), np.where(np.arange(9) < 5, 1.0, -1.0)
    system.command(30.0 * sign)
    track = stepped(system, 6.0) * sign
    np.testing.assert_array_equal(track[:200], 0.0)
    for chamber, rate in ((0, 50.0), (8, 20.0)):
        limited_s = (29.7 - rate * 0.5) / rate
        time_s = np.arange(1, len(track) - 199) * DT_S
        late = 29.7 - rate * 0.5 * np.exp(-(time_s - limited_s) / 0.5)
        by_hand = np.where(time_s < limited_s, rate * time_s, late)
        np.testing.assert_allclose(track[200:, chamber], by_hand, atol=0.05)


def test_regulator_brings_back_the_pressure_of_a_chamber_that_was_pressed():
    system = air(actuators=dataclasses.replace(REGULATOR, offset_kpa=2.0))
    system.hold(np.full(9, 10.0), np.full(9, 0.2))
    pressed = system.step(np.full(9, 0.19)).copy()
    assert (pressed > 14.0).all()
    for _ in range(6000):
        system.step(np.full(9, 0.19))
    np.testing.assert_allclose(system.pressure_kpa, 10.3, atol=1e-3)


def test_each_chamber_has_its_own_dead_time():
    dead_time_s = np.linspace(0.0, 0.08, 9)
    system = air(actuators=dataclasses.replace(REGULATOR, dead_time_s=dead_time_s))
    system.command(np.full(9, 5.0))
    first = np.argmax(stepped(system, 0.1) > 0.0, axis=0)
    np.testing.assert_array_equal(first, np.round(dead_time_s / DT_S))


def test_an_arm_s_chambers_have_their_own_areas():
    areas = tuple(np.linspace(1e-3, 2e-3, 9))
    spec = ArmSpec.default().replace(
        chambers={"area_m2": areas, "area_slope_m": SLOPE_M}, geometry={"section_length_m": (0.2, 0.1, 0.3)}
    )
    length_m = np.full(9, 0.25)
    rest_m = np.repeat([0.2, 0.1, 0.3], 3)
    expected = np.array(areas) * length_m + 0.5 * SLOPE_M * (length_m - rest_m) ** 2
    np.testing.assert_allclose(spec.pneumatics(length_m, DT_S).volume_m3(length_m), expected)
