"""Command line: `python -m benchmarks [NAME ...]`; without a name it lists what there is."""

from __future__ import annotations

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # programs that take turns share a GPU

import argparse
import importlib
import sys
from pathlib import Path

ROOMS = {
    "throughput": "speed.throughput",
    "settle": "speed.settle",
    "kernels": "speed.kernels",
    "learner": "speed.learner",
    "guard": "speed.guard",
    "calibration": "accuracy.calibration",
    "logs": "accuracy.logs",
    "learning": "accuracy.learning",
    "race": "race.race",
    "paper": "paper.experiments",
}
NAMES = {
    "throughput": "env steps/s over arms and links, beside C MuJoCo in time steps; start-up times",
    "settle": "error, speed, compile time and memory of Newton against time stepping",
    "kernels": "what a GPU is given to do, loop by loop; compiled for an H200 where there is none",
    "learner": "gradient updates/s over batch sizes, against sb3-contrib, SBX and brax",
    "calibration": "errors of springs and chambers on a planted arm",
    "logs": "errors of calibration on public logs of real arms",
    "learning": "tip errors of the presets over seeds, from finished runs",
}
ALONE = {
    "guard": "whether something got slower than a stored baseline; it goes alone: guard --help",
    "race": "time to a tip error against sb3-contrib and SBX, two hours a seed; it goes alone: race --help",
    "paper": "the paper's experiments on twins, in hours; it goes alone: paper --help",
}


def main() -> int:
    """Run the named benchmarks; print their figures and write them to `benchmarks/results`."""
    if sys.argv[1:2] == ["guard"]:
        from benchmarks.speed import guard

        guarded = argparse.ArgumentParser(prog="python -m benchmarks guard", description=guard.__doc__)
        guarded.add_argument("--store", action="store_true")
        return guard.main(**vars(guarded.parse_args(sys.argv[2:])))
    if sys.argv[1:2] and sys.argv[1] in ALONE:
        return importlib.import_module(f"benchmarks.{ROOMS[sys.argv[1]]}").main(sys.argv[2:])
    epilog = "\n".join(f"  {name:12} {text}" for name, text in {**NAMES, **ALONE}.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--runs", nargs="*", default=[], help="folders of finished runs, for learning")
    parser.add_argument("--data", type=Path, help="folder with asu_softarm and asl_trunk, for logs")
    options = parser.parse_args()
    if not options.names:
        parser.print_help()
    for name in options.names:
        if name not in NAMES:
            alone = f", or one of {', '.join(ALONE)} alone"
            parser.error(f"got {name!r}, expected some of {', '.join(NAMES)}{alone}")
    from benchmarks.harness.common import save, show
    from mjx_softarm.logs.checks import LogError
    from train.runs.checkpoint import RunError

    if "learning" in options.names and not options.runs:
        parser.error("learning: needs --runs FOLDER [FOLDER ...]")
    if "logs" in options.names and options.data is None:
        parser.error("logs: needs --data FOLDER, with the logs that docs/results.md names under Calibration")
    for name in options.names:
        module = importlib.import_module(f"benchmarks.{ROOMS[name]}")
        given = {"learning": [options.runs], "logs": [options.data]}.get(name, [])
        try:
            figures = module.measure(*given)
        except (LogError, RunError) as error:
            parser.error(f"{name}: {error}")
        show(figures, name)
        print(f"written: {save(name, figures)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
