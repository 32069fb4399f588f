"""Commands `python -m train demos record | check`: demonstrations from an arm, and the contents of a file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.drivers import names
from mjx_softarm.deploy.drivers.names import check_number
from mjx_softarm.deploy.ending import DONE, MISSED, NOT_WRITTEN, save_log
from mjx_softarm.logs.files import check_file
from mjx_softarm.logs.schema import Log
from mjx_softarm.spec import ArmSpec
from train.demos.demonstrations import from_log, read_demonstrations
from train.demos.expert import Expert
from train.demos.record import WaypointRecorder
from train.demos.waypoints import TASKS, task
from train.options import ArmOptions, start


@dataclass(frozen=True, kw_only=True)
class Record(ArmOptions):
    """Bring an arm's finger tips to waypoints, and log the static poses there."""

    arm: str
    """twin:SEED, twin:SEED:pipe300, twin:SEED:500g, or package.module:Class, a driver of your own"""
    task: Annotated[str, cli.one_of(TASKS)]
    """task with its waypoints and its pipe"""
    out: Path
    """file to write, CSV or npz"""

    def __call__(self) -> int:
        console = start()
        check_file("--out", self.out)
        if self.out.exists():
            raise InputError(f"--out: got {self.out}, which is there already, expected a new file")
        # Plan all postures before the arm moves.
        spec, s2r, _ = self.read_arm(console)
        arm = names.open_arm(self.arm)
        check_number(arm, spec, f"--arm {self.arm}")
        waypoints, pipe = task(self.task, spec)
        expert = Expert(spec, s2r, pipe)
        plan = expert.plan(waypoints)
        # Record, and report the poses and errors.
        recorder = WaypointRecorder(arm, expert, partial(_print, console), partial(save_log, self.out))
        result = recorder.record(waypoints, plan)
        if len(result.log) and result.ending.status != NOT_WRITTEN:
            _print(console, f"demonstrations: {self.out}, {len(result.log)} poses")
            if np.isfinite(result.off_m).any():
                _print(console, f"furthest from its waypoint: {1e3 * np.nanmax(result.off_m):.1f} mm")
        if result.ending.cause:
            _print(console, f"ended early: {result.ending.cause}")
        return result.ending.status or (DONE if len(result.log) else MISSED)


@dataclass(frozen=True, kw_only=True)
class Check(ArmOptions):
    """Print the contents of a file of demonstrations, and its faults."""

    file: tyro.conf.Positional[Path]
    """CSV or npz"""

    def __call__(self) -> int:
        console = start()
        spec = self.read_arm(console).spec
        log, findings = read_demonstrations(self.file, spec)
        for text in (*_summary(log, spec), *map(str, findings)):
            _print(console, text)
        return 0


def _print(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _summary(log: Log, spec: ArmSpec) -> list[str]:
    demos = from_log(log, spec)
    ids, counts = np.unique(demos.sequence, return_counts=True)
    sequences = ", ".join(f"{k} with {count}" for k, count in zip(ids, counts, strict=True))
    low, high = demos.positions.min(axis=0), demos.positions.max(axis=0)
    ranges = ", ".join(f"{axis} {low[k]:.0f} to {high[k]:.0f}" for k, axis in enumerate("xyz"))
    lines = [
        f"poses: {len(log)}, tip [mm]: {ranges}",
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
