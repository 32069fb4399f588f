"""How long until a policy reaches, against the peers: `python -m benchmarks race [--only NAMES] [--smoke]`.

Wall time and env steps until the median tip error at the held-out goals is so many millimetres: ours, and TQC
of SBX and of Stable-Baselines3-contrib on the same arms, goals and evaluation.
`benchmarks.race.contestants` says how each trains. One after another, each in a process of its own with all
cores. A level is reached where the line between two evaluations crosses it for the first time.

Ours with the preset quick goes first. A peer is stopped when it has had as many times its time to 5 mm as the
goal asks for, since the goal is met then, or when it has reached all that ours has; ours-plain has as long as
SBX, or its preset's env steps. The preset paper, which is for the finer levels, trains to the finest or to
its end. What is measured stays in the working folder: started again, an interrupted benchmark goes on, and
seeds may be added; another commit or kind of machine wants another folder.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.harness.common import machine_kind, save, show
from benchmarks.harness.options import numbers
from benchmarks.harness.peers import PINS, PeerError, peer_python
from benchmarks.harness.rounds import Worker, WorkerError
from benchmarks.race.contestants import CONTESTANTS
from benchmarks.race.summary import (
    FIRST,
    GOAL_MM,
    GOALS,
    LEVELS_MM,
    PEERS,
    Point,
    crossing,
    median_mm,
    summarise,
)
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import provenance, write_json

N_STRETCHES = 40  # of training between evaluations, up to a peer's limit
SETTINGS_FILE = "settings.json"


class Limits(NamedTuple):
    """What ends a contestant's training, whichever comes first, its own end besides."""

    wall_s: float = math.inf  # start-up included and evaluations not
    target_mm: float = 0.0  # median tip error
    stretch_s: float = 0.0  # of training between evaluations, not a limit


class RaceError(InputError):
    """The race cannot be run in this folder; the message says why."""


@dataclass(frozen=True)
class Settings:
    """How large."""

    n_goals: int = 2_000
    n_points: int = 1_000_000  # evaluations of each contestant at most


