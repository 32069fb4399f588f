"""The paper's experiments on twins: `python -m benchmarks paper [--only PART] [--smoke]`.

Logs are recorded, arms calibrated, policies trained and experiments run, two jobs at a time. What is done
stays in the working folder: started again, an interrupted benchmark goes on where it stopped, and twins or
seeds may be added. The experiments in open space are here, those in confined spaces in `confined`; both share
a folder, with its calibrations and the policies that know no demonstrations.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness.options import numbers
from benchmarks.harness.parallel import Job, JobError, in_parallel
from benchmarks.paper import confined
from benchmarks.paper.stages import (
    SMOKE,
    Settings,
    calibrations,
    cases,
    claim,
    follow_circle,
    load_results,
    reach_policies,
    train_policy,
)

PRESETS = ("quick", "paper")
PARTS = {"open": "report.html", "confined": "confined.html"}  # and the page of each


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; returns the exit status: 0 done, 2 not done, 130 interrupted."""
    options = _parser().parse_args(arguments)
    folder, settings = (
        options.out or Path("runs/paper-smoke" if options.smoke else "runs/paper"),
        _of(options),
    )
    pictures = folder if options.smoke else _results()
    try:
        for part in [options.only] if options.only else PARTS:
            data = (run if part == "open" else confined.run)(folder, pictures, settings)
            for check in data["goals"]:
                print(f"{'met    ' if check['met'] else 'NOT MET'}  {check['text']}: {check['value']}")
            print(f"report: {folder / PARTS[part]}")
    except (JobError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted; the same command goes on, with --out {folder}", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks paper", description="The paper's experiments on twins, beside its numbers."
    )
    parser.add_argument("--smoke", action="store_true", help="everything, but tiny; says nothing of the arm")
    parser.add_argument(
        "--only", choices=PARTS, help="part of the paper: in open space or confined; default: both"
    )
    parser.add_argument("--twins", type=numbers, metavar="T,T", help="default: 0,1,2")
    parser.add_argument("--seeds", type=numbers, metavar="S,S", help="of training; default: 0,1,2")
    parser.add_argument("--preset", choices=PRESETS, help="of training in open space; default: paper")
    parser.add_argument("--out", type=Path, metavar="DIR", help="working folder; default: runs/paper")
    return parser


def _of(options: argparse.Namespace) -> Settings:
    given = {name: getattr(options, name) for name in ("twins", "seeds", "preset")}
    chosen = {name: value for name, value in given.items() if value is not None}
    return dataclasses.replace(SMOKE if options.smoke else Settings(), **chosen)


def _results() -> Path:
    from benchmarks.harness.common import RESULTS

    return RESULTS


def run(folder: Path, pictures: Path, settings: Settings) -> dict[str, Any]:
    """Do what is not done yet in open space and write the results; returns the figures.

    Args:
        folder: what is worked in.
        pictures: where JSON file, pictures and film go.
        settings: what to do.

    Raises:
        JobError: a job failed, or the folder is of other settings.
    """
    from benchmarks.paper.film import film_circle
    from benchmarks.paper.report_open import write_results
    from mjx_softarm._support.provenance import provenance

    claim(folder, settings)
    nominal: list[Job] = [
        (f"train nominal arm, seed {s}", train_policy, (folder, settings, None, s)) for s in settings.seeds
    ]
    in_parallel([*calibrations(folder, settings), *nominal])
    in_parallel(reach_policies(folder, settings))
    follow: list[Job] = [
        (f"follow {case.name}", follow_circle, (folder, settings, case)) for case in cases(settings)
    ]
    no_film = in_parallel([*follow, ("film", film_circle, (folder, settings))])["film"]
    return write_results(
        folder, pictures, settings, load_results(folder, settings), no_film, provenance("benchmarks")
    )
