"""Results of a race: times to each level, and the targets.

A target compares one of our presets with a peer: TQC with TQC, and learning through the equilibrium with SBX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness.common import target

LEVELS_MM = (10, 5, 3, 2, 1)
TARGET_MM = 5
FIRST = "ours-quick"


class PeerTarget(NamedTuple):
    """A peer's wall time to TARGET_MM, as a multiple of that of one of ours."""

    peer: str
    times: float
    ours: str = FIRST


TARGETS = (
    PeerTarget("sbx-hindsight", 5.0),
    PeerTarget("sb3-contrib-hindsight", 15.0),
    PeerTarget("sbx-hindsight", 20.0, "ours-analytic"),
)

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
    return {
        "wall_s": [_row(result, "wall_s") for result in ran],
        "wall_s_without_start_up": [_row(result, "trained_s") for result in ran],
        "env_steps": [_row(result, "env_steps") for result in ran],
        "targets": [judge(wanted, results) for wanted in TARGETS],
        "failed": [
            {key: r[key] for key in ("contestant", "seed", "failed")} for r in results if "failed" in r
        ],
        "curves": results,
    }


def _row(result: Result, axis: str) -> dict[str, Any]:
    """Return a contestant's time or env steps to each level; for a missed level, the limit that it had."""
    points = result["points"]
    last = points[-1][axis]
    row = {key: result[key] for key in ("contestant", "seed")}
    if axis == "wall_s":
        row["start_up"] = round(result["start_up_s"], 1)
    for level in LEVELS_MM:
        found = crossing(points, level, axis)
        row[f"to_{level}_mm"] = f"not within {last:,.0f}" if found is None else round(found, 1)
    return row | {"best_mm": round(min(map(median_mm, points)), 2), "in_all": round(last)}


def judge(wanted: PeerTarget, results: Sequence[Result]) -> dict[str, str]:
    """Judge a target: how many times our wall time a peer takes, median over seeds.

    A peer that was stopped before the level counts with the time that it had, which may show nothing.
    """
    peer, times, ours = wanted
    text = f"{peer}: wall time to {TARGET_MM} mm, with start-up, at least {times:g} times that of {ours}"
    for result in results:
        if "failed" in result and result["contestant"] in (ours, peer):
            told = f"{result['contestant']}, seed {result['seed']}: {result['failed']}"
            return target(text, told, False if result["contestant"] == ours else None)
    curves: dict[tuple[str, int], Any] = {(r["contestant"], r["seed"]): r.get("points") for r in results}
    ratios, all_reached = [], True
    for seed in sorted({seed for _, seed in curves}):
        missing = [name for name in (ours, peer) if (name, seed) not in curves]
        if missing:
            return target(text, f"not raced: {' and '.join(missing)}, seed {seed}", None)
        ours_s, theirs_s = (crossing(curves[name, seed], TARGET_MM, "wall_s") for name in (ours, peer))
        if ours_s is None:
            return target(text, f"ours did not reach it with seed {seed}", False)
        all_reached &= theirs_s is not None
        ratios.append((theirs_s or curves[peer, seed][-1]["wall_s"]) / ours_s)
    ratio = float(np.median(ratios))
    met = None if ratio < times and not all_reached else ratio >= times
    return target(text, f"{'' if all_reached else 'not within '}{ratio:.2f} times", met)
