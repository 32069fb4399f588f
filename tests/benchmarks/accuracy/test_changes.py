"""Benchmarks of changed arms and of the loop's correction."""

import json

import pytest

from benchmarks.accuracy import changes, correction
from mjx_softarm._support.errors import InputError
from mjx_softarm.policy.file import SHIPPED

MM = {"first": 0.8, "aged": 7.0, "back": 1.0}


@pytest.mark.parametrize(("status", "verdict"), [(0, "met"), (1, "NOT MET")])
def test_an_arm_is_back_by_the_commands_of_a_user(status, verdict, monkeypatch):
    calls = []

    def accuracy_of(policy, arm, out, *options):
        calls.append((policy.name, arm, *options))
        parts = {"policy": 0.1, "springs": MM[out.name] - 0.1}
        budget = {"largest": "springs", "parts_mm": parts}
        return {"translation_mm": MM[out.name], "load_estimate_g": 20.0, "budget": budget}

    def run_command(*words, makes):
        calls.append(words[:2])
        if words[0] == "calib":
            makes.mkdir()
            found = {"parts": {"Changes": {"figures": {"zero_m": [0.001, -0.001]}}}}
            (makes / "report.json").write_text(json.dumps(found))
        return status

    monkeypatch.setattr(changes, "accuracy_of", accuracy_of)
    monkeypatch.setattr(changes, "run_command", run_command)
    found = changes.measure(("twin:3=run=cal",), points=5)
    circle = ("--points", 5)
    assert calls == [
        ("policy.npz", "twin:3", *circle),
        ("policy.npz", "twin:3:aged", *circle),
        ("calib", "run"),
        ("train", "export"),
        ("renewed.npz", "twin:3:aged", *circle),
    ]
    [row], [target] = found["arms"], found["targets"]
    assert row["back, over before"] == 1.25 and row["this part [mm]"] == pytest.approx(6.9)
    assert row["springs' zeros found [mm]"] == "+1.0, -1.0" and target["verdict"] == verdict
    with pytest.raises(InputError, match="--arms: got none, expected ARM=RUN=CALIBRATION"):
        changes.measure(())


def test_the_correction_changes_what_a_policy_reaches():
    found = correction.measure((f"shipped=twin:0={SHIPPED}",), points=2)
    [row], [mean] = found["policies"], found["means"]
    assert row["with [mm]"] != row["without [mm]"] and mean["with [mm]"] == row["with [mm]"]
    with pytest.raises(InputError, match="--policies: got none, expected NAME=ARM=FILE"):
        correction.measure(())
