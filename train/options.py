"""Options that several commands have."""

from __future__ import annotations

import argparse
from pathlib import Path

from train.config import ConfigError

_BESIDE_RESUME = ("command", "resume", "devices")


def add_arm(parser: argparse.ArgumentParser) -> None:
    """Add what says which arm it is: `--spec` or `--calibration`."""
    parser.add_argument("--spec", type=Path, help="TOML file of the arm; default: the paper's arm")
    parser.add_argument(
        "--calibration", type=Path, metavar="DIR", help="folder that `python -m calib run` made, for --spec"
    )


def check_resume_alone(options: argparse.Namespace, whose: str) -> None:
    """See that nothing stands beside `--resume` that a new run or sweep, `whose`, would need.

    Raises:
        ConfigError: something does; the message names it.
    """
    given = {name: value for name, value in vars(options).items() if name not in _BESIDE_RESUME}
    names = [name for name, value in given.items() if value not in (None, [])]
    if names:
        told = ", ".join("FILE" if name == "file" else f"--{name}" for name in names)
        raise ConfigError(f"--resume goes alone: the {whose}'s own settings hold, got {told} too")
