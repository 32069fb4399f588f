"""What a race gave: times to each level, and the goals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.common import goal
from benchmarks.race_contestants import tuned_settings
from train.config import PRESETS

LEVELS_MM = (10, 5, 3, 2)
GOAL_MM = 5
GOALS = {"sbx": 5.0, "sb3-contrib": 15.0}  # times our wall time to GOAL_MM
VARIANTS = ("tuned", "defaults")

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
    """Times to each level with start-up and without, env steps, goals, failures, and the curves."""
    ran = [result for result in results if "points" in result]
    return {
        "tuned": _tuned(),
        "wall_s": [_row(result, "wall_s", result["start_up_s"]) for result in ran],
        "wall_s_without_start_up": [_row(result, "trained_s") for result in ran],
        "env_steps": [_row(result, "env_steps") for result in ran],
        "goals": [judge(library, results) for library in GOALS],
        "failed": [
            {name: result[name] for name in ("contestant", "seed", "failed")}
            for result in results
            if "failed" in result
        ],
        "curves": results,
    }


def _tuned() -> dict[str, Any]:
    """What the tuned peers get; with their defaults they have one arm."""
    config = PRESETS["quick"]
    fastest = config.tqc.learning_rate
    return {
        "arms": config.n_arms,
        "reward_scale": config.tqc.reward_scale,
        **tuned_settings(config, lambda: 0),
        "learning_rate": f"{fastest:g} to {fastest * config.tqc.learning_rate_end:g}",
    }


def _row(result: Mapping[str, Any], axis: str, start_up_s: float | None = None) -> dict[str, Any]:
    """What a contestant needed for each level; a level that it did not reach says within what."""
    points = result["points"]
    last = points[-1]
    row: dict[str, Any] = {"contestant": result["contestant"], "seed": result["seed"]}
    if start_up_s is not None:
        row["start_up"] = round(start_up_s, 1)
    for level in LEVELS_MM:
        found = crossing(points, level, axis)
        row[f"to_{level}_mm"] = f"not within {last[axis]:,.0f}" if found is None else round(found, 1)
    return row | {"best_mm": round(min(map(median_mm, points)), 2), "in_all": round(last[axis])}


def judge(library: str, results: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The goal against a library: how many times our wall time its better variant takes, median over seeds.

    A variant that was stopped before it reached the level counts with the time it had.
    """
    times = GOALS[library]
    text = f"{library}: wall time to {GOAL_MM} mm, start-up included, at least {times:g} times ours"
    names = [f"{library}-{variant}" for variant in VARIANTS]
    failed = [result for result in results if result["contestant"] in names and "failed" in result]
    if failed:
        return goal(text, f"{failed[0]['contestant']}: {failed[0]['failed']}", None)
    ratios, all_reached = [], True
    for first in (result for result in results if result["contestant"] == "ours"):
        ours_s = crossing(first["points"], GOAL_MM, "wall_s")
        if ours_s is None:
            return goal(text, f"ours did not reach it with seed {first['seed']}", False)
        theirs = [r for r in results if r["contestant"] in names and r["seed"] == first["seed"]]
        reached = [crossing(result["points"], GOAL_MM, "wall_s") for result in theirs]
        had = [
            result["points"][-1]["wall_s"] if time_s is None else time_s
            for result, time_s in zip(theirs, reached, strict=True)
        ]
        better = int(np.argmin(had))
        ratios.append(had[better] / ours_s)
        all_reached &= reached[better] is not None
    ratio = float(np.median(ratios))
    measured = f"{ratio:.2f} times" if all_reached else f"not within {ratio:.2f} times"
    return goal(text, measured, ratio >= times)
