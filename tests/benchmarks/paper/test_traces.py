"""Traces of an arm on the circle: how long chambers are at limits, and a panel for each quantity and load."""

import numpy as np
import pytest

from benchmarks.paper import traces
from mjx_softarm import ArmSpec
from mjx_softarm.logs.schema import Log

SPEC = ArmSpec.default()


@pytest.fixture(scope="module")
def log():
    """Four ticks; chamber 3 is at its lower limit in one of them, and each spring 2 mm off its reference."""
    pressure_kpa = np.zeros((4, SPEC.n_chambers))
    pressure_kpa[2, 3] = SPEC.chambers.pressure_min_kpa
    reference_m = np.full((4, SPEC.n_springs), 0.18)
    lengths = {
        "readings": 3e6 + 1e9 * reference_m,
        "spring_m": reference_m + 2e-3,
        "reference_m": reference_m,
    }
    return Log("made up", np.arange(4), np.arange(4) / 50.0, pressure_kpa=pressure_kpa, **lengths)


def test_a_lap_tells_its_chambers_at_limits_and_how_far_springs_are_off(log):
    assert traces.shares(log, SPEC) == {
        "time with a chamber at a limit [%]": 25.0,
        "chambers at a limit": "3",
        "springs off their references, mean [mm]": 2.0,
    }


def test_each_quantity_has_a_panel_for_each_load(log):
    figure = traces.traces_figure({0: log, 500: log}, SPEC)
    assert len(figure.axes) == 6
    lengths, pressures = figure.axes[2], figure.axes[4]
    assert len(lengths.lines) == 2 * SPEC.n_springs  # with their references
    assert len(pressures.lines) == SPEC.n_chambers + 2  # with the limits
    assert len({line.get_color() for line in pressures.lines}) == SPEC.n_chambers + 1
    assert figure.axes[1].get_title(loc="left").startswith("500 g")
