"""Results of a race: times to each level, and the targets.

A target compares one of our presets with the fastest variant of a peer: TQC with TQC, and learning through
the equilibrium with SBX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness.common import target
from benchmarks.race.contestants import CONTESTANTS

LEVELS_MM = (10, 5, 3, 2, 1)
TARGET_MM = 5
FIRST = "ours-quick"
PEERS = {
    library: tuple(f"{library}-{variant}" for variant in ("hindsight", "plain", "defaults"))
    for library in ("sbx", "sb3-contrib")
}


class Target(NamedTuple):
    """A library's wall time to TARGET_MM, as a multiple of that of one of ours."""

    library: str
    times: float
    ours: str = FIRST


TARGETS = (Target("sbx", 5.0), Target("sb3-contrib", 15.0), Target("sbx", 20.0, "ours-analytic"))

Result = Mapping[str, Any]  # of a contestant with a seed
Point = Mapping[str, Any]  # of a curve: wall_s, trained_s, env_steps, updates, median_mm (None if not finite)


def crossing(points: Sequence[Point], level_mm: float, axis: str) -> float | None:
    """Return where on an axis a curve first comes down to a level, linearly between evaluations, or None."""
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
    """Return the median tip error; infinite where it was not finite."""
    return math.inf if point["median_mm"] is None else point["median_mm"]


def summarise(results: Sequence[Result]) -> dict[str, Any]:
    """Return times to each level with start-up and without, env steps, targets, failures and the curves."""
    ran = [result for result in results if "points" in result]
    who = ("contestant", "seed")
    return {
        "wall_s": [_row(result, "wall_s") for result in ran],
        "wall_s_without_start_up": [_row(result, "trained_s") for result in ran],
        "env_steps": [_row(result, "env_steps") for result in ran],
        "targets": [judge(wanted, results) for wanted in TARGETS],
        "not_raced": [name for name in CONTESTANTS if name not in {r["contestant"] for r in results}],
        "failed": [{key: r[key] for key in (*who, "failed")} for r in results if "failed" in r],
        "measured_at": [{key: r[key] for key in (*who, "commit", "uncommitted_changes")} for r in ran],
        "curves": results,
    }


def _row(result: Result, axis: str) -> dict[str, Any]:
    """Return what a contestant needed for each level; a level that it did not reach says within what."""
    name, points = result["contestant"], result["points"]
    last = points[-1][axis]
    row = {"contestant": name, "seed": result["seed"], "hindsight": name == FIRST or "hindsight" in name}
    if axis == "wall_s":
        row["start_up"] = round(result["start_up_s"], 1)
    for level in LEVELS_MM:
        found = crossing(points, level, axis)
        row[f"to_{level}_mm"] = f"not within {last:,.0f}" if found is None else round(found, 1)
    return row | {"best_mm": round(min(map(median_mm, points)), 2), "in_all": round(last)}


def _time(result: Result) -> tuple[bool, float]:
    """Return whether a contestant missed the target's level, and its wall time there, or in all."""
    found = crossing(result["points"], TARGET_MM, "wall_s")
    return found is None, result["points"][-1]["wall_s"] if found is None else found


def judge(wanted: Target, results: Sequence[Result]) -> dict[str, str]:
    """Judge a target: how many times our wall time a library takes, median over seeds.

    A peer that was stopped before the level counts with the time that it had. The target is judged once all
    variants of the library, any of which might be the fastest, have raced with one seed, and the one that did
    best there with all seeds; with several such seeds, the best of each.
    """
    library, times, ours = wanted
    text = f"{library}: wall time to {TARGET_MM} mm, with start-up, at least {times:g} times that of {ours}"
    for result in results:
        if "failed" in result and result["contestant"] in (ours, *PEERS[library]):
            told = f"{result['contestant']}, seed {result['seed']}: {result['failed']}"
            return target(text, told, False if result["contestant"] == ours else None)
    raced = {(result["contestant"], result["seed"]): result for result in results if "points" in result}
    if not raced:
        return target(text, f"not raced: {ours}", None)
    missing, ratios, all_reached = _missing(PEERS[library], raced), [], True
    for seed in sorted({seed for _, seed in raced}):
        theirs = [_time(raced[name, seed]) for name in PEERS[library] if (name, seed) in raced]
        if (ours, seed) not in raced:
            return target(text, f"not raced: {ours}, seed {seed}", None)
        ours_missed, ours_s = _time(raced[ours, seed])
        if ours_missed:
            return target(text, f"ours did not reach it with seed {seed}", False)
        if not theirs:
            return target(text, f"not raced: {missing}", None)
        they_missed, their_s = min(theirs, key=lambda time: time[1])
        ratios.append(their_s / ours_s)
        all_reached &= not they_missed
    ratio = float(np.median(ratios))
    measured = f"{ratio:.2f} times" if all_reached else f"not within {ratio:.2f} times"
    if ratio >= times and missing:
        return target(text, f"{measured}; not raced: {missing}", None)
    return target(text, measured, ratio >= times)


def _missing(variants: Sequence[str], raced: Mapping[tuple[str, int], Result]) -> str:
    """Return the races still to be run: all variants with one seed, the best of it with the other seeds."""
    seeds = sorted({seed for _, seed in raced})
    compared = [seed for seed in seeds if all((name, seed) in raced for name in variants)]

    def standing(who: tuple[str, int]) -> tuple[bool, float]:
        missed, wall_s = _time(raced[who])
        return missed, min(map(median_mm, raced[who]["points"])) if missed else wall_s

    best = {min(((name, seed) for name in variants), key=standing)[0] for seed in compared}
    expected = [(name, seed) for seed in seeds for name in variants if name in best]
    if not compared:
        expected = [(name, seeds[0]) for name in variants]
    return "; ".join(f"{name}, seed {seed}" for name, seed in expected if (name, seed) not in raced)
