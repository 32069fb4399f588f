"""Command line: `python -m benchmarks NAME`; without a name it lists the benchmarks."""

from __future__ import annotations

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # programs that take turns share a GPU

import sys
from collections.abc import Sequence
from typing import Any

from mjx_softarm._support import cli

# By name, the function that measures and what it measures. It returns figures, or an exit status.
BENCHMARKS = {
    "throughput": ("benchmarks.speed.throughput:measure", "env steps/s beside C MuJoCo's; start-up times"),
    "settle": ("benchmarks.speed.settle:measure", "error and speed of Newton's method and of time stepping"),
    "kernels": ("benchmarks.speed.kernels:measure", "kernels of a GPU loop by loop; of an H200 without one"),
    "learner": ("benchmarks.speed.learner:measure", "gradient updates/s beside sb3-contrib, SBX and brax"),
    "guard": ("benchmarks.speed.guard:main", "speed against a stored baseline, in four minutes"),
    "calibration": ("benchmarks.accuracy.calibration:measure", "errors of calibration on a planted arm"),
    "logs": ("benchmarks.accuracy.logs:measure", "errors of calibration on public logs of real arms"),
    "learning": ("benchmarks.accuracy.learning:measure", "tip errors of finished runs over their seeds"),
    "race": ("benchmarks.race.race:race", "time to a tip error beside sb3-contrib and SBX, two hours a seed"),
    "paper": ("benchmarks.paper.experiments:paper", "the paper's experiments on twins, in hours"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a benchmark; returns the exit status."""
    about = "Print tables, and write JSON with machine, versions and commit to benchmarks/results."
    return cli.main("python -m benchmarks", about, BENCHMARKS, arguments, _finish)


def _finish(name: str, figures: dict[str, Any] | int) -> int:
    if isinstance(figures, int):
        return figures
    from benchmarks.harness.common import save, show

    show(figures, name)
    print(f"written: {save(name, figures)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
