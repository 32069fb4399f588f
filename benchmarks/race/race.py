"""Wall time and env steps until the median tip error at held-out goals has come down to a level.

`contestants` says how each trains. They run one after another, in processes of their own with all cores: our
presets first, then TQC of SBX and of Stable-Baselines3-contrib on the same arms and goals. A peer is stopped
when it has reached all levels that quick has, or when its targets are met.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness.common import grouped, machine_kind, save, show, status_of, target
from benchmarks.harness.peers import PINS, peer_python
from benchmarks.harness.rounds import Facts, Worker
from benchmarks.harness.stages import claim
from benchmarks.race.contestants import CONTESTANTS, library_of
from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import provenance, write_json

N_STRETCHES = 40  # of training between evaluations, up to a peer's limit
N_GOALS = 2_000
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


class RaceLimits(NamedTuple):
    """End of a contestant's training, whichever comes first."""

    wall_s: float = math.inf  # start-up included, evaluations not
    target_mm: float = 0.0  # median tip error
    stretch_s: float = 0.0  # of training between evaluations, not a limit


def race(seeds: cli.Integers = (0,), out: Path = Path("runs/race")) -> int:
    """How long does learning take to a tip error, beside SBX and sb3-contrib? Half an hour a seed.

    Args:
        seeds: of training
        out: working folder: the same command continues, and seeds may be added
    """
    made = provenance("benchmarks")
    conditions = {name: made[name] for name in ("packages", "commit")}
    claim(out, {"n_goals": N_GOALS, "peers": PINS, "machine": machine_kind(), **conditions})
    figures = summarise([result for seed in seeds for result in run(out, seed)])
    show({name: value for name, value in figures.items() if name != "curves"}, "race")
    print(f"written: {save('race', figures)}")
    return status_of(figures)


def run(folder: Path, seed: int) -> list[Facts]:
    """Return the results of all contestants; those that the folder lacks are measured.

    A peer that fails has `failed` in place of points; one of ours raises its error.
    """
    results: list[Facts] = []
    for name in CONTESTANTS:
        file, who, ours = folder / f"{name}-seed{seed}.json", f"{name}, seed {seed}", name.startswith("ours")
        if file.exists():
            results.append(json.loads(file.read_text("utf-8")))
            continue
        limits = limits_of(name, [result for result in results if result["contestant"].startswith("ours")])
        program = ["benchmarks.race.contestants", name, str(seed), str(limits.stretch_s), str(N_GOALS)]
        result = {"contestant": name, "seed": seed}
        try:
            python = None if ours else peer_python(library_of(name))
            result |= train(Worker(who, program, python), limits)
            write_json(file, result)
        except InputError as error:
            if ours:
                raise
            print(f"{who}: failed: {error}")
            result["failed"] = str(error)
        results.append(result)
    return results


def limits_of(name: str, ours: Sequence[Facts]) -> RaceLimits:
    """Return a contestant's limits, by the curves of ours that raced before it, quick's first."""
    if not ours:
        return RaceLimits()
    quick = ours[0]["points"]
    reached_mm = [level for level in LEVELS_MM if crossing(quick, level, "wall_s") is not None]
    times_s = {
        raced["contestant"]: crossing(raced["points"], TARGET_MM, "wall_s") or raced["points"][-1]["wall_s"]
        for raced in ours
    }
    peer = "sbx-hindsight" if name == "ours-analytic" else name  # ours is evaluated as often as SBX
    wall_s = max(wanted.times * times_s.get(wanted.ours, 0.0) for wanted in TARGETS if wanted.peer == peer)
    if name == "ours-analytic":
        return RaceLimits(target_mm=min(LEVELS_MM), stretch_s=wall_s / N_STRETCHES)
    return RaceLimits(wall_s, min(reached_mm, default=0), wall_s / N_STRETCHES)


def train(worker: Worker, limits: RaceLimits) -> dict[str, Any]:
    """Let a contestant train until its end or a limit; returns start-up time, time limit and curve.

    A point of the curve has wall_s, trained_s, env_steps, updates and median_mm, None if it is not finite.
    """
    limit_s = limits.wall_s if math.isfinite(limits.wall_s) else None
    print(f"{worker.name}: up to {limits.wall_s:.0f} s, evaluations not counted ...", flush=True)
    points: list[Facts] = []
    ended = False
    with closing(worker):
        worker.start()
        while not ended:
            point = worker.round()
            ended = point.pop("ended")
            points.append(point)
            error_mm = median_mm(point)
            done = f"{point['env_steps']:,} env steps, {point['updates']:,} updates"
            print(f"{worker.name}: {point['wall_s']:.0f} s, {done}, median {error_mm:.2f} mm", flush=True)
            ended |= point["wall_s"] >= limits.wall_s or error_mm <= limits.target_mm
    return {"start_up_s": worker.facts["start_up_s"], "limit_s": limit_s, "points": points}


def crossing(points: Sequence[Facts], level_mm: float, axis: str) -> float | None:
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


def median_mm(point: Facts) -> float:
    """Return the median tip error; infinite where it was not finite."""
    return math.inf if point["median_mm"] is None else point["median_mm"]


def summarise(results: Sequence[Facts]) -> dict[str, Any]:
    """Return times to each level with start-up and without, targets, failures and the curves."""
    ran = [result for result in results if "points" in result]
    return {
        "wall_s": [_row(result, "wall_s") for result in ran],
        "wall_s_without_start_up": [_row(result, "trained_s") for result in ran],
        "targets": [judge(wanted, results) for wanted in TARGETS],
        "failed": [result for result in results if "failed" in result],
        "curves": results,
    }


def _row(result: Facts, axis: str) -> dict[str, Any]:
    """Return a contestant's time to each level; for a missed level, the time that it had."""
    points = result["points"]
    last = points[-1][axis]
    row = {key: result[key] for key in ("contestant", "seed", "start_up_s")}
    for level in LEVELS_MM:
        time_s = crossing(points, level, axis)
        row[f"to_{level}_mm"] = f"not within {last:,.0f}" if time_s is None else round(time_s, 1)
    return row | {"best_mm": round(min(map(median_mm, points)), 2), "in_all": round(last)}


def judge(wanted: PeerTarget, results: Sequence[Facts]) -> dict[str, str]:
    """Judge how many times our wall time a peer takes, median over seeds.

    One that was stopped before the level counts with the time that it had, which may show nothing.
    """
    peer, times, ours = wanted
    text = f"{peer}: wall time to {TARGET_MM} mm, with start-up, at least {times:g} times that of {ours}"
    ratios, all_reached = [], True
    for (seed,), raced in grouped(results, ("seed",)).items():
        curves: dict[str, Any] = {result["contestant"]: result.get("points") for result in raced}
        if not curves[peer]:
            return target(text, f"{peer}, seed {seed}: failed", None)
        ours_s, theirs_s = (crossing(curves[name], TARGET_MM, "wall_s") for name in (ours, peer))
        if ours_s is None:
            return target(text, f"ours did not reach it with seed {seed}", False)
        all_reached &= theirs_s is not None
        ratios.append((theirs_s or curves[peer][-1]["wall_s"]) / ours_s)
    ratio = float(np.median(ratios))
    met = None if ratio < times and not all_reached else ratio >= times
    return target(text, f"{'' if all_reached else 'not within '}{ratio:.2f} times", met)
