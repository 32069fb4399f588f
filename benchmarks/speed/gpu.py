"""Speed of a GPU: environment steps a second at many sizes, and times to train with sizes for a GPU.

The clock of a training stands while programs compile and policies are evaluated.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness.common import machine_kind
from benchmarks.harness.stages import EVALUATION_FILE, command
from benchmarks.speed.jax_worker import split_cpu
from benchmarks.speed.throughput import rows_of
from mjx_softarm._support import cli
from train.sweep import open_members

FIGURES = ("median_mm", "p95_mm", "reached_share", "saturated_share", "circle_mean_mm")
LEVELS_MM = (5.0, 2.0, 1.0)  # median errors at held-out goals that a training is timed to
SECONDS = 2.0  # to measure each row

# Engine and mode, and numbers of arms
STEPS = {
    ("chain", "quasistatic"): (1024, 8192, 65_536),
    ("mjx", "quasistatic"): (1024, 8192),
    ("mjx", "dynamic"): (1024, 8192, 65_536),
    ("mjx-step", "dynamic"): (1024, 8192, 65_536),
}
# Presets with their seeds, and options for a GPU
TRAININGS = {
    "quick": ("0", ()),
    "analytic": ("0,1", ("--size", "gpu")),
    "motion": ("0,1,2", ("--size", "gpu")),
}


def measure(keep: cli.MaybePath = None) -> dict[str, Any]:
    """How fast is a GPU, with all engines at many sizes, and how long do trainings take?

    Args:
        keep: folder for the runs; without one they are deleted
    """
    split_cpu()
    with tempfile.TemporaryDirectory() as folder:
        home = (keep or Path(folder)).absolute()
        home.mkdir(parents=True, exist_ok=True)
        trained = [row for preset in TRAININGS for row in training(preset, home / preset)]
    points = [(*pair, n) for pair, sizes in STEPS.items() for n in sizes]
    return {"device": machine_kind(), "env_steps": rows_of(points, SECONDS), "trainings": trained}


def training(preset: str, sweep: Path) -> list[dict[str, Any]]:
    """Train with some seeds at once; return a row for each, with its times to each level of `LEVELS_MM`."""
    seeds, options = TRAININGS[preset]
    asked = ("train", "sweep", "--preset", preset, "--seeds", seeds, *options, "--out", sweep)
    command(sweep.with_suffix(".log"), *asked, makes=sweep / "results.json")
    rows = []
    for run in open_members(sweep):
        figures = json.loads((run.path / EVALUATION_FILE).read_text("utf-8"))
        row = {"preset": preset, "seed": run.config.seed, **times_to(run.metrics())}
        rows.append(row | {name: figures[name] for name in FIGURES})
    return rows


def times_to(metrics: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Return the seconds of training, of a run's metrics, and those to the first median below each level."""
    seconds, before, times = 0.0, 0, dict.fromkeys(LEVELS_MM)
    for row in metrics:
        seconds += (row["env_steps"] - before) / row["speed/env_steps_per_s"]
        before = row["env_steps"]
        median_mm = row.get("evaluation/median_mm", math.inf)
        for level in LEVELS_MM:
            if times[level] is None and median_mm <= level:
                times[level] = round(seconds, 1)
    return {"trained_s": round(seconds, 1)} | {f"to_{level:g}_mm_s": s for level, s in times.items()}
