"""The law that holds references: its way there in closed form, and when it calls the springs held."""

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.control import Gains
from mjx_softarm.deploy.drive import HELD_M, MEAN_S, RAMP_M_PER_S, Hold

DT_S = 0.02
GAINS = Gains.from_spec(ArmSpec.default())
START_M = np.array([0.2, 0.15, 0.18])
GOAL_M = np.array([0.26, 0.15, 0.15])


def test_references_go_there_in_step_at_the_speed_of_the_one_with_the_longest_way():
    law, spring_m = Hold(GAINS, GOAL_M, DT_S), START_M
    n_ticks = round(0.06 / (RAMP_M_PER_S * DT_S))  # 60 mm
    for k in range(1, n_ticks + 1):
        _, arrived = law(spring_m, np.zeros(3))
        np.testing.assert_allclose(law.reference_m, START_M + k / n_ticks * (GOAL_M - START_M), atol=1e-12)
        assert not arrived
        spring_m = law.reference_m
    np.testing.assert_allclose(law.reference_m, GOAL_M, atol=1e-12)


def test_held_is_what_is_on_average_on_its_reference():
    """A spring that is off by e all the time is off on average by e exp(-t / MEAN_S) after it came there."""
    law = Hold(GAINS, START_M, DT_S)
    law(START_M + 5e-3, np.zeros(3))
    arrived = [law(START_M, np.zeros(3))[1] for _ in range(100)]
    # It starts 5 mm off; each tick leaves 1 - dt / MEAN_S of that.
    expected = np.log(HELD_M / 5e-3) / np.log(1.0 - DT_S / MEAN_S)
    assert arrived.index(True) + 1 == pytest.approx(expected, abs=1.0)
    assert all(arrived[arrived.index(True) :])
    assert not law(START_M + 2e-3, np.zeros(3))[1]


def test_lost_reading_changes_nothing():
    law, in_force_kpa = Hold(GAINS, GOAL_M, DT_S), np.array([3.0, -7.0, 1.0])
    law(START_M, in_force_kpa)
    before = law.reference_m
    pressure_kpa, arrived = law(None, in_force_kpa)
    np.testing.assert_array_equal(pressure_kpa, in_force_kpa)
    assert not arrived and law.reference_m is before
