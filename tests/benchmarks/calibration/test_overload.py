"""False overloads of arms with their largest payload."""

import numpy as np
import pytest

from benchmarks.calibration import overload
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.ending import Ending, LoopRun
from mjx_softarm.deploy.safety import Event, Fault
from mjx_softarm.logs.schema import Log
from mjx_softarm.policy.file import SHIPPED


def test_runs_share_the_goals_of_a_circle_and_false_ones_are_counted(monkeypatch):
    names, circles = [], []
    log = Log(source="", row=np.arange(2), time_s=np.arange(2.0), load_kg=np.array([0.9, 1.1]))

    def follow(arm, controller, goals):
        circles.append(goals)
        events = [Event(Fault.OVERLOADED, "")] * (len(circles) == 2) + [Event(Fault.LOAD_UNKNOWN, "")]
        return LoopRun(log, (), tuple(events), np.zeros(1), Ending())

    monkeypatch.setattr(overload, "open_arm", names.append)
    monkeypatch.setattr(overload, "follow", follow)
    found = overload.measure((f"twin:0={SHIPPED}",), runs=3, points=2)
    assert names == 3 * ["twin:0:1000g"] and {len(goals) for goals in circles} == {2}
    assert len(np.unique(np.concatenate(circles), axis=0)) == 6
    assert found["targets"][0]["measured"] == "1 of 3 runs"
    assert [row["overloaded"] for row in found["runs"]] == [0, 1, 0]
    assert found["runs"][0]["highest believed [g]"] == pytest.approx(1100)


@pytest.mark.parametrize("policies", [(), ("twin:0",)])
def test_policies_of_another_form_are_refused(policies):
    with pytest.raises(InputError, match="expected ARM=FILE"):
        overload.measure(policies)
