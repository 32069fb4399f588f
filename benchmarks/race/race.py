"""Wall time and env steps until the median tip error at held-out goals has come down to a level.

The contestants are ours, and TQC of SBX and of Stable-Baselines3-contrib, on the same arms, goals and
evaluation; `contestants` says how each trains. They run one after another, each in a process of its own with
all cores. Ours with the presets quick and analytic go first; analytic trains to the finest level, or to its
end. A peer is stopped when it has reached all levels that quick has, or when its targets are met.

Results stay in the working folder: the same command continues an interrupted race, and seeds may be added.
A target compares one of our presets with a peer: TQC with TQC, and learning through the equilibrium with SBX.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from benchmarks.harness.common import machine_kind, names_of, save, show, status_of, target
from benchmarks.harness.peers import PINS, PeerError, peer_python
from benchmarks.harness.rounds import Facts, Worker, WorkerError
from benchmarks.harness.stages import difference
from benchmarks.race.contestants import CONTESTANTS, library_of
from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import provenance, write_json

N_STRETCHES = 40  # of training between evaluations, up to a peer's limit
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


class RaceLimits(NamedTuple):
    """End of a contestant's training, whichever comes first."""

    wall_s: float = math.inf  # start-up included, evaluations not
    target_mm: float = 0.0  # median tip error
    stretch_s: float = 0.0  # of training between evaluations, not a limit


def race(
    seeds: cli.Integers = (0,),
    only: Annotated[tuple[str, ...], names_of(CONTESTANTS)] = CONTESTANTS,
    out: cli.MaybePath = None,
) -> int:
    """How long does learning take to a tip error, beside SBX and sb3-contrib? Half an hour a seed.

    Args:
        seeds: of training
        only: contestants, beside ours-quick and those with results in the folder
        out: working folder; None: runs/race

    Raises:
        InputError: ours-quick failed, or the folder has results of other conditions.
    """
    figures = summarise(run(out or Path("runs/race"), seeds, only))
    show({name: value for name, value in figures.items() if name != "curves"}, "race")
    if any(row["contestant"] == FIRST for row in figures["failed"]):
        raise InputError(f"{FIRST}: got a failure, expected a result, without which there is no race")
    print(f"written: {save('race', figures)}")
    return status_of(figures)


def run(folder: Path, seeds: Sequence[int], names: Sequence[str], n_goals: int = 2_000) -> list[Facts]:
    """Return the results of the contestants, and of others that the folder has; missing ones are measured.

    One that fails has `failed` in place of points. If it is the first of a seed, that seed has no others:
    their limits follow from it.

    Raises:
        InputError: a result in the folder was measured under other conditions.
    """
    folder.mkdir(parents=True, exist_ok=True)
    results = []
    for seed in seeds:
        first = _result(folder, FIRST, seed, RaceLimits(), n_goals)
        ours = [first]
        results.append(first)
        for name in CONTESTANTS:
            wanted = name in names or _file(folder, name, seed).exists()
            if name != FIRST and wanted and "failed" not in first:
                found = _result(folder, name, seed, limits_of(name, ours), n_goals)
                results.append(found)
                ours += [found] * name.startswith("ours")
    return results


def limits_of(name: str, ours: Sequence[Facts]) -> RaceLimits:
    """Return a contestant's limits, by the curves of ours that raced before it, quick's first."""
    reached_mm = [level for level in LEVELS_MM if crossing(ours[0]["points"], level, "wall_s") is not None]
    times_s = {
        raced["contestant"]: crossing(raced["points"], TARGET_MM, "wall_s") or raced["points"][-1]["wall_s"]
        for raced in ours
        if "points" in raced
    }
    peer = "sbx-hindsight" if name == "ours-analytic" else name  # ours is evaluated as often as SBX
    wall_s = max(
        wanted.times * times_s[wanted.ours]
        for wanted in TARGETS
        if wanted.peer == peer and wanted.ours in times_s
    )
    if name != peer:
        return RaceLimits(target_mm=min(LEVELS_MM), stretch_s=wall_s / N_STRETCHES)
    return RaceLimits(wall_s, min(reached_mm, default=0), wall_s / N_STRETCHES)


def _file(folder: Path, name: str, seed: int) -> Path:
    return folder / f"{name}-seed{seed}.json"


def _result(folder: Path, name: str, seed: int, limits: RaceLimits, n_goals: int) -> dict[str, Any]:
    """Return the result of one contestant, measured now or before."""
    file, who = _file(folder, name, seed), f"{name}, seed {seed}"
    # Take a result in the folder if it was measured under the same conditions.
    made = provenance("benchmarks")
    conditions: dict[str, Any] = {
        "n_goals": n_goals,
        "peers": {library: list(packages) for library, packages in PINS.items()},
        "packages": made["packages"],
        "machine": machine_kind(),
        "commit": made["commit"],
    }
    if file.exists():
        result = json.loads(file.read_text("utf-8"))
        if differing := difference(result.get("conditions", {}), conditions):
            raise InputError(f"{file}: {differing}; choose another --out, or remove the file")
        print(f"{who}: measured before, in {file}")
        return result
    # Measure a missing one; ours runs in this environment, a peer in its own.
    program = ["benchmarks.race.contestants", name, str(seed), str(limits.stretch_s), str(n_goals)]
    result = {"contestant": name, "seed": seed, "conditions": conditions}
    result |= {key: made[key] for key in ("commit", "uncommitted_changes")}
    try:
        ours = name.startswith("ours")
        worker = Worker(who, program, None if ours else peer_python(library_of(name)))
        result |= train(worker, limits)
    except (PeerError, WorkerError) as error:
        print(f"{who}: failed: {error}", file=sys.stderr)
        return {**result, "failed": str(error)}
    write_json(file, result)
    return result


def train(worker: Worker, limits: RaceLimits) -> dict[str, Any]:
    """Let a contestant train until its end or a limit; returns start-up time, time limit and curve."""
    limit_s = limits.wall_s if math.isfinite(limits.wall_s) else None
    until = f" up to {limit_s:.0f} s," if limit_s else ""
    print(f"{worker.name}:{until} evaluations not counted ...", flush=True)
    points: list[Facts] = []
    ended = False
    try:
        worker.start()
        while not ended:
            point = worker.round()
            ended = point.pop("ended")
            points.append(point)
            error_mm = median_mm(point)
            done = f"{point['env_steps']:,} env steps, {point['updates']:,} updates"
            print(f"{worker.name}: {point['wall_s']:.0f} s, {done}, median {error_mm:.2f} mm", flush=True)
            ended |= point["wall_s"] >= limits.wall_s or error_mm <= limits.target_mm
    finally:
        worker.close()
    return {"start_up_s": worker.facts["start_up_s"], "limit_s": limit_s, "points": points}


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
            failure = f"{result['contestant']}, seed {result['seed']}: {result['failed']}"
            return target(text, failure, False if result["contestant"] == ours else None)
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
