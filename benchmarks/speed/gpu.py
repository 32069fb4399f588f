"""What a GPU can do: environment steps and gradient steps a second at many sizes, and times to train.

All programs prepare themselves at once and then take turns, so that the GPU is one program's while it is
measured. A training is the command of `docs/train.md` with sizes for a GPU; its clock begins with its first
epoch, and stands while the policy is evaluated.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness.common import machine_kind, n_cores
from benchmarks.harness.rounds import Worker, take_turns
from benchmarks.speed.throughput import over_rounds
from benchmarks.speed.truth import told_error
from mjx_softarm._support import cli
from mjx_softarm.spec import ArmSpec
from train.runs.checkpoint import Run

N_ROUNDS = 2
PREPARE_S = 240.0  # a program that compiles for longer is left out
LEVELS_MM = (5.0, 2.0, 1.0)  # median errors at held-out goals that a training is timed to

# Engine and mode, and numbers of arms
STEPS = {
    ("chain", "quasistatic"): (1024, 8192, 65_536),
    ("mjx", "quasistatic"): (1024, 8192),
    ("chain", "dynamic"): (1024, 8192, 65_536),
    ("mjx", "dynamic"): (1024, 8192, 65_536),
    ("warp", "dynamic"): (1024, 8192, 65_536),
}
# Presets, and pairs of arms and transitions in a batch
LEARNERS = {
    "quick": ((128, 128), (1024, 1024)),
    "analytic": ((64, 0), (1024, 0), (8192, 0)),
    "motion": ((128, 128), (1024, 1024)),
    "motion-analytic": ((64, 0), (1024, 0)),
}
# Presets, and options that suit a GPU
TRAININGS: dict[str, tuple[str, ...]] = {}


def measure(parts: tuple[str, ...] = ("speed", "trainings"), keep: cli.MaybePath = None) -> dict[str, Any]:
    """What does a GPU do: steps a second of all engines at many sizes, and how long do trainings take?

    Args:
        parts: of the benchmark: speed, trainings
        keep: folder for the runs; without one they are deleted
    """
    figures: dict[str, Any] = {"device": machine_kind()}
    if "speed" in parts:
        figures |= {"rounds": N_ROUNDS, **speed()}
    if "trainings" in parts:
        with tempfile.TemporaryDirectory() as folder:
            home = (keep or Path(folder)).absolute()
            home.mkdir(parents=True, exist_ok=True)
            figures["trainings"] = [training(preset, home / preset) for preset in TRAININGS]
    return figures


def speed() -> dict[str, list[dict[str, Any]]]:
    """Return a row for each engine, mode and number of arms, and for each learner and its sizes."""
    steps = [(engine, mode, n) for (engine, mode), sizes in STEPS.items() for n in sizes]
    learners = [(preset, *size) for preset, sizes in LEARNERS.items() for size in sizes]
    workers = {point: _worker("steps", point) for point in steps}
    workers |= {point: _worker("learn", point) for point in learners}
    rounds, failed = take_turns(list(workers.values()), N_ROUNDS, n_starting=max(2, n_cores()))

    def rows(points: Iterable[tuple[Any, ...]], keys: Sequence[str]) -> list[dict[str, Any]]:
        found = []
        for point in points:
            worker = workers[point]
            row: dict[str, Any] = dict(zip(keys, point, strict=True))
            if told := rounds.get(worker.name):
                row |= over_rounds([worker.facts | facts for facts in told])
                row |= told_error(ArmSpec.default(), [worker.facts, *told])
            else:
                row["failed"] = failed[worker.name]
            found.append(row)
        return found

    return {
        "env_steps": rows(steps, ("engine", "mode", "arms")),
        "learning": rows(learners, ("preset", "arms", "batch")),
    }


def _worker(kind: str, point: tuple[Any, ...]) -> Worker:
    program = ["benchmarks.speed.jax_worker", kind, *map(str, point)]
    return Worker(f"{kind}: {', '.join(map(str, point))}", program, answer_s=PREPARE_S)


def training(preset: str, run: Path) -> dict[str, Any]:
    """Train once; return the figures of the final policy, and the times to each level of `LEVELS_MM`."""
    command = ["train", "reach", "--preset", preset, *TRAININGS[preset], "--out", str(run)]
    begin = time.perf_counter()
    status = subprocess.run([sys.executable, "-m", *command], check=False).returncode
    row = {"preset": preset, "options": " ".join(TRAININGS[preset])}
    if status:
        return {**row, "failed": f"exit status {status}"}
    row |= times_to(Run.open(run).metrics())
    figures = json.loads((run / "evaluation.json").read_text("utf-8"))
    row["command_s"] = round(time.perf_counter() - begin, 1)
    names = ("median_mm", "p95_mm", "reached_share", "saturated_share", "circle_mean_mm")
    return row | {name: figures[name] for name in names}


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
