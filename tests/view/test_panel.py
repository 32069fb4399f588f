"""Looks of a log, and the bars against what they show."""

from types import SimpleNamespace

import numpy as np
import pytest

from mjx_softarm.logs.checks import LogError
from mjx_softarm.logs.schema import Log
from mjx_softarm.view.look import look_at, looks
from tests.linear_arm import HIGH_KPA, REST_M, SENSOR, SPEC, N


@pytest.fixture
def panel():
    return pytest.importorskip("mjx_softarm.view.panel", reason="needs viser", exc_type=ImportError)


def test_saturated_chambers_are_found_and_marked(panel):
    kpa, reference_m = np.zeros(N), np.full(N, REST_M)
    kpa[[2, 7]] = HIGH_KPA - 0.1  # as measured
    reference_m[2] += 0.01  # chamber 7 is on its reference
    row = {"time_s": 0.0, "pressure_kpa": kpa, "reference_m": reference_m}
    look = look_at(row, np.full(N, REST_M), SPEC)
    assert np.flatnonzero(look.saturated).tolist() == [2]
    assert not look_at(row, np.full(N, REST_M), SPEC, tolerance_m=0.02).saturated.any()
    drawn = panel.bars(look, SPEC)
    assert "saturated: chamber 2<" in drawn and drawn.count(panel.css((226, 38, 77))) == 3
    assert "-10.0</text>" in drawn
    nothing = look_at({"time_s": 0.0}, np.full(N, np.nan), SPEC)
    assert "nan" not in panel.bars(nothing, SPEC)


def test_the_payload_that_the_loop_believes_is_told(panel):
    shown, row = SimpleNamespace(), {"time_s": 0.0, "estimate": np.zeros(6), "goal": np.zeros(6)}
    for known, words in (({}, ""), ({"load_kg": 0.412}, "payload <b>412 g</b>")):
        look = look_at(row | known, np.full(N, REST_M), SPEC)
        panel.Panel.show_text(SimpleNamespace(_text=shown), "The arm holds", "", look, ["<try>"])
        assert "&lt;try&gt;" in shown.content and words in shown.content
        assert bool(words) == ("payload" in shown.content)


def test_looks_of_a_log():
    spring_m = np.linspace(0.18, 0.22, 4)[:, None] * np.ones(N)
    readings = SENSOR.readings(spring_m)
    readings[1, 3] = np.nan
    log = Log("x.csv", np.arange(2, 6), np.arange(4.0), readings=readings, goal=np.zeros((4, 6)))
    at = looks(log, SPEC)
    np.testing.assert_allclose(at(2).spring_m, spring_m[2])
    assert np.flatnonzero(np.isnan(at(1).spring_m)).tolist() == [3]
    assert at(2).time_s == 2.0 and not at(2).goal.any()
    assert np.isnan(at(2).load_kg) and np.isnan(at(2).estimate).all()
    with pytest.raises(LogError, match=r"x\.csv: got neither frequency0\.\. nor spring0\.\., expected"):
        looks(Log("x.csv", np.arange(2, 6), np.arange(4.0)), SPEC)