SMOKE = Settings(n_goals=64, n_points=3)


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; returns the exit status: 0 done, 2 not done, 130 interrupted."""
    options = _parser().parse_args(arguments)
    folder = options.out or Path("runs/race-smoke" if options.smoke else "runs/race")
    try:
        claim(folder, settings := SMOKE if options.smoke else Settings())
        results = run(folder, options.seeds, settings, options.only)
    except (RaceError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted; the same command goes on, with --out {folder}", file=sys.stderr)
        return 130
    figures = summarise(results)
    show({name: value for name, value in figures.items() if name != "curves"}, "race")
    if any(row["contestant"] == FIRST for row in figures["failed"]):
        print(f"error: {FIRST} failed, without which there is no race; nothing is written", file=sys.stderr)
        return 2
    if not options.smoke:
        print(f"written: {save('race', figures)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks race",
        description="Time and env steps to a tip error, against the peers; two hours for each seed.",
    )
    parser.add_argument("--seeds", type=numbers, default=(0,), metavar="S,S", help="of training; default: 0")
    parser.add_argument(
        "--only",
        type=contestants,
        default=tuple(CONTESTANTS),
        metavar="NAME,NAME",
        help=f"beside {FIRST}, and what was measured before: these of {', '.join(CONTESTANTS)}",
    )
    parser.add_argument("--smoke", action="store_true", help="everything, but tiny; says nothing of speed")
    parser.add_argument("--out", type=Path, metavar="DIR", help="working folder; default: runs/race")
    return parser


def contestants(text: str) -> tuple[str, ...]:
    """Names, separated by commas.

    Raises:
        argparse.ArgumentTypeError: there is no such contestant.
    """
    names = tuple(text.split(","))
    if unknown := [name for name in names if name not in CONTESTANTS]:
        raise argparse.ArgumentTypeError(
            f"got {', '.join(map(repr, unknown))}, expected {', '.join(CONTESTANTS)}"
        )
    return names


def claim(folder: Path, settings: Settings) -> None:
    """Make the folder, or see that what lies in it is comparable with what is measured now.

    Raises:
        RaceError: it was made with other settings, versions, or on another kind of machine or commit.
    """
    made = {
        **dataclasses.asdict(settings),
        "peers": PINS,
        **provenance("benchmarks"),
        "machine": machine_kind(),
    }
    made = json.loads(
        json.dumps({k: v for k, v in made.items() if k not in ("command", "uncommitted_changes")})
    )
    file = folder / SETTINGS_FILE
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_json(file, made)
    found = json.loads(file.read_text("utf-8"))
    differing = [
        f"{name} {found.get(name)}, now {made[name]}" for name in made if found.get(name) != made[name]
    ]
    if differing:
        raise RaceError(
            f"{file}: was made with {'; '.join(differing)}; choose another --out, or remove the folder"
        )


def run(
    folder: Path, seeds: Sequence[int], settings: Settings, names: Sequence[str] = tuple(CONTESTANTS)
) -> list[dict[str, Any]]:
    """The results of contestants and of what else the folder has; what it has not is measured.

    One that fails has `failed` in the place of points. If it is the first of a seed, there are no others:
    what they are given follows from it.
    """
    results = []
    for seed in seeds:
        first = _contest(folder, FIRST, seed, settings, Limits())
        results.append(first)
        if "failed" not in first:
            others = [
                name
                for name in CONTESTANTS
                if name != FIRST and (name in names or _file(folder, name, seed).exists())
            ]
            results += [
                _contest(folder, name, seed, settings, limits_of(name, first["points"])) for name in others
            ]
    return results


def limits_of(name: str, first: Sequence[Point]) -> Limits:
    """What a contestant is given, by the curve of the first."""
    reached_mm = [level for level in LEVELS_MM if crossing(first, level, "wall_s") is not None]
    time_s = crossing(first, GOAL_MM, "wall_s") or first[-1]["wall_s"]
    if name == "ours-paper":
        return Limits(target_mm=min(LEVELS_MM), stretch_s=GOALS["sbx"] * time_s / N_STRETCHES)
    wall_s = GOALS[_library(name) or "sbx"] * time_s
    return Limits(wall_s, min(reached_mm, default=0), wall_s / N_STRETCHES)


def _library(name: str) -> str | None:
    """Of a peer; None for ours."""
    return next((library for library, variants in PEERS.items() if name in variants), None)


def _contest(folder: Path, name: str, seed: int, settings: Settings, limits: Limits) -> dict[str, Any]:
    """The result of one contestant, measured now or before."""
    file = _file(folder, name, seed)
    if file.exists():
        result = json.loads(file.read_text("utf-8"))
        print(f"{name}, seed {seed}: measured before, in {file}, {_state(result)}")
        return result
    made = provenance("benchmarks")
    result = {"contestant": name, "seed": seed}
    result |= {key: made[key] for key in ("commit", "uncommitted_changes")}
    print(f"{name}, seed {seed}: {_state(result)}", flush=True)
    try:
        library = _library(name)
        program = [
            "benchmarks.race.contestants",
            name,
            str(seed),
            str(limits.stretch_s),
            str(settings.n_goals),
        ]
        worker = Worker(f"{name}, seed {seed}", program, peer_python(library) if library else None)
        result |= train(worker, limits, settings.n_points)
    except (PeerError, WorkerError) as error:
        print(f"{name}, seed {seed}: failed: {error}", file=sys.stderr)
        return {**result, "failed": str(error)}
    write_json(file, result)
    return result


def _file(folder: Path, name: str, seed: int) -> Path:
    return folder / f"{name}-seed{seed}.json"


def _state(result: dict[str, Any]) -> str:
    changed = " with uncommitted changes" if result["uncommitted_changes"] else ""
    return f"commit {result['commit']}{changed}"


def train(worker: Worker, limits: Limits, n_points: int) -> dict[str, Any]:
    """Let a contestant train until its end, a limit, or so many evaluations.

    Args:
        worker: the contestant, not started.
        limits: of wall time and error.
        n_points: evaluations at most.

    Returns:
        Start-up time, limit of wall time (None without one) and the curve's points.
    """
    limit_s = limits.wall_s if math.isfinite(limits.wall_s) else None
    within = f" up to {limit_s:.0f} s," if limit_s else ""
    print(f"{worker.name}:{within} evaluations not counted ...", flush=True)
    points: list[Point] = []
    try:
        worker.start()
        while len(points) < n_points:
            point = worker.round()
            ended = point.pop("ended")
            points.append(point)
            error_mm = median_mm(point)
            print(
                f"{worker.name}: {point['wall_s']:.0f} s, {point['env_steps']:,} env steps, "
                f"{point['updates']:,} updates, median {error_mm:.2f} mm",
                flush=True,
            )
            if ended or point["wall_s"] >= limits.wall_s or error_mm <= limits.target_mm:
                break
    finally:
        worker.close()
    return {"start_up_s": worker.facts["start_up_s"], "limit_s": limit_s, "points": points}
