"""Speed of a GPU: environment steps and gradient steps a second at many sizes, and times to train.

Programs prepare themselves beside each other and then take turns, so that the GPU is one program's while it
is measured. A training is a sweep over seeds with sizes for a GPU. Its clock runs in its epochs alone: it
stands while programs compile and policies are evaluated.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness.common import machine_kind, n_cores
from benchmarks.harness.rounds import Worker, take_turns
from benchmarks.harness.stages import command
from benchmarks.speed.throughput import figures_of
from mjx_softarm._support import cli
from train.sweep import open_members

N_ROUNDS = 2
FIGURES = ("median_mm", "p95_mm", "reached_share", "saturated_share", "circle_mean_mm")
PREPARE_S = 240.0  # a program that compiles for longer is left out
LEVELS_MM = (5.0, 2.0, 1.0)  # median errors at held-out goals that a training is timed to

# Engine and mode, and numbers of arms
STEPS = {
    ("chain", "quasistatic"): (1024, 8192, 65_536),
    ("mjx", "quasistatic"): (1024, 8192),
    ("mjx", "dynamic"): (1024, 8192, 65_536),
    ("mjx-step", "dynamic"): (1024, 8192, 65_536),
    ("warp", "dynamic"): (1024, 8192, 65_536),
}
# Presets, and pairs of arms and transitions in a batch
LEARNERS = {
    "quick": ((128, 128), (1024, 1024)),
    "analytic": ((64, 0), (1024, 0), (8192, 0)),
    "motion": ((128, 128), (1024, 1024)),
    "motion-analytic": ((64, 0), (1024, 0)),
}
# Presets, their seeds, and options that suit a GPU: more arms, larger batches and a larger pool of goals
TRAININGS = {
    "quick": ("0", {}),
    "analytic": (
        "0,1",
        {"learner.n-arms": 1024, "learner.total-env-steps": 25_165_824, "env.n-poses": 131_072},
    ),
    "motion": (
        "0,1,2",
        {
            "learner.n-arms": 384,
            "learner.total-env-steps": 491_520,
            "learner.replay-capacity": 491_520,
            "learner.updates-per-env-step": 1 / 3,
            "learner.batch-size": 512,
        },
    ),
}


def measure(keep: cli.MaybePath = None) -> dict[str, Any]:
    """How fast is a GPU, with all engines at many sizes, and how long do trainings take?

    Args:
        keep: folder for the runs; without one they are deleted
    """
    with tempfile.TemporaryDirectory() as folder:
        home = (keep or Path(folder)).absolute()
        home.mkdir(parents=True, exist_ok=True)
        trained = [row for preset in TRAININGS for row in training(preset, home / preset)]
    return {"device": machine_kind(), "rounds": N_ROUNDS, **speed(), "trainings": trained}


def speed() -> dict[str, list[dict[str, Any]]]:
    """Return a row for each engine, mode and number of arms, and for each learner and its sizes."""
    steps = [(engine, mode, n) for (engine, mode), sizes in STEPS.items() for n in sizes]
    learners = [(preset, *size) for preset, sizes in LEARNERS.items() for size in sizes]
    workers = {point: _worker("steps", point) for point in steps}
    workers |= {point: _worker("learn", point) for point in learners}
    rounds, failed = take_turns(list(workers.values()), N_ROUNDS, n_starting=max(2, n_cores()))

    def rows(points: Iterable[tuple[Any, ...]], keys: Sequence[str]) -> list[dict[str, Any]]:
        return [
            dict(zip(keys, point, strict=True)) | figures_of(workers[point], rounds, failed)
            for point in points
        ]

    return {
        "env_steps": rows(steps, ("engine", "mode", "arms")),
        "learning": rows(learners, ("preset", "arms", "batch")),
    }


def _worker(kind: str, point: tuple[Any, ...]) -> Worker:
    program = ["benchmarks.speed.jax_worker", kind, *map(str, point)]
    return Worker(f"{kind}: {', '.join(map(str, point))}", program, answer_s=PREPARE_S)


def training(preset: str, sweep: Path) -> list[dict[str, Any]]:
    """Train with some seeds at once; return a row for each, with its times to each level of `LEVELS_MM`.

    Raises:
        InputError: the training failed.
    """
    seeds, options = TRAININGS[preset]
    words = [str(word) for name, value in options.items() for word in (f"--{name}", value)]
    asked = ("train", "sweep", "--preset", preset, "--seeds", seeds, *words, "--out", sweep)
    command(sweep.with_suffix(".log"), *asked, makes=sweep / "results.json")
    rows = []
    for run in open_members(sweep):
        figures = json.loads((run.path / "evaluation.json").read_text("utf-8"))
        row = {"preset": preset, "seed": run.config.seed, **times_to(run.metrics())}
        rows.append(row | {name: figures[name] for name in FIGURES})
    return rows


def times_to(metrics: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Return the seconds of training, and those after which the median error was first below each level.

    Args:
        metrics: rows of a run's `metrics.jsonl`, one for each epoch.
    """
    seconds, before, found = 0.0, 0, dict.fromkeys(LEVELS_MM)
    for row in metrics:
        seconds += (row["env_steps"] - before) / row["speed/env_steps_per_s"]
        before = row["env_steps"]
        median_mm = row.get("evaluation/median_mm", math.inf)
        for level in LEVELS_MM:
            if found[level] is None and median_mm <= level:
                found[level] = round(seconds, 1)
    return {"trained_s": round(seconds, 1)} | {f"to_{level:g}_mm_s": s for level, s in found.items()}
