"""How long until a policy reaches, against the peers: `python -m benchmarks race [--seeds S,S] [--smoke]`.

Wall time and env steps until the median tip error at the held-out goals is so many millimetres: ours, and TQC
of SBX and of Stable-Baselines3-contrib on the same arms, goals and evaluation; `benchmarks.race_contestants`
says how each trains. One after another, each in a process of its own with all cores. A level is reached where
the line between two evaluations crosses it for the first time.

Ours goes first. A peer is stopped when it has had as many times our time to 5 mm as the goal asks for, since
the goal is met then, or when it has reached all that ours has. What is measured stays in the working folder:
started again, an interrupted benchmark goes on, and seeds may be added; another commit or machine wants
another folder.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common import save, show
from benchmarks.peers import PINS, PeerError, peer_python
from benchmarks.race_summary import GOAL_MM, GOALS, LEVELS_MM, VARIANTS, Point, crossing, median_mm, summarise
from benchmarks.rounds import Worker, WorkerError
from mjx_softarm.provenance import provenance, write_json

N_STRETCHES = 40  # of training between evaluations, up to a peer's limit
SETTINGS_FILE = "settings.json"


class RaceError(Exception):
    """The race cannot be run in this folder; the message says why."""


@dataclass(frozen=True)
class Settings:
    """How large."""

    n_goals: int = 2_000
    n_points: int = 1_000_000  # evaluations of each contestant at most


SMOKE = Settings(n_goals=64, n_points=3)


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; returns the exit status: 0 done, 2 not done, 130 interrupted."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # a GPU is the contestants'
    options = _parser().parse_args(arguments)
    folder = options.out or Path("runs/race-smoke" if options.smoke else "runs/race")
    try:
        claim(folder, settings := SMOKE if options.smoke else Settings())
        results = run(folder, options.seeds, settings)
    except (RaceError, WorkerError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted; the same command goes on, with --out {folder}", file=sys.stderr)
        return 130
    figures = summarise(results)
    show({name: value for name, value in figures.items() if name != "curves"}, "race")
    if not options.smoke:
        print(f"written: {save('race', figures)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks race",
        description="Time and env steps to a tip error, against the peers; within the hour for each seed.",
    )
    parser.add_argument("--seeds", type=_numbers, default=(0,), metavar="S,S", help="of training; default: 0")
    parser.add_argument("--smoke", action="store_true", help="everything, but tiny; says nothing of speed")
    parser.add_argument("--out", type=Path, metavar="DIR", help="working folder; default: runs/race")
    return parser


def _numbers(text: str) -> tuple[int, ...]:
    parts = text.split(",")
    if not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected integers >= 0 with commas between them")
    return tuple(sorted({int(part) for part in parts}))


def claim(folder: Path, settings: Settings) -> None:
    """Make the folder, or see that what lies in it is comparable with what is measured now.

    Raises:
        RaceError: it was made with other settings, versions, or on another machine or commit.
    """
    made = {**dataclasses.asdict(settings), "peers": PINS, **provenance("benchmarks")}
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


def run(folder: Path, seeds: Sequence[int], settings: Settings) -> list[dict[str, Any]]:
    """The results of all contestants, those that the folder has not measured first.

    Raises:
        WorkerError: ours failed.
    """
    results = []
    for seed in seeds:
        first = _contest(folder, "ours", seed, settings)
        results.append(first)
        reached_mm = [level for level in LEVELS_MM if crossing(first["points"], level, "wall_s") is not None]
        time_s = crossing(first["points"], GOAL_MM, "wall_s") or first["points"][-1]["wall_s"]
        for library, times in GOALS.items():
            for variant in VARIANTS:
                limits = {"limit_s": times * time_s, "target_mm": min(reached_mm, default=0)}
                results.append(_contest(folder, f"{library}-{variant}", seed, settings, library, **limits))
    return results


def _contest(
    folder: Path,
    name: str,
    seed: int,
    settings: Settings,
    library: str = "",
    limit_s: float = math.inf,
    target_mm: float = 0.0,
) -> dict[str, Any]:
    """The result of one contestant; a peer that fails has `failed` in the place of points."""
    file = folder / f"{name}-seed{seed}.json"
    if file.exists():
        print(f"{name}, seed {seed}: measured before, in {file}")
        return json.loads(file.read_text("utf-8"))
    result: dict[str, Any] = {"contestant": name, "seed": seed}
    try:
        python = peer_python(library) if library else None
        stretch_s = limit_s / N_STRETCHES if library else 0.0
        program = ["benchmarks.race_contestants", name, str(seed), str(stretch_s), str(settings.n_goals)]
        worker = Worker(f"{name}, seed {seed}", program, python)
        result |= train(worker, limit_s, target_mm, settings.n_points)
    except (PeerError, WorkerError) as error:
        if not library:
            raise
        print(f"{name}, seed {seed}: failed: {error}", file=sys.stderr)
        return {**result, "failed": str(error)}
    write_json(file, result)
    return result


def train(worker: Worker, limit_s: float, target_mm: float, n_points: int) -> dict[str, Any]:
    """Let a contestant train until its end, its limit, its target, or so many evaluations.

    Args:
        worker: the contestant, not started.
        limit_s: wall time, start-up included and evaluations not.
        target_mm: median tip error.
        n_points: evaluations at most.

    Returns:
        Start-up time, limit (None without one) and the curve's points.
    """
    within = f" up to {limit_s:.0f} s," if math.isfinite(limit_s) else ""
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
            if ended or point["wall_s"] >= limit_s or error_mm <= target_mm:
                break
    finally:
        worker.close()
    limit = limit_s if math.isfinite(limit_s) else None
    return {"start_up_s": worker.facts["start_up_s"], "limit_s": limit, "points": points}
