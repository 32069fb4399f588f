"""The paper's experiments on twins, in open space and in confined spaces: `python -m benchmarks paper`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

from benchmarks.harness.common import RESULTS, show
from benchmarks.paper.engine import SMOKE, Settings, claim, run_stages
from benchmarks.paper.report import printed_rows, write_report
from benchmarks.paper.summary import load_results
from benchmarks.paper.trials import FILMS, stages
from mjx_softarm._support import cli


def paper(
    smoke: bool = False,
    only: Literal["open", "confined"] | None = None,
    twins: cli.Integers | None = None,
    seeds: cli.Integers | None = None,
    preset: Literal["quick", "paper"] | None = None,
    out: cli.MaybePath = None,
) -> int:
    """Run the paper's experiments on twins, beside its numbers, in hours.

    Logs are recorded, arms calibrated, policies trained and tried, two jobs at a time. Results stay in the
    working folder: the same command continues an interrupted benchmark, and twins or seeds may be added.

    Args:
        smoke: run everything, but tiny; says nothing about the arm
        only: one experiment; None: both
        twins: which twins; None: 0,1,2
        seeds: of training; None: 0,1,2
        preset: of training in open space; None: paper
        out: working folder; None: runs/paper
    """
    given = {"twins": twins, "seeds": seeds, "preset": preset}
    chosen = {name: value for name, value in given.items() if value is not None}
    settings = dataclasses.replace(SMOKE if smoke else Settings(), **chosen)
    folder = out or Path("runs/paper-smoke" if smoke else "runs/paper")
    pictures = folder if smoke else RESULTS
    for experiment in [only] if only else FILMS:
        data = run(experiment, folder, pictures, settings)
        show({"mean and deviation over runs": printed_rows(experiment, data["spreads"])}, experiment)
        for check in data["goals"]:
            print(f"{'met    ' if check['met'] else 'NOT MET'}  {check['text']}: {check['value']}")
        print(f"written: {pictures / f'paper-{experiment}.json'}")
    return 0


def run(experiment: str, folder: Path, pictures: Path, settings: Settings) -> dict[str, Any]:
    """Run the stages of an experiment that are not done and write its report; returns the figures.

    Raises:
        JobError: a stage failed, or the folder has other settings.
    """
    claim(folder, settings)
    if no_film := run_stages(folder, settings, stages(experiment, settings)).get("film"):
        print(f"no film: {no_film}")
    return write_report(experiment, folder, pictures, settings, load_results(folder, experiment, settings))
