"""What a race gave: times to each level, and the goals.

At each level, ours is the faster of the presets quick and paper, and a peer the fastest of its variants.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness.common import goal
from benchmarks.race.contestants import CONTESTANTS, hindsight_share, tuned_settings
from train.config import PRESETS

LEVELS_MM = (10, 5, 3, 2)
GOAL_MM = 5
GOALS = {"sbx": 5.0, "sb3-contrib": 15.0}  # times our wall time to GOAL_MM
FIRST, OURS, PLAIN = "ours-quick", ("ours-quick", "ours-paper"), ("ours-plain",)
PEERS = {
    library: tuple(f"{library}-{variant}" for variant in ("hindsight", "plain", "defaults"))
    for library in GOALS
}
HINDSIGHT = (*OURS, *(f"{library}-hindsight" for library in GOALS))

Point = Mapping[str, Any]  # of a curve: wall_s, trained_s, env_steps, updates, median_mm (None if not finite)


def crossing(points: Sequence[Point], level_mm: float, axis: str) -> float | None:
    """Where a curve first comes down to a level, linearly between evaluations; None if it does not.

    Args:
        points: of the curve.
        level_mm: of the median tip error.
        axis: `wall_s`, `trained_s` or `env_steps`.
    """
    before = None
    for point in points:
        error_mm = median_mm(point)
        if error_mm <= level_mm:
            if before is None or not math.isfinite(median_mm(before)):
                return point[axis]
            share = (median_mm(before) - level_mm) / (median_mm(before) - error_mm)
            return before[axis] + share * (point[axis] - before[axis])
        before = point
    return None


def median_mm(point: Point) -> float:
    """Of the tip error; infinite where it was not finite."""
    return math.inf if point["median_mm"] is None else point["median_mm"]


def summarise(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Times to each level with start-up and without, env steps, goals, failures, commits, and the curves."""
    ran = [result for result in results if "points" in result]
    return {
        "tuned": _tuned(),
        "levels": _levels(ran),
        "wall_s": [_row(result, "wall_s", result["start_up_s"]) for result in ran],
        "wall_s_without_start_up": [_row(result, "trained_s") for result in ran],
        "env_steps": [_row(result, "env_steps") for result in ran],
        "goals": [judge(library, results) for library in GOALS],
        "not_raced": [
            name for name in CONTESTANTS if name not in {result["contestant"] for result in results}
        ],
        "failed": [
            {name: result[name] for name in ("contestant", "seed", "failed")}
            for result in results
            if "failed" in result
        ],
        "measured_at": [
            {name: result[name] for name in ("contestant", "seed", "commit", "uncommitted_changes")}
            for result in ran
        ],
        "curves": results,
    }


def _tuned() -> dict[str, Any]:
    """What the peers get with hindsight and plain; with their defaults they have one arm.

    The last two are of hindsight.
    """
    config = PRESETS["quick"]
    fastest = config.tqc.learning_rate
    return {
        "arms": config.n_arms,
        "reward_scale": config.tqc.reward_scale,
        **tuned_settings(config, lambda: 0),
        "learning_rate": f"{fastest:g} to {fastest * config.tqc.learning_rate_end:g}",
        "her_ratio": hindsight_share(config),
        "goal_selection_strategy": "future",
    }


def _row(result: Mapping[str, Any], axis: str, start_up_s: float | None = None) -> dict[str, Any]:
    """What a contestant needed for each level; a level that it did not reach says within what."""
    points = result["points"]
    last = points[-1]
    row: dict[str, Any] = {
        "contestant": result["contestant"],
        "seed": result["seed"],
        "hindsight": result["contestant"] in HINDSIGHT,
    }
    if start_up_s is not None:
        row["start_up"] = round(start_up_s, 1)
    for level in LEVELS_MM:
        found = crossing(points, level, axis)
        row[f"to_{level}_mm"] = f"not within {last[axis]:,.0f}" if found is None else round(found, 1)
    return row | {"best_mm": round(min(map(median_mm, points)), 2), "in_all": round(last[axis])}


class Time(NamedTuple):
    """To a level."""

    contestant: str
    wall_s: float
    reached: bool  # otherwise the contestant did not reach it in that time


def times_to(
    level_mm: float, names: Sequence[str], seed: int, results: Sequence[Mapping[str, Any]]
) -> list[Time]:
    """Of those contestants that ran."""
    times = []
    for result in results:
        if result["contestant"] in names and result["seed"] == seed and "points" in result:
            found = crossing(result["points"], level_mm, "wall_s")
            had = result["points"][-1]["wall_s"] if found is None else found
            times.append(Time(result["contestant"], had, found is not None))
    return times


