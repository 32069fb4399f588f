"""Command line: `python -m calib template | check | demo | run`.

Exit status: 0 done, 1 done but not to be trusted, 2 not done, 130 interrupted.
"""

from __future__ import annotations

import functools
import os

# XLA logs a page for every program that it takes from the cache.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.logs.schema import Log
from mjx_softarm.logs.wiring import wiring_faults
from mjx_softarm.spec import ArmSpec

Logs = Annotated[
    tyro.conf.Positional[tuple[Path, ...]],
    tyro.conf.arg(
        metavar="LOG [LOG ...]",
        help="logs, CSV or npz; see `template`",
        help_behavior_hint="(required)",
    ),
]
Strict = Annotated[
    bool, tyro.conf.arg(help="refuse logs with any fault", help_behavior_hint="(default: drop rows)")
]

WIRING = "wiring"  # stands for the column of a finding about it


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    commands = {"template": _template, "check": _check, "demo": _demo, "run": _run}
    return cli.main("python -m calib", "Calibrate an arm from its logs.", commands, arguments)


def _template(out: tyro.conf.Positional[Path] = Path("log.csv")) -> int:
    """Write a small log to start from, and print its columns.

    Args:
        out: file to write
    """
    from calib.read.logs import template

    print(template(out))
    return 0


def _check(logs: Logs, spec: cli.SpecFile = None, strict: Strict = False) -> int:
    """Print the faults of logs, and of the arm's wiring where they show it."""
    read, findings = _read(logs, ArmSpec.of(spec), strict)
    for log in read:
        print(f"{log.source}: {len(log)} rows to use, {log.time_s[-1] - log.time_s[0]:.1f} s")
    return 1 if findings else 0


def _demo(out: Path = Path("calib-demo"), seed: int = 0) -> int:
    """Write logs of a planted arm, to try everything without hardware.

    Args:
        out: folder to write
        seed: seed of the arm and of the noise
    """
    from calib.demo import write_demo
    from mjx_softarm._support import xla

    _check_seed(seed)
    xla.enable_compilation_cache()
    print("simulating ...", flush=True)
    files = write_demo(out, ArmSpec.default(), seed)
    print("\n".join(f"log: {file}" for file in files))
    print(f"next: python -m calib run {' '.join(map(str, files))}")
    return 0


def _run(
    logs: Logs,
    spec: cli.SpecFile = None,
    strict: Strict = False,
    out: Path = Path("calibration"),
    since: cli.MaybePath = None,
    s2r: Literal["process", "printed"] = "process",
    seed: int = 0,
) -> int:
    """Calibrate springs, chambers, damping and the sim-to-real network; logs of `deploy` show later changes.

    Args:
        out: folder to write
        since: calibration that goes on: the logs are later ones, and show what has changed and how payloads
            are felt, nothing else
        s2r: sim-to-real network: ours, which learns a Gaussian process, or the paper's as printed
        seed: seed of all random draws
    """
    from calib.arm import CalibratedArm
    from calib.report.page import warning_lines
    from calib.run import Calibration, calibrate, go_on, refuse_existing, write_calibration
    from mjx_softarm._support import xla
    from mjx_softarm._support.provenance import provenance

    # Read the logs, and calibrate.
    _check_seed(seed)
    refuse_existing(out)
    if since and spec:
        raise InputError(f"--spec: got {spec} and --since {since}, which has its own, expected one")
    if since and s2r != "process":
        raise InputError(f"--s2r: got --since {since}, whose S2R stays, expected one of them")
    known = Calibration(CalibratedArm.read(since), ()) if since else None
    arm = known.arm.spec if known else ArmSpec.of(spec)
    if not (spec or since):
        print(f"arm: {arm.name}, by default; --spec names another arm")
    read, findings = _read(logs, arm, strict)
    xla.enable_compilation_cache()
    progress = functools.partial(print, flush=True)
    if known:
        calibration = go_on(known, read, seed, progress)
    else:
        calibration = calibrate(read, arm, seed, s2r == "printed", progress)
    # Write the folder, and print the reasons not to trust it.
    write_calibration(out, calibration, [str(finding) for finding in findings], provenance("calib"))
    lines = warning_lines(calibration.sections)
    lines += [f"note: {section.title}: {note}" for section in calibration.sections for note in section.notes]
    print("\n".join([*lines, f"report: {out / 'report.html'}"]))
    if known and calibration.arm.spec == known.arm.spec and calibration.arm.held is known.arm.held:
        print(f"next: nothing to export; {since} stays the calibration of this arm")
    else:
        after = "train export RUN" if since else "train reach --preset analytic"
        print(f"next: python -m {after} --calibration {out}")
    miswired = any(finding.column == WIRING for finding in findings)
    return 1 if miswired or any(section.warnings for section in calibration.sections) else 0


def _check_seed(seed: int) -> None:
    if seed < 0:
        raise InputError(f"--seed: got {seed}, expected a whole number from 0")


def _read(paths: Sequence[Path], spec: ArmSpec, strict: bool) -> tuple[list[Log], list[Finding]]:
    """Read logs, and print what was found in them."""
    from calib.read.logs import read_log

    if not paths:
        raise InputError("LOG: got nothing, expected one log or more")
    logs, findings = [], []
    for path in paths:
        log, of_log = read_log(path, spec)
        of_log = [*of_log, *(Finding(str(path), None, WIRING, fault) for fault in wiring_faults(log, spec))]
        if strict and of_log:
            raise LogError(of_log)
        logs.append(log)
        findings += of_log
        for finding in of_log:
            print(finding)
    return logs, findings


if __name__ == "__main__":
    sys.exit(main())
