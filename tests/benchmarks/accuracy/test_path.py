"""The circle in time and stop by stop, as `python -m benchmarks path` measures it."""

import dataclasses
import json

import pytest

from benchmarks.accuracy import arms, path
from benchmarks.accuracy.path import means_over, measure, targets
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.__main__ import main
from mjx_softarm.policy.file import SHIPPED, load_policy


def test_a_policy_is_measured_in_time_and_at_stops(monkeypatch):
    # In this process, whose imports are done.
    monkeypatch.setattr(
        arms, "run_command", lambda _, *words, makes, python: main([str(word) for word in words])
    )
    figures = measure((f"twin:0={SHIPPED}",), seconds=(4.0,), points=3, stops=1)
    [in_time], [stopping] = figures["in time"], figures["stop by stop"]
    assert json.dumps(figures) and in_time["trained"] == stopping["trained"] == "at rest"
    assert in_time["arm"] == "twin:0" and in_time["policy"] == str(SHIPPED)
    assert in_time["once around [s]"] == 4.0 < stopping["seconds"] and stopping["mean [mm]"] > 0.0
    assert in_time["mean without that [mm]"] <= in_time["mean [mm]"] < in_time["largest [mm]"] < 200.0
    assert figures["means in time"][0]["mean [mm]"] == in_time["mean [mm]"]


def test_means_are_those_of_equal_keys():
    rows = [{"trained": t, "mm": x} for t, x in (("at rest", 1.0), ("in motion", 4.0), ("at rest", 3.0))]
    assert means_over(rows, ("trained",), ("mm",)) == [
        {"trained": "at rest", "policies": 2, "mm": 2.0},
        {"trained": "in motion", "policies": 1, "mm": 4.0},
    ]


def test_the_target_is_for_one_pace_however_trained():
    rows = [("at rest", 20.0, 4.01), ("in motion", 20.0, 4.0), ("in motion", 10.0, 9.0)]
    found = targets([{"trained": t, "once around [s]": s, "mean [mm]": mm} for t, s, mm in rows])
    assert [row["verdict"] for row in found] == ["NOT MET", "met"]
    assert found[0]["target"] == "trained at rest, once around in 20 s: mean at most 4 mm"


def test_policies_that_cannot_be_measured_or_compared_are_named(monkeypatch):
    with pytest.raises(InputError, match="--policies: got none, expected ARM=FILE"):
        measure(())
    with pytest.raises(InputError, match="--policies: got policy.npz, expected ARM=FILE, such as"):
        measure(("policy.npz",))
    with pytest.raises(InputError, match="absent.npz: got 'No such file"):  # before any is measured
        measure((f"twin:0={SHIPPED}", "twin:0=absent.npz"))
    moving = dataclasses.replace(load_policy(SHIPPED), action_s=0.5)
    policies = {"still": load_policy(SHIPPED), "moving": moving}
    monkeypatch.setattr(path, "load_policy", policies.__getitem__)
    with pytest.raises(InputError, match="got at rest twin:0; in motion twin:1, expected the same arms"):
        measure(("twin:0=still", "twin:1=moving"))


def test_a_measurement_that_lacks_a_goal_is_an_error(monkeypatch):
    def two_of_three(*words, makes, python):
        makes.parent.mkdir()
        makes.write_text('{"measured": 2, "points": 3}')

    monkeypatch.setattr(arms, "run_command", two_of_three)
    with pytest.raises(InputError, match="twin:0=.*: got 2 of 3 goals, expected all"):
        measure((f"twin:0={SHIPPED}",))
