"""Error budgets of the linear arm, each with one planted cause."""

import dataclasses
import json
import re

import numpy as np
import pytest

from calib.changes import MIN_POSES
from mjx_softarm.deploy.__main__ import main
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.deploy.budget import Budget, budget
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.measure import figures, measure, write_accuracy
from mjx_softarm.logs.files import read_matrix
from mjx_softarm.policy.file import save_policy
from mjx_softarm.policy.runtime import tip_pose
from mjx_softarm.sensing.pose import quaternion_from_pose
from mjx_softarm.sensing.s2r import N_POSE_INPUTS, N_POSE_OUTPUTS
from tests.linear_arm import (
    CONTROLLER,
    GAIN_M_PER_KPA,
    GOALS,
    LOAD,
    POLICY,
    REST_M,
    SENSOR,
    LinearArm,
    N,
    changed,
    go,
)
from tests.networks import s2r_of

KG = 1.0
SHIFT_M = 1e-3 * np.array([0.0, 1.0, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0, -1.0])
_nothing = np.zeros((N_POSE_INPUTS + N, N_POSE_OUTPUTS), np.float32), np.zeros(N_POSE_OUTPUTS, np.float32)
NO_CHANGE = s2r_of((_nothing,), 1.0, limit=np.float32(1e3), error_mm=np.float32(0.4))
MOVED = changed(POLICY.estimator, [0.003, 0, 0, 0.003, 0, 0], (LOAD,))
KNOWN = dataclasses.replace(POLICY, s2r=NO_CHANGE, estimator=MOVED)
POLICY_WITHOUT_SINK = dataclasses.replace(KNOWN, estimator=POLICY.estimator)  # a payload moves no tip
WEAK = dataclasses.replace(KNOWN, gains=KNOWN.gains._replace(pressure_max_kpa=np.full(N, 8.0)))
CIRCLE = np.random.default_rng(5).uniform(-20, 10, (8, N)) @ GAIN_M_PER_KPA.T + REST_M
GOALS_OF_CIRCLE = tip_pose(KNOWN, CIRCLE, 0.0)[0].astype(float)


def nearest_springs(pose, goal, spring_m, sensed):
    return CIRCLE[int(np.argmin(np.abs(GOALS_OF_CIRCLE - goal).sum(axis=1)))]


class Planted(LinearArm):
    """The truth is the policy's model, but for what a test plants."""

    def __init__(self, shift_m=0.0, payload_kg=0.0, off_mm=0.0, policy=KNOWN):
        super().__init__(sensor=dataclasses.replace(SENSOR, delta_m=SENSOR.delta_m + shift_m))
        self.payload_kg, self.off_mm, self.policy = payload_kg, off_mm, policy

    def motion_capture(self):
        pose = tip_pose(self.policy, self.spring_m, self.payload_kg)[0].astype(float)
        tip_m = 1e-3 * (pose[:3] + self.off_mm)
        return Capture(tip_m, quaternion_from_pose(pose), tip_m[None])


def split(arm, plan=nearest_springs, payload_kg=0.0, policy=KNOWN):
    controller = Controller.of(policy, plan)
    run = go(arm, goals=GOALS_OF_CIRCLE, controller=controller)
    accuracy = measure(run, controller, GOALS_OF_CIRCLE)
    found = budget(accuracy, policy, payload_kg)
    error_mm = figures(accuracy, run.counts())["translation_mm"]
    assert found.total_mm == pytest.approx(error_mm, rel=1e-6) and found.n_goals == len(run.arrivals)
    return found


def wrong_springs(*at):
    return nearest_springs(*at) + 2e-3 * (np.arange(N) == 1)