def _missing(
    variants: Sequence[str], seeds: Sequence[int], results: Sequence[Mapping[str, Any]]
) -> list[tuple[str, int]]:
    """Races still to be run: all variants with one seed, and then the best of it with the other seeds."""
    raced = {(result["contestant"], result["seed"]): result for result in results if "points" in result}
    compared = [seed for seed in seeds if all((name, seed) in raced for name in variants)]
    if not compared:
        wanted = [(name, seeds[0]) for name in variants]
    else:
        best = {min(variants, key=lambda name: _standing(raced[name, seed])) for seed in compared}
        wanted = [(name, seed) for seed in seeds for name in variants if name in best]
    return [pair for pair in wanted if pair not in raced]


def _standing(result: Mapping[str, Any]) -> tuple[float, float]:
    """The less, the better: wall time to the goal's level, and the least error."""
    found = crossing(result["points"], GOAL_MM, "wall_s")
    return math.inf if found is None else found, min(map(median_mm, result["points"]))


def _best_of_ours(times: Sequence[Time]) -> Time:
    return min(times, key=lambda time: (not time.reached, time.wall_s))


def _best_of_theirs(times: Sequence[Time]) -> Time:
    """One that was stopped before it reached the level counts with the time that it had."""
    return min(times, key=lambda time: time.wall_s)


def _levels(ran: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row for each seed and level: our time, and the peers' as multiples; also, all without hindsight."""
    comparisons = (
        ("ours", OURS, PEERS),
        ("plain", PLAIN, {library: (f"{library}-plain",) for library in PEERS}),
    )
    rows = []
    for seed in sorted({result["seed"] for result in ran}):
        for level_mm in LEVELS_MM:
            row: dict[str, Any] = {"seed": seed, "level_mm": level_mm}
            for name, ours, peers in comparisons:
                if not (times := times_to(level_mm, ours, seed, ran)):
                    continue
                time = _best_of_ours(times)
                row[name] = time.contestant
                row[f"{name}_s"] = round(time.wall_s, 1) if time.reached else f"not within {time.wall_s:,.0f}"
                for library, variants in peers.items():
                    if theirs := times_to(level_mm, variants, seed, ran):
                        row[f"{library}_of_{name}"] = _ratio(_best_of_theirs(theirs), time)
            rows.append(row)
    return rows


def _ratio(theirs: Time, ours: Time) -> str:
    """How many times as long they took, or more than which; nothing where ours did not get there."""
    if not ours.reached:
        return ""
    return f"{'' if theirs.reached else '> '}{theirs.wall_s / ours.wall_s:.2f}"


def judge(library: str, results: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The goal against a library: how many times our wall time it takes, median over seeds.

    It is judged once all of the library's variants have raced with one seed, since any might be the fastest,
    and the one that did best there with all seeds; with several such seeds, the best of each.
    """
    times = GOALS[library]
    text = f"{library}: wall time to {GOAL_MM} mm, start-up included, at least {times:g} times ours"
    seeds = sorted({result["seed"] for result in results})
    missing = [f"{name}, seed {seed}" for name, seed in _missing(PEERS[library], seeds, results)]
    for result in results:
        if "failed" in result and result["contestant"] in (FIRST, *PEERS[library]):
            told = f"{result['contestant']}, seed {result['seed']}: {result['failed']}"
            return goal(text, told, False if result["contestant"] == FIRST else None)
    ratios, all_reached = [], True
    for seed in seeds:
        ours = _best_of_ours(times_to(GOAL_MM, OURS, seed, results))
        if not ours.reached:
            return goal(text, f"ours did not reach it with seed {seed}", False)
        if not (peers := times_to(GOAL_MM, PEERS[library], seed, results)):
            return goal(text, f"not raced: {'; '.join(missing)}", None)
        theirs = _best_of_theirs(peers)
        ratios.append(theirs.wall_s / ours.wall_s)
        all_reached &= theirs.reached
    ratio = float(np.median(ratios))
    measured = f"{ratio:.2f} times" if all_reached else f"not within {ratio:.2f} times"
    if ratio >= times and missing:
        return goal(text, f"{measured}; not raced: {'; '.join(missing)}", None)
    return goal(text, measured, ratio >= times)
