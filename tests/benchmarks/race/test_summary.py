"""Summary of a race: curves with known crossings, the best of ours and of the peers, targets, tables."""

import json

import pytest

from benchmarks.race.summary import PEERS, Target, crossing, judge, summarise


def result(name, *errors_mm, seed=0):
    """A contestant with a point each 10 s."""
    points = [
        {
            "wall_s": 2.0 + 10 * k,
            "trained_s": 10.0 * k,
            "env_steps": 100 * k,
            "updates": k,
            "median_mm": error,
        }
        for k, error in enumerate(errors_mm, 1)
    ]
    who = {"contestant": name, "seed": seed, "commit": "a1b2", "uncommitted_changes": False}
    return {**who, "start_up_s": 2.0, "limit_s": None, "points": points}


def failed(name):
    return {"contestant": name, "seed": 0, "failed": "no network"}


def others(*errors_mm, libraries=tuple(PEERS), seed=0):
    """All variants of peers, which need as long as the curve says."""
    return [result(name, *errors_mm, seed=seed) for library in libraries for name in PEERS[library]]


TQC = {"sbx": Target("sbx", 5.0), "sb3-contrib": Target("sb3-contrib", 15.0)}


def judged(library, *results):
    row = judge(TQC[library], results)
    return row["measured"], row["verdict"]


OURS_FAST = result("ours-quick", 4.0)  # 12 s
SLOW = [9.0] * 30


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


def test_a_target_is_met_only_once_all_variants_have_raced():
    results = [OURS_FAST, *others(*SLOW)]
    assert judged("sbx", *results) == ("not within 25.17 times", "met")
    assert summarise(results)["not_raced"] == ["ours-analytic", "ours-plain"]
    some = [one for one in results if one["contestant"] != "sbx-defaults"]
    told = "not within 25.17 times; not raced: sbx-defaults, seed 0"
    assert judged("sbx", *some) == (told, "skipped")
    assert judged("sb3-contrib", *some) == judged("sb3-contrib", *results)
    slow = OURS_FAST, result("sbx-plain", 9.0, 4.0)
    assert judged("sbx", *slow)[1] == "NOT MET"  # others could only be faster
    told = "not raced: sb3-contrib-hindsight, seed 0; sb3-contrib-plain, seed 0; sb3-contrib-defaults, seed 0"
    assert judged("sb3-contrib", *slow) == (told, "skipped")


@pytest.mark.parametrize(
    "best, errors_mm", [("sbx-plain", [8.0] * 30), ("sbx-hindsight", [9.0] * 29 + [4.0])]
)
def test_the_variant_that_does_best_where_all_race_must_race_with_all_seeds(best, errors_mm):
    """It is the first at the level, or where none comes there, the closest."""
    results = [OURS_FAST, *others(*SLOW, libraries=["sbx"]), result("ours-quick", 4.0, seed=1)]
    results[1 + PEERS["sbx"].index(best)] = result(best, *errors_mm)
    measured, verdict = judged("sbx", *results, result("sbx-defaults", *SLOW, seed=1))
    assert measured.endswith(f"times; not raced: {best}, seed 1") and verdict == "skipped"
    measured, verdict = judged("sbx", *results, result(best, *SLOW, seed=1))
    assert verdict == "met" and "not raced" not in measured
    other = "sbx-defaults"  # the best with seed 1, where all race, too
    results += [result(name, *SLOW, seed=1) for name in PEERS["sbx"] if name != other]
    results += [result(other, *[7.0] * 30, seed=1), result("ours-quick", 4.0, seed=2)]
    measured, _ = judged("sbx", *results, result(best, *SLOW, seed=2))
    assert measured.endswith(f"raced: {other}, seed 2")


def test_a_target_is_met_by_the_better_variant_s_time_over_ours():
    ours, later = result("ours-quick", 6.0, 4.0), [9.0] * 11  # 5 mm at 17 s
    first = result("sbx-hindsight", *later[:8], 6.0, 4.0)  # 97 s
    plain, defaults = (result(f"sbx-{name}", *later) for name in ("plain", "defaults"))
    assert judged("sbx", ours, first, plain, defaults) == ("5.71 times", "met")
    defaults = result("sbx-defaults", 9.0, 9.0, 6.0, 4.0)  # 37 s
    assert judged("sbx", ours, first, plain, defaults) == ("2.18 times", "NOT MET")


def test_ours_is_the_preset_that_the_target_names():
    results = [result("ours-quick", 9.0, 9.0, 4.0), *others(*[9.0] * 14, 4.0)]
    for more in ([], [result("ours-plain", 4.0)], [result("ours-analytic", 4.0)]):
        assert judged("sbx", *results, *more)[0] == "5.00 times"  # 150 s and 30 s
    told = "ours did not reach it with seed 0"
    assert judged("sbx", result("ours-quick", 6.0), *others(*SLOW)) == (told, "NOT MET")


def test_a_target_of_another_learner_looks_at_that_learner_alone():
    wanted = Target("sbx", 10.0, "ours-analytic")
    results = [result("ours-quick", 9.0, 4.0), *others(*[9.0] * 14, 4.0)]
    assert judge(wanted, results)["measured"] == "not raced: ours-analytic, seed 0"
    row = judge(wanted, [*results, result("ours-analytic", 4.0)])
    assert (row["measured"], row["verdict"]) == ("12.50 times", "met")  # 150 s and 12 s


def test_failures_are_told_and_only_that_of_ours_is_a_target_not_met():
    assert judged("sbx", failed("ours-quick")) == ("ours-quick, seed 0: no network", "NOT MET")
    verdicts = [row["verdict"] for row in summarise([failed("ours-quick")])["targets"]]
    assert verdicts == ["NOT MET", "NOT MET", "skipped"]
    results = [OURS_FAST, *others(*SLOW), failed("ours-analytic"), failed("ours-plain")]
    assert judged("sbx", *results)[1] == "met"
    assert summarise(results)["failed"] == results[-2:]
    results[1] = failed("sbx-hindsight")
    assert judged("sbx", *results) == ("sbx-hindsight, seed 0: no network", "skipped")
    assert judged("sb3-contrib", *results)[1] == "met"


def test_the_median_over_seeds_is_what_counts():
    results = []
    for seed, n in enumerate((6, 3, 7)):  # evaluations until 4 mm
        results += [result("ours-quick", 4.0, seed=seed), *others(*[9.0] * n, 4.0, seed=seed)]
    assert judged("sbx", *results)[0] == "5.83 times"  # (2 + 68) / 12 of seed 0, at 4/5 of its last


def test_tables_have_a_row_for_each_contestant_with_start_up_and_without():
    results = [result("ours-quick", 12.0, 8.0, 4.0), result("ours-plain", 12.0), *others(20.0)]
    figures = summarise(results)
    assert figures["wall_s"][0] == {
        "contestant": "ours-quick",
        "seed": 0,
        "hindsight": True,
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
    assert [row["to_10_mm"] for row in figures["wall_s"][1:]] == ["not within 12"] * 7
    assert [row["hindsight"] for row in figures["wall_s"]] == [True, False] + [True, False, False] * 2
    who = ("contestant", "seed", "commit", "uncommitted_changes")
    assert figures["measured_at"][1] == {name: results[1][name] for name in who}
    json.dumps(figures, allow_nan=False)
