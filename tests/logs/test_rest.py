"""Cutting of logs into holds of pressures."""

import numpy as np

from mjx_softarm.logs.rest import HOLD_KPA, MIN_HOLD_S, holds


def test_a_hold_ends_with_its_pressures_at_a_gap_and_with_its_payload():
    time_s = 0.02 * np.arange(44) + (MIN_HOLD_S + 1.0) * (np.arange(44) >= 20)
    pressure_kpa = np.where(np.arange(44) < 10, -20.0, -10.0)[:, None]
    pressure_kpa = pressure_kpa + np.random.default_rng(2).uniform(-0.4, 0.4, (44, 9)) * HOLD_KPA
    pressure_kpa[30:, 3] = -10.0 + HOLD_KPA * np.maximum(np.arange(14) - 10.0, 0.0)  # creeps away
    payload_kg = np.where(np.arange(44) < 30, 0.0, 0.1)
    expected = [(0, 10), (10, 20), (20, 30), (30, 42), (42, 44)]
    assert holds(time_s, pressure_kpa, payload_kg) == expected
    assert holds(time_s[:0], pressure_kpa[:0], payload_kg[:0]) == []