@pytest.mark.parametrize(
    ("cause", "arm", "others", "size_mm", "words"),
    [
        ("policy", {}, {"plan": wrong_springs}, None, "train longer, or by the preset analytic"),
        ("law", {}, {"policy": WEAK}, None, "springs end [0-9.]+ mm off .*, saturated at [1-8] goals"),
        ("payload", {"payload_kg": KG}, {"payload_kg": KG}, None, "believes 0 g, and --payload says 1000 g"),
        ("springs", {"shift_m": SHIFT_M}, {}, None, r"spring1 \+[01]\.[0-9], spring3 -[01]\.[0-9]"),
        # As far off as the 0.4 mm of S2R, and no more
        ("S2R", {"off_mm": np.array([0.24, 0.0, 0.32])}, {}, 0.4, "record more random poses"),
        # An arm that the policy does not know
        (
            "rest",
            {"off_mm": np.array([3.0, 0.0, 4.0]), "policy": POLICY},
            {"policy": POLICY},
            5.0,
            "calibrate it and train",
        ),
    ],
)
def test_a_planted_cause_is_the_largest_part(cause, arm, others, size_mm, words):
    found = split(Planted(**arm), **others)
    assert found.largest == cause and found.parts_mm[cause] > 0.85 * found.total_mm
    if size_mm is None:
        assert found.total_mm > 0.5
    else:
        assert found.parts_mm[cause] == pytest.approx(size_mm, rel=0.075)
    parts, sentence = found.lines()
    assert cause in parts and found.calibrated == (cause != "rest")
    assert re.search(words, sentence), sentence
    if cause == "springs":  # as far as eight goals tell
        np.testing.assert_allclose(found.shift_mm, 1e3 * SHIFT_M, atol=0.6)
        assert np.corrcoef(found.shift_mm, SHIFT_M)[0, 1] > 0.9
    else:
        assert not found.shift_mm.any()


@pytest.mark.parametrize(
    ("parts_mm", "shift_mm", "n_goals", "remedy"),
    [
        # Zeros that no sensor loses, or a large rest, are of another arm; an aged one is not, nor are parts
        # that cancel, nor an error that nobody would call one
        ({"policy": -2.7, "law": 4.97}, 0.0, 8, "take goals further inside"),
        ({"payload": -4.95, "rest": 6.08}, 0.0, 8, "record poses anew"),
        ({"policy": 0.0, "law": 0.1, "springs": 4.0}, 11.0, 8, "--since"),
        ({"policy": 0.0, "law": 0.1, "springs": 55.0}, 11.0, 8, "likely another arm"),
        ({"policy": 0.0, "law": 0.1, "rest": 26.0}, 0.0, 8, "likely another arm"),
        ({"policy": 0.0, "law": 0.1, "springs": 7.3}, 1.3, 8, "--since"),
        ({"law": 0.1, "rest": 2.0}, 0.0, MIN_POSES, "record poses anew"),
        # `calib run --since` refuses fewer
        ({"law": 0.1, "springs": 2.0}, 0.0, MIN_POSES - 1, f"measure {MIN_POSES} or more"),
        ({"law": 0.1, "rest": 2.0}, 0.0, 3, f"measure {MIN_POSES} or more"),
    ],
)
def test_remedies(parts_mm, shift_mm, n_goals, remedy):
    known = {"loaded": False, "wrong_mm": 6.0, "calibrated": True}
    parts = Budget(parts_mm, np.full(N, shift_mm), 0.0, 0.0, 0.2, n_goals, 3, **known)
    assert remedy in parts.lines()[1] and parts.wrong == ("another arm" in remedy)
    assert not parts._replace(calibrated=False).wrong


def test_errors_with_a_payload_are_no_shift_of_the_zeros():
    """S2R is of the unloaded arm; with a payload its error is part of the rest."""
    off_mm = np.array([0.0, 0.0, 30.0])
    found = split(Planted(off_mm=off_mm, payload_kg=KG), payload_kg=KG)
    assert not found.shift_mm.any() and found.parts_mm["springs"] == 0.0
    assert found.parts_mm["rest"] > 1.0
    assert split(Planted(off_mm=off_mm)).shift_mm.any()


def believing(kg, policy=KNOWN, **planted):
    """Return the accuracy as of a loop that believed a payload, and the policy."""
    controller = Controller.of(policy, nearest_springs)
    run = go(Planted(policy=policy, **planted), goals=GOALS_OF_CIRCLE, controller=controller)
    return measure(run, controller, GOALS_OF_CIRCLE)._replace(load_kg=np.full(8, kg)), policy


