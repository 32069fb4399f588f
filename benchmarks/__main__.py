"""Command line: `python -m benchmarks NAME`; without a name it lists the benchmarks."""

from __future__ import annotations

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # programs that take turns share a GPU

import sys
from collections.abc import Sequence
from typing import Any

from mjx_softarm._support import cli

# By name, the function that measures. It returns figures, or an exit status.
BENCHMARKS = {
    "throughput": "benchmarks.speed.throughput:measure",
    "gpu": "benchmarks.speed.gpu:measure",
    "settle": "benchmarks.speed.settle:measure",
    "guard": "benchmarks.speed.guard:main",
    "race": "benchmarks.race.race:race",
    "calibration": "benchmarks.accuracy.calibration:measure",
    "arms": "benchmarks.accuracy.arms:measure",
    "printed": "benchmarks.accuracy.printed:measure",
    "paper": "benchmarks.paper.experiments:paper",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a benchmark; returns the exit status."""
    about = "Print tables, and write JSON with machine, versions and commit to docs/results."
    return cli.main("python -m benchmarks", about, BENCHMARKS, arguments, _finish)


def _finish(name: str, figures: dict[str, Any] | int) -> int:
    if isinstance(figures, int):
        return figures
    from benchmarks.harness.common import save, show, status_of

    show(figures, name)
    print(f"written: {save(name, figures)}")
    return status_of(figures)


if __name__ == "__main__":
    sys.exit(main())
