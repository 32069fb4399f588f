"""What a race gave: curves with known crossings, the better of ours and of theirs, goals, tables."""

import json

import pytest

from benchmarks.race.contestants import CONTESTANTS
from benchmarks.race.summary import OURS, PEERS, PLAIN, crossing, judge, summarise


def curve(*errors_mm):
    """A point each 10 s."""
    return [
        {
            "wall_s": 2.0 + 10 * k,
            "trained_s": 10.0 * k,
            "env_steps": 100 * k,
            "updates": k,
            "median_mm": error_mm,
        }
        for k, error_mm in enumerate(errors_mm, 1)
    ]


def result(name, *errors_mm, seed=0):
    return {
        "contestant": name,
        "seed": seed,
        "start_up_s": 2.0,
        "limit_s": None,
        "commit": "a1b2",
        "uncommitted_changes": False,
        "points": curve(*errors_mm),
    }


# --- curves ------------------------------------------------------------------------------------------------


def test_a_level_is_reached_where_the_line_between_two_evaluations_crosses_it_first():
    points = curve(20.0, 12.0, 8.0, 11.0, 4.0)
    assert crossing(points, 10, "wall_s") == pytest.approx(27.0)  # half way from 22 to 32
    assert crossing(points, 8, "trained_s") == pytest.approx(30.0)
    assert crossing(points, 5, "env_steps") == pytest.approx(400 + 100 * 6 / 7)
    assert crossing(points, 3, "wall_s") is None


def test_a_curve_that_begins_below_a_level_has_it_at_its_first_evaluation():
    assert crossing(curve(4.0, 3.0), 5, "wall_s") == 12.0


def test_errors_that_are_not_finite_reach_nothing():
    assert crossing(curve(None, None), 10, "wall_s") is None
    assert crossing(curve(20.0, None, 4.0), 5, "wall_s") == 32.0  # nothing to draw the line from


# --- goals -------------------------------------------------------------------------------------------------


def others(*errors_mm):
    """All variants of both peers, which need as long as the curve says."""
    return [result(name, *errors_mm) for variants in PEERS.values() for name in variants]


def test_a_goal_is_met_only_once_all_variants_have_raced():
    results = [result("ours-quick", 4.0), *others(*[9.0] * 30)]
    assert judge("sbx", results)["verdict"] == "met"
    assert summarise(results)["not_raced"] == ["ours-plain", "ours-paper"]
    some = [one for one in results if one["contestant"] != "sbx-defaults"]
    row = judge("sbx", some)
    assert row["measured"] == judge("sbx", results)["measured"] + "; not raced: sbx-defaults, seed 0"
    assert row["verdict"] == "skipped"
    assert judge("sb3-contrib", some) == judge("sb3-contrib", results)
    slow = [result("ours-quick", 4.0), result("sbx-plain", 9.0, 4.0)]
    assert judge("sbx", slow)["verdict"] == "NOT MET"  # others could only be faster


@pytest.mark.parametrize(
    "best, errors_mm", [("sbx-plain", [8.0] * 30), ("sbx-hindsight", [9.0] * 29 + [4.0])]
)
def test_the_variant_that_does_best_where_all_race_must_race_with_all_seeds(best, errors_mm):
    """It is the first at the level, or where none comes there, the closest."""
    results = [result("ours-quick", 4.0), *(result(name, *[9.0] * 30) for name in PEERS["sbx"])]
    results[1 + PEERS["sbx"].index(best)] = result(best, *errors_mm)
    results += [result("ours-quick", 4.0, seed=1)]
    row = judge("sbx", [*results, result("sbx-defaults", *[9.0] * 30, seed=1)])
    assert row["measured"].endswith(f"times; not raced: {best}, seed 1") and row["verdict"] == "skipped"
    row = judge("sbx", [*results, result(best, *[9.0] * 30, seed=1)])
    assert row["verdict"] == "met" and "not raced" not in row["measured"]
    other = "sbx-defaults"  # the best with seed 1, where all race, too
    results += [result(name, *[9.0] * 30, seed=1) for name in PEERS["sbx"] if name != other]
    results += [result(other, *[7.0] * 30, seed=1), result("ours-quick", 4.0, seed=2)]
    assert judge("sbx", [*results, result(best, *[9.0] * 30, seed=2)])["measured"].endswith(
        f"raced: {other}, seed 2"
    )


def test_without_a_seed_with_which_all_have_raced_the_first_is_asked_for():
    results = [result("ours-quick", 4.0, seed=seed) for seed in (0, 1)]
    results += [result("sbx-plain", *[9.0] * 30, seed=seed) for seed in (0, 1)]
    assert judge("sbx", results)["measured"].endswith(
        "not raced: sbx-hindsight, seed 0; sbx-defaults, seed 0"
    )


def test_a_library_that_did_not_race_is_skipped():
    results = [result("ours-quick", 4.0), result("sbx-plain", 9.0, 4.0)]
    goals = {row["goal"].split(":")[0]: row for row in summarise(results)["goals"]}
    assert goals["sb3-contrib"]["verdict"] == "skipped"
    assert goals["sb3-contrib"]["measured"].startswith("not raced: sb3-contrib-hindsight, seed 0; ")


