"""Summary of a race: curves with known crossings, targets, tables."""

import json

import pytest

from benchmarks.race.summary import PeerTarget, crossing, judge, summarise


def result(name, *errors_mm, seed=0):
    """A contestant with a point each 10 s."""
    names = ("wall_s", "trained_s", "env_steps", "updates", "median_mm")
    values = [(2.0 + 10 * k, 10.0 * k, 100 * k, k, error) for k, error in enumerate(errors_mm, 1)]
    points = [dict(zip(names, point, strict=True)) for point in values]
    who = {"contestant": name, "seed": seed, "commit": "a1b2", "uncommitted_changes": False}
    return {**who, "start_up_s": 2.0, "limit_s": None, "points": points}


def failed(name):
    return {"contestant": name, "seed": 0, "failed": "no network"}


SBX, SB3 = "sbx-hindsight", "sb3-contrib-hindsight"
TQC = {SBX: PeerTarget(SBX, 5.0), SB3: PeerTarget(SB3, 15.0)}


def judged(peer, *results):
    row = judge(TQC[peer], results)
    return row["measured"], row["verdict"]


OURS_FAST = result("ours-quick", 4.0)  # 12 s
SLOW = [9.0] * 30  # 302 s


@pytest.mark.parametrize(
    ("errors_mm", "level_mm", "axis", "expected"),
    [
        ((20.0, 12.0, 8.0, 11.0, 4.0), 10, "wall_s", 27.0),  # half way from 22 to 32
        ((20.0, 12.0, 8.0, 11.0, 4.0), 8, "trained_s", 30.0),
        ((20.0, 12.0, 8.0, 11.0, 4.0), 5, "env_steps", 400 + 100 * 6 / 7),
        ((20.0, 12.0, 8.0, 11.0, 4.0), 3, "wall_s", None),
        ((4.0, 3.0), 5, "wall_s", 12.0),  # at its first evaluation
        ((None, None), 10, "wall_s", None),
        ((20.0, None, 4.0), 5, "wall_s", 32.0),  # nothing to draw the line from
    ],
)
def test_a_level_is_reached_where_the_line_between_two_evaluations_crosses_it_first(
    errors_mm, level_mm, axis, expected
):
    found = crossing(result("", *errors_mm)["points"], level_mm, axis)
    assert found is None if expected is None else found == pytest.approx(expected)


QUICK, LATER = result("ours-quick", 6.0, 4.0), result("ours-quick", 4.0, seed=1)  # 5 mm at 17 s; at 12 s
ANALYTIC = result("ours-analytic", 4.0)


@pytest.mark.parametrize(
    ("results", "told"),
    [
        ([QUICK, result(SBX, *[9.0] * 8, 6.0, 4.0)], ("5.71 times", "met")),  # 97 s
        ([QUICK, result(SBX, 9.0, 9.0, 6.0, 4.0), ANALYTIC], ("2.18 times", "NOT MET")),  # 37 s
        ([QUICK, result(SBX, 9.0, 9.0, 6.0)], ("not within 1.88 times", "skipped")),
        ([OURS_FAST, result(SBX, *SLOW)], ("not within 25.17 times", "met")),
        ([OURS_FAST, result(SBX, *SLOW), LATER], (f"not raced: {SBX}, seed 1", "skipped")),
        ([result("ours-quick", 6.0), result(SBX, *SLOW)], ("ours did not reach it with seed 0", "NOT MET")),
        ([failed("ours-quick")], ("ours-quick, seed 0: no network", "NOT MET")),
    ],
)
def test_a_target_is_the_peer_s_time_over_ours_once_both_have_raced_with_all_seeds(results, told):
    assert judged(SBX, *results) == told


def test_a_target_of_another_learner_looks_at_that_learner_alone():
    wanted = PeerTarget(SBX, 10.0, "ours-analytic")
    results = [result("ours-quick", 9.0, 4.0), result(SBX, *[9.0] * 14, 4.0)]
    assert judge(wanted, results)["measured"] == "not raced: ours-analytic, seed 0"
    row = judge(wanted, [*results, ANALYTIC])
    assert (row["measured"], row["verdict"]) == ("12.50 times", "met")  # 150 s and 12 s


def test_failures_are_told_and_only_that_of_ours_is_a_target_not_met():
    verdicts = [row["verdict"] for row in summarise([failed("ours-quick")])["targets"]]
    assert verdicts == ["NOT MET", "NOT MET", "skipped"]
    results = [OURS_FAST, result(SBX, *SLOW), failed(SB3), failed("ours-analytic")]
    assert judged(SBX, *results)[1] == "met"
    assert judged(SB3, *results) == (f"{SB3}, seed 0: no network", "skipped")
    assert summarise(results)["failed"] == results[-2:]


def test_the_median_over_seeds_counts():
    results = []
    for seed, n in enumerate((6, 3, 7)):  # evaluations until 4 mm
        results += [result("ours-quick", 4.0, seed=seed), result(SBX, *[9.0] * n, 4.0, seed=seed)]
    assert judged(SBX, *results)[0] == "5.83 times"  # (2 + 68) / 12 of seed 0, at 4/5 of its last


def test_tables_have_a_row_for_each_contestant_with_start_up_and_without():
    results = [result("ours-quick", 12.0, 8.0, 4.0), result(SBX, 20.0), result(SB3, 20.0)]
    figures = summarise(results)
    assert figures["wall_s"][0] == {
        "contestant": "ours-quick",
        "seed": 0,
        "start_up": 2.0,
        "to_10_mm": 17.0,
        "to_5_mm": 29.5,
        "to_3_mm": "not within 32",
        "to_2_mm": "not within 32",
        "to_1_mm": "not within 32",
        "best_mm": 4.0,
        "in_all": 32,
    }
    assert figures["wall_s_without_start_up"][0]["to_10_mm"] == 15.0
    assert figures["env_steps"][0]["to_5_mm"] == 275.0
    assert [row["to_10_mm"] for row in figures["wall_s"][1:]] == ["not within 12"] * 2
    json.dumps(figures, allow_nan=False)
