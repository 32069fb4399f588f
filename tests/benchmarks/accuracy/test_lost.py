"""Runs without a chamber: goals that are reached, refused or missed, and chambers that are told."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.accuracy import lost
from mjx_softarm.deploy.safety import Fault, names
from mjx_softarm.policy.file import SHIPPED


@pytest.mark.parametrize(
    ("told", "text", "rightly"),
    [((3,), "chamber3", True), ((3, 4), "chamber3, chamber4", False), ((), "none", False)],
)
def test_goals_count_by_motion_capture_and_a_chamber_by_its_name(monkeypatch, told, text, rightly):
    asked = []

    def follow(arm, controller, goals, tell):
        asked.append((arm, controller.config.go_on))
        if told:
            mask = np.isin(np.arange(9), told)
            tell(f"3.2 s: chamber lost its pressure: why -> go on without {names('chamber', mask)}")
        ending = SimpleNamespace(cause="a second chamber")
        return SimpleNamespace(ending=ending, counts=lambda: {Fault.GOAL_OUTSIDE: 1})

    error = np.zeros((5, 6))
    error[:, 0] = 2.0, 4.0, 60.0, np.nan, np.nan  # two reached, one missed, one refused, one not tried
    monkeypatch.setattr(lost, "follow", follow)
    monkeypatch.setattr(lost, "open_arm", lambda name: name)
    monkeypatch.setattr(lost, "accuracy", lambda *at: SimpleNamespace(error=error))
    monkeypatch.setattr(lost, "read_goals", lambda name, policy, n: np.asarray(policy.workspace[:5], float))
    found = lost.measure((f"twin:5={SHIPPED}",), chambers=(3,), points=5)
    [row] = found["runs"]
    assert asked == [("twin:5:lost3", True)]
    assert (row["told"], row["told rightly"], row["ended by"]) == (text, rightly, "a second chamber")
    assert (row["reached"], row["refused"], row["mean [mm]"]) == (0.4, 0.2, 22.0)
    assert [item["verdict"] for item in found["targets"]] == ["NOT MET"] * 2 + (
        ["met"] if rightly else ["NOT MET"]
    )