def test_a_goal_is_met_by_the_better_variant_s_time_over_ours():
    ours = result("ours-quick", 6.0, 4.0)  # 5 mm at 17 s
    slow = [9.0] * 8
    results = [ours] + [result(name, *slow, 9.0, 9.0, 9.0) for name in PEERS["sbx"]]
    results[1] = result(PEERS["sbx"][0], *slow, 6.0, 4.0)
    row = judge("sbx", results)  # 97 s against 17 s
    assert (row["measured"], row["verdict"]) == ("5.71 times", "met")
    assert "5 mm" in row["goal"] and "at least 5 times" in row["goal"]
    results[2] = result("sbx-defaults", 9.0, 9.0, 6.0, 4.0)  # 37 s
    assert judge("sbx", results)["measured"] == "2.18 times"
    assert judge("sbx", results)["verdict"] == "NOT MET"


def test_a_peer_that_was_stopped_counts_with_the_time_that_it_had():
    row = judge("sbx", [result("ours-quick", 4.0), *others(*[9.0] * 6)])  # 62 s against 12 s
    assert (row["measured"], row["verdict"]) == ("not within 5.17 times", "met")
    row = judge("sb3-contrib", [result("ours-quick", 4.0), *others(*[9.0] * 6)])
    assert (row["measured"], row["verdict"]) == ("not within 5.17 times", "NOT MET")


def test_a_goal_that_ours_does_not_reach_is_not_met():
    row = judge("sbx", [result("ours-quick", 6.0), *others(*[9.0] * 60)])
    assert row["verdict"] == "NOT MET" and "ours did not reach it with seed 0" in row["measured"]


def failed(name):
    return {"contestant": name, "seed": 0, "failed": "no network"}


def test_ours_is_the_better_of_two_presets_and_never_the_one_without_hindsight():
    results = [result("ours-quick", 9.0, 9.0, 4.0), *others(*[9.0] * 14, 4.0)]
    assert judge("sbx", results)["measured"] == "5.00 times"  # 150 s and 30 s
    results.append(result("ours-plain", 4.0))
    assert judge("sbx", results)["measured"] == "5.00 times"
    results.append(result("ours-paper", 9.0, 9.0, 9.0, 4.0))
    assert judge("sbx", results)["measured"] == "5.00 times"
    results[-1] = result("ours-paper", 9.0, 4.0)
    assert judge("sbx", results)["measured"] == "7.50 times"


def test_ours_failing_is_a_goal_not_met_unless_another_of_ours_ran():
    results = [failed("ours-quick")]
    assert judge("sbx", results)["verdict"] == "NOT MET"
    assert judge("sbx", results)["measured"] == "ours-quick, seed 0: no network"
    results = [result("ours-quick", 4.0), *others(*[9.0] * 60), failed("ours-paper"), failed("ours-plain")]
    assert judge("sbx", results)["verdict"] == "met"
    assert summarise(results)["failed"] == results[-2:]


def test_a_goal_is_skipped_where_a_variant_failed_and_says_why():
    results = [result("ours-quick", 4.0), *others(*[9.0] * 60)]
    results[1] = failed("sbx-hindsight")
    assert judge("sbx", results)["verdict"] == "skipped"
    assert judge("sbx", results)["measured"] == "sbx-hindsight, seed 0: no network"
    assert judge("sb3-contrib", results)["verdict"] == "met"
    assert summarise(results)["failed"] == [results[1]]


def test_the_median_over_seeds_is_what_counts():
    times = {0: 6, 1: 3, 2: 7}  # evaluations until 4 mm
    results = [result("ours-quick", 4.0, seed=seed) for seed in times]
    for seed, n in times.items():
        results += [result(name, *[9.0] * n, 4.0, seed=seed) for name in PEERS["sbx"]]
    assert judge("sbx", results)["measured"] == "5.83 times"  # (2 + 68) / 12 of seed 0, at 4/5 of its last


def test_tables_have_a_row_for_each_contestant_with_start_up_and_without():
    figures = summarise([result("ours-quick", 12.0, 8.0, 4.0), *others(20.0)])
    assert figures["wall_s"][0] == {
        "contestant": "ours-quick",
        "seed": 0,
        "hindsight": True,
        "start_up": 2.0,
        "to_10_mm": 17.0,
        "to_5_mm": 29.5,
        "to_3_mm": "not within 32",
        "to_2_mm": "not within 32",
        "best_mm": 4.0,
        "in_all": 32,
    }
    assert figures["wall_s_without_start_up"][0]["to_10_mm"] == 15.0
    assert figures["env_steps"][0]["to_5_mm"] == 275.0
    assert [row["to_10_mm"] for row in figures["wall_s"][1:]] == ["not within 12"] * 6
    json.dumps(figures, allow_nan=False)


def test_the_figures_say_who_has_hindsight_and_at_what_commit_each_was_measured():
    figures = summarise([result("ours-quick", 4.0), result("ours-plain", 4.0), *others(9.0)])
    assert [row["hindsight"] for row in figures["wall_s"]] == [True, False] + [True, False, False] * 2
    assert figures["measured_at"][1] == {
        "contestant": "ours-plain",
        "seed": 0,
        "commit": "a1b2",
        "uncommitted_changes": False,
    }


def test_every_contestant_is_ours_or_a_peer_s():
    names = [*OURS, *PLAIN, *(name for variants in PEERS.values() for name in variants)]
    assert sorted(names) == sorted(CONTESTANTS)