def test_a_payload_that_nobody_gives_is_the_loops_own_estimate():
    """Half a kilogram hangs; the loop knows, and nobody says so: no part cancels another, no arm is accused.

    With --payload 0 the user says that nothing hangs: the payload's part is then its effect.
    """
    at = believing(0.5, payload_kg=0.5, off_mm=np.array([0.3, 0.0, 0.4]))
    unsaid, wrong = budget(*at, None), budget(*at, 0.0)
    assert unsaid.loaded and unsaid.payload_g is None and unsaid.believed_g == pytest.approx(500.0)
    assert unsaid.parts_mm["payload"] == 0.0 and not unsaid.shift_mm.any() and not unsaid.wrong
    assert abs(wrong.parts_mm["payload"]) > 1.0 and not wrong.wrong
    assert "payload: 500 g by the loop's estimate" in unsaid.lines()[0]
    assert "--payload says 0 g" not in unsaid.lines()[-1] and len(wrong.lines()) == 2


@pytest.mark.parametrize("believed_kg", [0.02, 0.4])
def test_a_wrong_calibration_is_named_whatever_payload_the_loop_reads_from_it(believed_kg):
    """Models 26 mm off, as of another twin, which the loop takes for a payload of up to 0.4 kg."""
    result = budget(*believing(believed_kg, off_mm=np.array([15.0, -15.0, 15.0])), None)
    assert result.total_mm > 20.0 and result.wrong and "likely another arm" in result.lines()[-1]


def test_zeros_of_an_aged_arm_are_found_although_the_loop_takes_them_for_a_payload():
    """Zeros 2 mm off move the tip by more than 1 % of the arm's length, and the loop believes 0.3 kg."""
    result = budget(*believing(0.3, POLICY_WITHOUT_SINK, shift_m=2 * SHIFT_M), None)
    assert result.total_mm > result.wrong_mm and not result.wrong
    assert result.largest == "springs" and "--since" in result.lines()[-1]


def test_a_reading_that_was_lost_on_arrival_does_not_count(tmp_path):
    controller = Controller.of(KNOWN, nearest_springs)
    run = go(Planted(shift_m=SHIFT_M), goals=GOALS_OF_CIRCLE, controller=controller)
    whole = budget(measure(run, controller, GOALS_OF_CIRCLE), KNOWN, 0.0)
    # One row of a window, then all rows of another
    last = run.arrivals[1].row + 1
    run.log.readings[[run.arrivals[0].row - 3, *range(last - controller.window, last)], 4] = np.nan
    accuracy = measure(run, controller, GOALS_OF_CIRCLE)
    found = budget(accuracy, KNOWN, 0.0)
    assert found.parts_mm["springs"] == pytest.approx(whole.parts_mm["springs"], rel=0.15)
    assert np.isfinite([*found.parts_mm.values(), found.off_mm, *found.shift_mm]).all()
    told = figures(accuracy, run.counts()) | {"budget": found.figures()}
    write_accuracy(tmp_path, accuracy, told)


def test_measure_tells_the_parts_hangs_the_payload_and_logs_it(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    hung_kg = []
    monkeypatch.setattr(Planted, "attach", lambda _, kg: hung_kg.append(kg), raising=False)
    save_policy(tmp_path / "policy.npz", POLICY)
    monkeypatch.setattr("mjx_softarm.deploy.__main__._controller", lambda *at: CONTROLLER)
    monkeypatch.setattr("mjx_softarm.deploy.__main__.open_arm", lambda name: Planted(policy=POLICY))
    monkeypatch.setattr("mjx_softarm.deploy.__main__.read_goals", lambda *at: GOALS)
    out = tmp_path / "out"
    assert main(["measure", "--arm", "its:Arm", "--out", str(out), "--payload", "250"]) == 0
    said = capsys.readouterr().out
    assert "made by [mm]: policy " in said and "largest part: " in said
    found = json.loads((out / "accuracy.json").read_text())
    assert sum(found["budget"]["parts_mm"].values()) == pytest.approx(found["translation_mm"])
    assert found["budget"]["payload_g"] == 250.0 and (out / "budget.png").stat().st_size > 0
    log = read_matrix(out / "log.npz", POLICY.spec, one_of=())[0].log()
    assert (log.payload_kg == 0.25).all() and hung_kg == [0.25]
    assert main(["measure", "--arm", "its:Arm", "--out", str(out), "--payload", "-1"]) == 2
