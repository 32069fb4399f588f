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
    "motion-engines": "benchmarks.speed.motion:measure",
    "gpu": "benchmarks.speed.gpu:measure",
    "settle": "benchmarks.speed.settle:measure",
    "start": "benchmarks.speed.start:measure",
    "growth": "benchmarks.speed.growth:measure",
    "guard": "benchmarks.speed.guard:main",
    "calibration": "benchmarks.calibration.calibration:measure",
    "changes": "benchmarks.calibration.changes:measure",
    "correction": "benchmarks.accuracy.correction:measure",
    "pose-error": "benchmarks.accuracy.correction:pose_error",
    "planning": "benchmarks.calibration.planning:measure",
    "payload": "benchmarks.calibration.payload:measure",
    "overload": "benchmarks.calibration.overload:measure",
    "arms": "benchmarks.accuracy.arms:measure",
    "logs": "benchmarks.calibration.logs:measure",
    "regulators": "benchmarks.calibration.regulators:measure",
    "claims": "benchmarks.accuracy.claims:measure",
    "learning": "benchmarks.accuracy.learning:measure",
    "film": "benchmarks.accuracy.film:film",
    "race": "benchmarks.race.race:race",
    "path": "benchmarks.accuracy.path:measure",
    "loads": "benchmarks.accuracy.loads:measure",
    "lost": "benchmarks.accuracy.lost:measure",
    "printed": "benchmarks.accuracy.printed:measure",
    "matrix": "benchmarks.accuracy.matrix:measure",
    "paper": "benchmarks.paper.experiments:Paper",
    "confined": "benchmarks.accuracy.confined:measure",
    "traces": "benchmarks.paper.traces:measure",
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
