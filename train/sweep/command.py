"""Command `python -m train sweep`: seeds and settings of reaching, all trained as one job."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from mjx_softarm._support import cli
from train.config import ConfigError, TrainConfig, override
from train.options import ReachOptions, start
from train.runs.lock import sole_trainer
from train.runs.run import Interrupted, free_path
from train.sweep.job import setting, variable
from train.sweep.report import CURVES_FILE, RESULTS_FILE, report
from train.sweep.run import create, open_sweep, train

_WIDTH = 160  # width of the table where the output is no terminal


@dataclass(frozen=True, kw_only=True)
class SweepCommand(ReachOptions):
    """Train `reach` with several seeds and settings, all at once.

    --seeds and --vary replace the settings' own values.
    """

    seeds: cli.Integers = (0,)
    """seeds of each setting"""
    vary: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE,...")] = ()
    """train with each of these values, e.g. learner.gamma=0.5,0.9; several: with each combination"""

    def __call__(self) -> int:
        console = start()
        # The members, of a folder or of these settings.
        if self.resume:
            self.check_resume_alone(self.default([]))
            sweep = open_sweep(self.resume)
            for run in (run for run in sweep.runs if run.checkpoints.latest is None):
                run.check_begins_anew()
            if not sweep.epoch:
                console.print(f"{self.resume}: no checkpoint of all members yet, the sweep begins anew")
        else:
            members, varied = members_of(self.config, self.seeds, self.vary)
            arm = self.read_arm(console)
            path = self.out or free_path(Path("runs") / f"sweep-{self.preset}")
            sweep = create(path, members, varied, arm, self.preset)
        console.print(f"sweep: {sweep.path}, {len(sweep.runs)} members", highlight=False)
        # Train all of them, and report.
        try:
            with sole_trainer(sweep.path):
                train(sweep, console)
        except Interrupted as stop:
            console.print(str(stop), highlight=False)
            return cli.INTERRUPTED
        wide = console if console.is_terminal else Console(file=console.file, width=_WIDTH)
        wide.print(report(sweep))
        for what, name in (("results", RESULTS_FILE), ("picture", CURVES_FILE)):
            console.print(f"{what}: {sweep.path / name}", highlight=False, soft_wrap=True)
        return 0


def members_of(
    config: TrainConfig, seeds: Sequence[int], vary: Sequence[str]
) -> tuple[dict[str, TrainConfig], tuple[str, ...]]:
    """Return the members of a sweep: each seed with each combination of the varied settings.

    Args:
        config: settings that the members share.
        seeds: seeds.
        vary: NAME=VALUE,VALUE,... for each varied setting.

    Returns:
        Configs by names such as `seed0-learner.gamma=0.5`, and the names of the varied settings.

    Raises:
        ConfigError: a setting is unknown or cannot be varied, a value cannot be used or comes twice.
    """
    # Read the values of each varied setting.
    values: dict[str, list[str]] = {}
    for assignment in vary:
        path, _, text = assignment.partition("=")
        if not text:
            raise ConfigError(f"--vary: got {assignment!r}, expected NAME=VALUE,...")
        path = path.replace("-", "_")
        if path not in (numbers := variable(config)):
            raise ConfigError(
                f"--vary {assignment}: got a setting that decides what is computed or on what shapes, "
                f"expected NAME=VALUE,... for one of {', '.join(numbers)}"
            )
        if path in values:
            raise ConfigError(f"--vary {assignment}: got {path} again, expected all its values in one")
        values[path] = [value.strip() for value in text.split(",")]
    # Make a config of each combination.
    members = {}
    for seed, *combination in itertools.product(seeds, *values.values()):
        own = [f"{path}={text}" for path, text in zip(values, combination, strict=True)]
        member = override(config, [f"seed={seed}", *own])
        for path in values:
            if not isinstance(setting(member, path), float):
                raise ConfigError(f"--vary {path}: got {setting(member, path)}, expected numbers")
        members["-".join([f"seed{seed}", *own])] = member
    if len(set(members.values())) < len(seeds) * math.prod(map(len, values.values())):
        raise ConfigError("--vary: got a value twice, expected different ones")
    return members, tuple(values)
