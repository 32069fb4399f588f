"""Commands `python -m train demos record | check`: demonstrations from an arm, and what a file has."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console

from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.sensing.s2r import S2R
from mjx_softarm.spec import ArmSpec
from train.config import ConfigError
from train.demos.demonstrations import from_log, read_demonstrations
from train.demos.waypoints import TASKS, task
from train.options import add_arm

_STOPPED, _INTERRUPTED = 3, 130


ArmOf = Callable[[argparse.Namespace, Console], tuple[ArmSpec, S2R | None]]


def add_commands(commands: argparse._SubParsersAction, arm_of: ArmOf) -> None:
    """Add `demos` to a parser; `arm_of` gives the arm of options `spec` and `calibration`."""
    demos = commands.add_parser("demos", help="record demonstrations on an arm, check files of them")
    kinds = demos.add_subparsers(required=True, metavar="COMMAND")
    record = kinds.add_parser("record", help="bring an arm's finger tips to positions, and log them")
    record.add_argument(
        "--arm",
        required=True,
        help="twin:SEED, twin:SEED:pipe300, or package.module:Class, a driver of your own",
    )
    record.add_argument("--task", choices=TASKS, help="its positions and its pipe; --keyboard does without")
    record.add_argument(
        "--keyboard", action="store_true", help="steer by keys, in the task's pipe if one is given"
    )
    add_arm(record)
    record.add_argument("--out", type=Path, required=True, metavar="FILE", help="to write, CSV or npz")
    record.set_defaults(command=lambda options, console: _record(options, console, *arm_of(options, console)))
    check = kinds.add_parser("check", help="what a file has, and what is wrong with it")
    check.add_argument("file", type=Path, help="CSV or npz")
    check.add_argument("--spec", type=Path, help="TOML file of the arm; default: the paper's arm")
    check.add_argument("--calibration", type=Path, metavar="DIR", help="folder with the arm, for --spec")
    check.set_defaults(command=lambda options, console: _check(options, console, *arm_of(options, console)))


def _record(options: argparse.Namespace, console: Console, spec: ArmSpec, s2r: S2R | None) -> int:
    from mjx_softarm.deploy.arms import open_arm
    from train.demos.expert import Expert
    from train.demos.teleop import KEYS, Teleoperation, read_keys

    def tell(text: str) -> None:
        console.print(text, markup=False, highlight=False, soft_wrap=True)

    if not (options.task or options.keyboard):
        raise ConfigError(f"--task: missing, expected one of {', '.join(TASKS)}, or --keyboard")
    if not options.out.parent.is_dir() or options.out.is_dir():
        raise ConfigError(f"--out: got {options.out}, expected the name of a file in a folder that exists")
    if options.out.exists():
        raise ConfigError(f"--out: {options.out} is there already; choose another")
    arm = open_arm(options.arm)
    waypoints, pipe = task(options.task, spec) if options.task else ((), None)
    expert = Expert(spec, s2r, pipe)
    plan = None if options.keyboard else expert.plan(waypoints)  # before the arm moves
    teleop = Teleoperation(arm, expert, tell)
    if plan is None:
        tell(KEYS)
        result = teleop.steer(read_keys(sys.stdin))
    else:
        result = teleop.record(waypoints, plan)
    if len(result.log):
        write_log(options.out, result.log)
        tell(f"demonstrations: {options.out}, {len(result.log)} positions")
        if np.isfinite(result.off_m).any():
            tell(f"furthest from its waypoint: {1e3 * np.nanmax(result.off_m):.1f} mm")
    if result.problem:
        tell(f"ended early: {result.problem}")
        return _INTERRUPTED if result.problem == "interrupted" else _STOPPED
    return 0 if len(result.log) else _STOPPED


def _check(options: argparse.Namespace, console: Console, spec: ArmSpec, _: S2R | None) -> int:
    log, findings = read_demonstrations(options.file, spec)
    for text in (*_summary(log, spec), *map(str, findings)):
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    return 0


def _summary(log: Log, spec: ArmSpec) -> list[str]:
    demos = from_log(log, spec)
    ids, counts = np.unique(demos.sequence, return_counts=True)
    sequences = ", ".join(f"{k} with {count}" for k, count in zip(ids, counts, strict=True))
    low, high = demos.positions.min(axis=0), demos.positions.max(axis=0)
    ranges = ", ".join(f"{axis} {low[k]:.0f} to {high[k]:.0f}" for k, axis in enumerate("xyz"))
    lines = [
        f"positions: {len(log)}, tip [mm]: {ranges}",
        f"sequences: {len(ids)}: {sequences}",
        f"actions: {demos.actions.min():.3f} to {demos.actions.max():.3f} of -1 to 1",
    ]
    if len(log) > 1:
        apart_mm = np.linalg.norm(demos.positions[:, None, :3] - demos.positions[:, :3], axis=-1)
        apart_mm[np.tril_indices(len(log))] = np.inf
        one, other = np.unravel_index(np.argmin(apart_mm), apart_mm.shape)
        lines.append(
            f"closest: {apart_mm[one, other]:.1f} mm apart, lines {log.row[one]} and {log.row[other]}"
        )
    return lines
