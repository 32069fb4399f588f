"""The race: clock and limits of contestants, with a made-up program; levels, targets, a tiny run of ours."""

import sys

import numpy as np
import pytest

from benchmarks.harness.peers import PINS
from benchmarks.harness.rounds import Worker
from benchmarks.race import race
from benchmarks.race.contestants import CONTESTANTS, Contestant, prepare, settings_of
from benchmarks.race.race import PeerTarget, RaceLimits, crossing, judge, limits_of, run, train
from mjx_softarm._support.errors import InputError
from train.presets import PRESETS

FAKE = '''
"""A contestant whose curve is known: 100 mm / round, 10 s and 1,000 env steps each."""
from benchmarks.harness.rounds import serve
k = 0
def work():
    global k
    k += 1
    return {"wall_s": 3 + 10.0 * k, "trained_s": 10.0 * k, "env_steps": 1000 * k, "updates": k,
            "median_mm": 100 / k, "ended": k == 30}
serve(lambda: ({"start_up_s": 3.0}, work))
'''


@pytest.mark.parametrize(
    "limits, n_points",
    [
        (RaceLimits(93.0), 9),  # 3 + 10 k >= 93
        (RaceLimits(target_mm=20.0), 5),  # 100 / k <= 20
        (RaceLimits(), 30),  # ended
    ],
)
def test_a_contestant_trains_until_its_limit_its_target_or_its_end(tmp_path, monkeypatch, limits, n_points):
    (tmp_path / "fake_contestant.py").write_text(FAKE, "utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    result = train(Worker("fake", ["fake_contestant"]), limits)
    assert [point["updates"] for point in result["points"]] == list(range(1, n_points + 1))
    assert result["start_up_s"] == 3.0 and "ended" not in result["points"][-1]


def test_time_counts_in_training_and_stands_while_the_policy_is_evaluated(monkeypatch):
    clock, steps = [0.0], [0]

    class Slow:
        def __init__(self, n_goals):
            clock[0] += 1000

        def tip_error_mm(self, policy):
            clock[0] += 100
            return np.array([1.0, 2.0, 9.0])

    def stretch():
        clock[0] += 2.0
        steps[0] += 10

    monkeypatch.setattr("benchmarks.race.contestants.time.perf_counter", lambda: clock[0])
    monkeypatch.setattr("benchmarks.race.contestants.HeldOut", Slow)
    monkeypatch.setattr("benchmarks.race.contestants.START", -5.0)
    contestant = Contestant(stretch, lambda obs: obs, lambda: (steps[0], 7), limit=60)
    monkeypatch.setattr("benchmarks.race.contestants.ours", lambda name, seed: contestant)
    facts, work = prepare("ours-quick", "0", "3", "8")
    assert facts == {"start_up_s": 5.0}
    expected = {"wall_s": 9.0, "trained_s": 4.0, "env_steps": 20, "updates": 7, "median_mm": 2.0}
    assert work() == expected | {"ended": False}
    clock[0] += 1000  # nor while nobody asks
    assert (work()["wall_s"], work()["ended"]) == (13.0, True)


def test_the_learning_rate_of_peers_falls_as_that_of_quick():
    n_steps, config = [0], PRESETS["quick"].learner
    rate, n = settings_of(config, lambda: n_steps[0])["learning_rate"], config.total_env_steps
    for n_steps[0], expected in {0: 4e-3, n // 2: 2.04e-3, n - 1: 0.08e-3, n: 4e-3}.items():
        assert rate(1.0) == pytest.approx(expected, rel=1e-3)


def result(name, *errors_mm, seed=0):
    """A contestant with a point each 10 s; 2 s of start-up."""
    names = ("wall_s", "trained_s", "env_steps", "updates", "median_mm")
    values = [(2.0 + 10 * k, 10.0 * k, 100 * k, k, error) for k, error in enumerate(errors_mm, 1)]
    points = [dict(zip(names, point, strict=True)) for point in values]
    return {"contestant": name, "seed": seed, "start_up_s": 2.0, "limit_s": None, "points": points}


@pytest.mark.parametrize(
    ("errors_mm", "level_mm", "axis", "expected"),
    [
        ((20.0, 12.0, 8.0, 11.0, 4.0), 10, "wall_s", 27.0),  # half way from 22 to 32
        ((20.0, 12.0, 8.0, 11.0, 4.0), 5, "env_steps", 400 + 100 * 6 / 7),
        ((20.0, 12.0, 8.0, 11.0, 4.0), 3, "wall_s", None),
        ((4.0, 3.0), 5, "wall_s", 12.0),  # at its first evaluation
        ((20.0, None, 4.0), 5, "wall_s", 32.0),  # nothing to draw the line from
    ],
)
def test_a_level_is_reached_where_the_line_between_two_evaluations_crosses_it_first(
    errors_mm, level_mm, axis, expected
):
    where = crossing(result("", *errors_mm)["points"], level_mm, axis)
    assert where is None if expected is None else where == pytest.approx(expected)


SBX, SLOW = "sbx-hindsight", [9.0] * 30  # 302 s
FAILED = {"contestant": SBX, "seed": 0, "failed": "no network"}
QUICK, FAST = result("ours-quick", 6.0, 4.0), result("ours-quick", 4.0)  # 5 mm at 17 s; at 12 s


@pytest.mark.parametrize(
    ("results", "judged"),
    [
        ([QUICK, result(SBX, *[9.0] * 8, 6.0, 4.0)], ("5.71 times", "met")),  # 97 s
        ([QUICK, result(SBX, 9.0, 9.0, 6.0, 4.0)], ("2.18 times", "NOT MET")),  # 37 s
        ([QUICK, result(SBX, 9.0, 9.0, 6.0)], ("not within 1.88 times", "skipped")),
        ([FAST, result(SBX, *SLOW)], ("not within 25.17 times", "met")),
        ([FAST, FAILED], (f"{SBX}, seed 0: failed", "skipped")),
        ([result("ours-quick", 6.0), result(SBX, *SLOW)], ("ours did not reach it with seed 0", "NOT MET")),
    ],
)
def test_a_target_is_the_peer_s_time_over_ours_once_both_have_raced_with_all_seeds(results, judged):
    row = judge(PeerTarget(SBX, 5.0), results)
    assert (row["measured"], row["verdict"]) == judged


@pytest.fixture
def asked(monkeypatch):
    """Limits that each contestant was given, in place of training it; SBX fails."""
    asked = {}

    def made_up(worker, limits):
        asked[worker.name] = limits
        if worker.name.startswith(SBX):
            raise InputError(f"{worker.name}: got status 1")
        return {key: result("", 12.0, 8.0, 4.0)[key] for key in ("start_up_s", "limit_s", "points")}

    monkeypatch.setattr(race, "train", made_up)
    monkeypatch.setattr(race, "peer_python", lambda name: PINS[name] and sys.executable)
    return asked


def test_peers_get_our_time_to_5_mm_as_often_as_the_target_asks_and_stop_where_ours_did(asked, tmp_path):
    results = run(tmp_path, 4)
    assert [one["contestant"] for one in results] == list(CONTESTANTS)
    assert [one.get("failed") for one in results] == [None, None, f"{SBX}, seed 4: got status 1", None]
    sbx, sb3 = (RaceLimits(n * 29.5, 5, n * 29.5 / 40) for n in (20, 15))  # SBX: 5 times quick, 20 analytic
    ours = (RaceLimits(), RaceLimits(float("inf"), 1, 5 * 29.5 / 40))
    given = zip(CONTESTANTS, (*ours, sbx, sb3), strict=True)
    assert list(asked.items()) == [(f"{name}, seed 4", limits) for name, limits in given]
    # One that does not reach 5 mm: multiples of all its time.
    quick = result("ours-quick", 12.0, 8.0)
    assert limits_of(SBX, [quick]) == RaceLimits(5 * 22.0, 10, 5 * 22.0 / 40)
    # What was measured is kept; what failed is tried again.
    asked.clear()
    assert run(tmp_path, 4) == results and list(asked) == [f"{SBX}, seed 4"]


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTESTANTS[:2])
def test_smoke(name):
    """Ours trains and is evaluated in a process of its own, for one stretch."""
    limits = RaceLimits(wall_s=0.0)
    points = train(Worker(name, ["benchmarks.race.contestants", name, "0", "0.1", "16"]), limits)["points"]
    assert len(points) == 1 and 0.0 < points[0]["median_mm"] < 500.0 and points[0]["env_steps"] > 0
