"""The paper's experiments on twins: `python -m benchmarks paper [--smoke]`.

Logs are recorded, arms calibrated, policies trained and experiments run, two jobs at a time. What is done
stays in the working folder: started again, an interrupted benchmark goes on where it stopped, and twins or
seeds may be added.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from benchmarks.paper_stages import (
    SMOKE,
    Case,
    JobError,
    Settings,
    cases,
    follow_circle,
    learn_twin,
    load_results,
    train_policy,
)

N_WORKERS = 2  # each on cores of its own: faster than one training on all of them
SETTINGS_FILE = "settings.json"
PRESETS = ("quick", "paper")

Job = tuple[str, Callable[..., Any], tuple[Any, ...]]  # what to call it, function and arguments


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; returns the exit status: 0 done, 2 not done, 130 interrupted."""
    options = _parser().parse_args(arguments)
    folder, settings = (
        options.out or Path("runs/paper-smoke" if options.smoke else "runs/paper"),
        _of(options),
    )
    try:
        data = run(folder, folder if options.smoke else _results(), settings)
    except (JobError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted; the same command goes on, with --out {folder}", file=sys.stderr)
        return 130
    for check in data["goals"]:
        print(f"{'met    ' if check['met'] else 'NOT MET'}  {check['text']}: {check['value']}")
    print(f"report: {folder / 'report.html'}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks paper", description="The paper's experiments on twins, beside its numbers."
    )
    parser.add_argument("--smoke", action="store_true", help="everything, but tiny; says nothing of the arm")
    parser.add_argument("--only", choices=("open",), default="open", help="part of the paper: in open space")
    parser.add_argument("--twins", type=_numbers, metavar="T,T", help="default: 0,1,2")
    parser.add_argument("--seeds", type=_numbers, metavar="S,S", help="of training; default: 0,1,2")
    parser.add_argument("--preset", choices=PRESETS, help="of training; default: paper")
    parser.add_argument("--out", type=Path, metavar="DIR", help="working folder; default: runs/paper")
    return parser


def _numbers(text: str) -> tuple[int, ...]:
    parts = text.split(",")
    if not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected integers >= 0 with commas between them")
    return tuple(sorted({int(part) for part in parts}))


def _of(options: argparse.Namespace) -> Settings:
    given = {name: getattr(options, name) for name in ("twins", "seeds", "preset")}
    chosen = {name: value for name, value in given.items() if value is not None}
    return dataclasses.replace(SMOKE if options.smoke else Settings(), **chosen)


def _results() -> Path:
    from benchmarks.common import RESULTS

    return RESULTS


def run(folder: Path, pictures: Path, settings: Settings) -> dict[str, Any]:
    """Do what is not done yet and write the results; returns the figures.

    Args:
        folder: what is worked in.
        pictures: where JSON file, pictures and film go.
        settings: what to do.

    Raises:
        JobError: a job failed, or the folder is of other settings.
    """
    from benchmarks.paper_film import film_circle
    from benchmarks.paper_report import write_results
    from mjx_softarm.provenance import provenance

    _claim(folder, settings)
    twins, seeds = settings.twins, settings.seeds
    in_parallel(
        [(f"log and calibrate twin {t}", learn_twin, (folder, settings, t)) for t in twins]
        + [(f"train nominal arm, seed {s}", train_policy, (folder, settings, None, s)) for s in seeds]
    )
    in_parallel(
        [
            (f"train for twin {t}, seed {s}", train_policy, (folder, settings, t, s))
            for t in twins
            for s in seeds
        ]
    )
    follow: list[Job] = [(_title(case), follow_circle, (folder, settings, case)) for case in cases(settings)]
    no_film = in_parallel([*follow, ("film", film_circle, (folder, settings))])["film"]
    return write_results(
        folder, pictures, settings, load_results(folder, settings), no_film, provenance("benchmarks")
    )


def _title(case: Case) -> str:
    return f"follow {case.name}"


def _claim(folder: Path, settings: Settings) -> None:
    """Make the folder, or see that it is of these settings."""
    file, wanted = folder / SETTINGS_FILE, settings.fixed()
    if not file.exists():
        from mjx_softarm.provenance import write_json

        folder.mkdir(parents=True, exist_ok=True)
        write_json(file, wanted)
    found = json.loads(file.read_text("utf-8"))
    if found != wanted:
        differing = [name for name in wanted if found.get(name) != wanted[name]]
        got = ", ".join(f"{name} {found.get(name)}, now {wanted[name]}" for name in differing)
        raise JobError(f"{file}: was made with other settings ({got}); choose another --out")


def in_parallel(jobs: Sequence[Job]) -> dict[str, Any]:
    """Do jobs in processes of their own, a few at a time; returns what each gave, by its name.

    Raises:
        JobError: one failed; those under way are finished, the others are not begun.
    """
    context = multiprocessing.get_context("spawn")
    cores = _shares(sorted(os.sched_getaffinity(0))) if hasattr(os, "sched_setaffinity") else [[]]
    queue = context.Queue()
    for share in cores:
        queue.put(share)
    given: dict[str, Any] = {}
    pool = ProcessPoolExecutor(len(cores), context, _settle_worker, (queue,))
    try:
        waiting = {pool.submit(function, *arguments): name for name, function, arguments in jobs}
        for done in as_completed(waiting):
            name = waiting[done]
            try:
                given[name] = done.result()
            except Exception as error:
                pool.shutdown(wait=True, cancel_futures=True)
                raise JobError(f"{name}: {type(error).__name__}: {error}") from error
            print(f"{len(given)} of {len(jobs)}: {name}", flush=True)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    return given


def _shares(cores: Sequence[int]) -> list[list[int]]:
    """The cores of each worker."""
    n = min(N_WORKERS, len(cores))
    return [list(cores[k::n]) for k in range(n)]


def _settle_worker(queue: Any) -> None:
    """Keep a worker, and what it starts, to its cores; Ctrl-C ends it, and training saves by itself."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if share := queue.get():
        os.sched_setaffinity(0, share)
