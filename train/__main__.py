"""Command line: `python -m train COMMAND`."""

from __future__ import annotations

import os

# XLA logs a page for every program that it takes from the cache.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import gc
import sys
from collections.abc import Sequence

from mjx_softarm._support import cli

COMMANDS = {
    "reach": "train.runs.command:Reach",
    "imitate": "train.runs.command:Imitate",
    "evaluate": "train.runs.command:evaluate",
    "export": "train.runs.export:export",
    "sweep": "train.sweep:Sweep",
    "demos record": "train.demos.record:Record",
    "demos check": "train.demos.record:Check",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    # Tracing leaves many objects that stay. To look through them time and again took a tenth of the start-up.
    gc.set_threshold(200_000)
    return cli.main("python -m train", "Train, evaluate and export policies.", COMMANDS, arguments)


if __name__ == "__main__":
    sys.exit(main())
