"""The paper's experiments on twins, in open space and in confined spaces: `python -m benchmarks paper`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.harness.common import RESULTS, show, status_of
from benchmarks.paper.engine import SMOKE, Settings, claim, run_stages
from benchmarks.paper.kinds import BESIDE
from benchmarks.paper.report import json_name, printed_rows, write_report
from benchmarks.paper.summary import load_results
from benchmarks.paper.trials import FILMS, stages
from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError


def _presets(words: list[str]) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(words[0].split(",")))
    if unknown := [name for name in names if name not in BESIDE]:
        raise ValueError(f"got {', '.join(unknown)}, expected some of {', '.join(BESIDE)}")
    return names


def paper(
    smoke: bool = False,
    only: Literal["open", "confined"] | None = None,
    twins: cli.Integers | None = None,
    seeds: cli.Integers | None = None,
    loads: cli.Integers | None = None,
    arm: Literal["twin", "rod"] = "twin",
    preset: Literal["quick", "analytic", "payload"] | None = None,
    env_steps: int | None = None,
    beside: Annotated[tuple[str, ...], cli.listed(_presets, "NAME,NAME,...")] = (),
    out: cli.MaybePath = None,
) -> int:
    """Run the paper's experiments on twins, beside its numbers, in hours.

    The exit status is 1 if a target is missed.

    Logs are recorded, arms calibrated, policies trained and tried, two jobs at a time. Results stay in the
    working folder: the same command continues an interrupted benchmark, and twins or seeds may be added.

    Args:
        smoke: run everything, but tiny; says nothing about the arm
        only: one experiment; None: both
        twins: which twins; None: 0,1,2
        seeds: of training; None: 0,1,2
        loads: payloads in open space [g]; None: 35,105,220,330,500,1000
        arm: twin, or a rod, of other physics, in open space alone
        preset: of training in open space; None: analytic; in confined spaces it is quick
        env_steps: of training in open space; None: the preset's
        beside: further presets in open space with S2R, as long as they are; payload beside analytic
            as long as that
        out: working folder; None: runs/paper
    """
    if only != "open" and arm == "rod":
        raise InputError(f"--only: got {only}, expected open with --arm rod")
    if beside and (smoke or only == "confined"):
        raise InputError(f"--beside: got {','.join(beside)}, expected none with --smoke or --only confined")
    training = (f"total_env_steps={env_steps}",) if env_steps else None
    given = {"twins": twins, "seeds": seeds, "loads_g": loads, "preset": preset, "training": training}
    chosen = {name: value for name, value in given.items() if value is not None}
    settings = dataclasses.replace(SMOKE if smoke else Settings(), arm=arm, beside=beside, **chosen)
    folder = out or Path("runs/paper-smoke" if smoke else "runs/paper")
    pictures = folder if smoke else RESULTS
    status = 0
    for experiment in [only] if only else FILMS:
        data = run(experiment, folder, pictures, settings)
        means = {"mean and deviation over runs": printed_rows(experiment, data["spreads"])}
        show(means | {"targets": data["targets"]}, experiment)
        status |= status_of(data)
        print(f"written: {pictures / json_name(experiment, settings)}")
    return 0 if smoke else status


def run(experiment: str, folder: Path, pictures: Path, settings: Settings) -> dict[str, Any]:
    """Run the stages of an experiment that are not done and write its report; returns the figures.

    Raises:
        JobError: a stage failed, or the folder has other settings or files of an older version.
    """
    claim(folder, settings)
    returned = run_stages(folder, settings, stages(experiment, settings))
    for name in ("film", "film of loads"):
        if no_film := returned.get(name):
            print(f"no {name}: {no_film}")
    return write_report(experiment, folder, pictures, settings, load_results(folder, experiment, settings))
