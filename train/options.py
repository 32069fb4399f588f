"""Options that several commands have."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import tyro
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm._support import cli, xla
from mjx_softarm._support.errors import InputError
from mjx_softarm.sensing.s2r import S2R_FILE
from mjx_softarm.spec import ArmSpec
from train.config import LEARNERS, TrainConfig, name_of
from train.presets import PRESETS, preset_of


@dataclass(frozen=True, kw_only=True)
class ArmOptions:
    """The arm: specified, calibrated, or the paper's."""

    spec: cli.SpecFile = None
    calibration: cli.MaybePath = None
    """folder that `python -m calib run` made, in the place of --spec"""

    def read_arm(self, console: Console) -> CalibratedArm:
        """Return the arm, with the models of its calibration if it has one."""
        if self.calibration is None:
            return CalibratedArm(ArmSpec.of(self.spec))
        if self.spec:
            raise InputError(f"--spec {self.spec}: got --calibration {self.calibration} too, expected one")
        arm = CalibratedArm.read(self.calibration)
        if arm.s2r is None:
            absent = self.calibration / S2R_FILE
            console.print(f"no {absent}: training on simulated poses", soft_wrap=True)
        return arm


@dataclass(frozen=True, kw_only=True)
class NewRunOptions(ArmOptions):
    """Options of a command that makes a folder, or continues one."""

    out: cli.MaybePath = None
    """new folder; None: a name in runs/ after the preset"""
    resume: cli.MaybePath = None
    """folder to continue; its own settings hold"""

    def check_resume_alone(self) -> None:
        """Raise InputError for settings beside `--resume`: those that differ from the command's own."""
        command: Any = self  # each has `config` and `default`
        new = command.default([])
        names = _differing(command, new, ("resume", "config")) + _differing(command.config, new.config)
        if names:
            given = ", ".join(f"--{name}" for name in dict.fromkeys(names))
            raise InputError(f"--resume {self.resume}: got {given} too, expected none: its own settings hold")


@dataclass(frozen=True, kw_only=True)
class ReachOptions(NewRunOptions):
    """Options of a command that trains policies which reach poses of the workspace."""

    preset: Annotated[str, cli.one_of(PRESETS)] = "quick"
    """settings to begin with; the defaults below are this preset's"""
    size: Literal["cpu", "gpu"] = "cpu"
    """machine that the preset's numbers of arms, steps and transitions suit; gpu: of analytic and motion"""
    learner: Annotated[str, cli.one_of(n for n, c in LEARNERS.items() if not c.FROM_DEMONSTRATIONS)] = "tqc"
    """learner; where it is not the preset's, it begins with its own defaults"""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")]

    @classmethod
    def default(cls, arguments: Sequence[str]) -> Self:
        preset = named(arguments, "--preset", PRESETS, "quick")
        size: Any = named(arguments, "--size", ("cpu", "gpu"), "cpu")
        config = preset_of(preset, size)
        preset_learner = name_of(config.learner)
        learner = named(arguments, "--learner", LEARNERS, preset_learner)
        if learner != preset_learner:
            config = dataclasses.replace(config, learner=LEARNERS[learner]())
        return cls(preset=preset, size=size, learner=learner, config=config)


def _differing(one: Any, other: Any, ignored: Sequence[str] = ()) -> list[str]:
    names = [item.name for item in dataclasses.fields(one)]
    return [name for name in names if name not in ignored and getattr(one, name) != getattr(other, name)]


def named(arguments: Sequence[str], option: str, names: Iterable[str], default: str) -> str:
    """Return the name that an option has among the words of a command line, or the default without one."""
    words = [part for word in arguments for part in word.split("=", 1)]
    name = dict(itertools.pairwise(words)).get(option, default)
    return name if name in names else default  # an unknown one is refused as all options are read


def start() -> Console:
    """Turn on the cache of compiled programs; returns the console to print to."""
    xla.enable_compilation_cache()
    return Console(highlight=False, markup=False)
