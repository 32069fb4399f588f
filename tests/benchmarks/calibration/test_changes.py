"""Benchmarks of changed arms and of the loop's correction."""

import dataclasses
import json

import numpy as np
import pytest

from benchmarks.accuracy import correction
from benchmarks.calibration import changes
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy import session
from mjx_softarm.deploy.accuracy.measure import figures, measure
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


def test_without_the_correction_a_policy_is_asked_for_the_goals_alone(monkeypatch):
    runs = []

    def watched(arm, controller, goals):
        asked = []

        def plan(pose, goal, *others):
            asked.append(goal)
            return controller.plan(pose, goal, *others)

        run = session.follow(arm, dataclasses.replace(controller, plan=plan), goals)
        shifted_mm = max(np.abs(goals - goal)[:, :3].max(axis=1).min() for goal in asked)
        runs.append((shifted_mm, figures(measure(run, controller, goals), {})["translation_mm"]))
        return run

    monkeypatch.setattr(correction, "follow", watched)
    found = correction.measure((f"shipped=twin:0={SHIPPED}",), points=2)
    [row], [mean], ((shifted_mm, with_mm), (unshifted_mm, without_mm)) = (
        found["policies"],
        found["means"],
        runs,
    )
    assert unshifted_mm == 0.0 and shifted_mm > 1.0
    assert row["with [mm]"] == mean["with [mm]"] == with_mm
    assert row["without [mm]"] == mean["without [mm]"] == without_mm
    with pytest.raises(InputError, match="--policies: got none, expected NAME=ARM=FILE"):
        correction.measure(())


def test_an_error_of_the_pose_hardly_changes_what_a_policy_asks_for(monkeypatch):
    [row] = correction.pose_error((f"shipped=twin:0={SHIPPED}",), points=4)["policies"]
    assert 0.0 < row["mean [mm]"] < row["95 % [mm]"] < 0.5
    monkeypatch.setattr(correction, "POSE_ERROR", 0.0 * correction.POSE_ERROR)
    [row] = correction.pose_error((f"shipped=twin:0={SHIPPED}",), points=4)["policies"]
    assert row["95 % [mm]"] == 0.0


@pytest.mark.parametrize("text", ["twin:0", "twin:0=run", "a=b=c=d", "a==c"])
def test_texts_of_another_form_are_refused(text):
    with pytest.raises(InputError, match=f"--arms: got {text}, expected ARM=RUN=CALIBRATION"):
        changes.measure((text,))
    with pytest.raises(InputError, match=f"--policies: got {text}, expected NAME=ARM=FILE"):
        correction.measure((text,))
