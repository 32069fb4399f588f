"""Options that several commands have."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console

from mjx_softarm._support import cli, xla
from mjx_softarm.sensing.s2r import S2R, S2R_FILE, load_s2r
from mjx_softarm.spec import ARM_FILE, ArmSpec
from train.config import ConfigError


@dataclass(frozen=True, kw_only=True)
class ArmOptions:
    """The arm: specified, calibrated, or the paper's."""

    spec: cli.SpecFile = None
    calibration: cli.MaybePath = None
    """folder that `python -m calib run` made, in the place of --spec"""

    def read_arm(self, console: Console) -> tuple[ArmSpec, S2R | None]:
        """Return the arm, and the sim-to-real network of its calibration if there is one."""
        if self.calibration is None:
            return ArmSpec.of(self.spec), None
        if self.spec:
            raise ConfigError(f"--spec {self.spec}: got --calibration {self.calibration} too, expected one")
        spec, file = ArmSpec.from_toml(self.calibration / ARM_FILE), self.calibration / S2R_FILE
        if file.exists():
            return spec, load_s2r(file, spec.n_chambers)
        console.print(f"no {file}: training on simulated poses", highlight=False, soft_wrap=True)
        return spec, None


@dataclass(frozen=True, kw_only=True)
class NewRunOptions(ArmOptions):
    """Options of what makes a folder, or continues one."""

    out: cli.MaybePath = None
    """new folder; None: a name in runs/ after the preset"""
    resume: cli.MaybePath = None
    """folder to continue; its own settings hold"""

    def check_resume_alone(self, new: Any) -> None:
        """Refuse settings beside `--resume`, by comparison with the options that a command begins with.

        Raises:
            ConfigError: there are some; the message names them.
        """
        names = _differing(self, new, ("resume", "devices", "config"))
        if names := [*names, *_differing(getattr(self, "config", None), getattr(new, "config", None))]:
            told = ", ".join(f"--{name}" for name in names)
            raise ConfigError(f"--resume {self.resume}: got {told} too, expected none: its own settings hold")


def _differing(one: Any, other: Any, ignored: Sequence[str] = ()) -> list[str]:
    names = [item.name for item in dataclasses.fields(one)]
    return [name for name in names if name not in ignored and getattr(one, name) != getattr(other, name)]


def named_preset(arguments: Sequence[str], presets: Mapping[str, Any], default: str) -> str:
    """Return the preset that the words of a command line name, or the default where they name none."""
    words = [part for word in arguments for part in word.split("=", 1)]
    name = dict(itertools.pairwise(words)).get("--preset", default)
    return name if name in presets else default  # an unknown one is refused as all options are read


def start() -> Console:
    """Turn on the cache of compiled programs; returns the console to print to."""
    xla.enable_compilation_cache()
    return Console()
