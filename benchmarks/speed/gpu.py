"""Targets for a GPU: rates, and the time to a trained policy; skipped where there is none."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness.common import target

NO_DEVICE = "no CUDA device here: jax runs on the CPU"
LEAST_RATE = {"chain": 300_000, "mjx": 30_000}  # env steps/s at the best number of arms
MEDIAN_MM, WITHIN_S = 3.0, 120.0
LONGEST_S = 600.0
# Many arms, few and large batches: what a GPU is good at. Run on a CPU alone so far, see docs/scaling.md.
TRAINING = (
    *("n_arms=2048", "vector_steps_per_epoch=4", "updates_per_env_step=0.03125"),
    *("batch_size=4096", "total_env_steps=2000000", "evaluation_epochs=5"),
)


def rate_targets(rows: Sequence[Mapping[str, Any]], on_gpu: bool) -> list[dict[str, str]]:
    """Return the targets for env steps/s of each engine at the best number of arms; skipped without a GPU."""
    targets = []
    for engine, least in LEAST_RATE.items():
        text = f"{least:,} env steps/s on a GPU, {engine}"
        mine = [row for row in rows if (row["engine"], row["mode"]) == (engine, "quasistatic")]
        best = max(mine, key=lambda row: row.get("env_steps_per_s", 0.0))
        rate = best.get("env_steps_per_s")
        if not on_gpu:
            targets.append(target(text, NO_DEVICE, None))
        elif rate is None:
            targets.append(target(text, "every run failed", False))
        else:
            targets.append(target(text, f"{rate:,} with {best['arms']:,} arms", rate >= least))
    return targets


def training_target(on_gpu: bool) -> dict[str, str]:
    """Return the target for the wall time of a training process, imports and compilation included."""
    text = f"{MEDIAN_MM:g} mm median over the workspace in under {WITHIN_S:g} s on a GPU, with compilation"
    if not on_gpu:
        return target(text, NO_DEVICE, None)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        settings = [f"--{setting}" for setting in TRAINING]
        command = [sys.executable, "-m", "train", "reach", "--preset", "quick", *settings, "--out", str(run)]
        cache = {"XDG_CACHE_HOME": folder}  # empty, so that compilation is in the time
        try:
            spent, best = seconds_to(MEDIAN_MM, command, run / "metrics.jsonl", LONGEST_S, cache)
        except RuntimeError as error:
            print(error, flush=True)
            return target(text, str(error).splitlines()[-1], False)
    if spent is None:
        return target(
            text, f"{best:.3g} mm at best, when it ended or was stopped after {LONGEST_S:g} s", False
        )
    return target(text, f"{spent:.1f} s", spent < WITHIN_S)


def seconds_to(
    median_mm: float, command: Sequence[str], metrics: Path, longest_s: float, environment: Mapping[str, str]
) -> tuple[float | None, float]:
    """Start a training process, watch its metrics until the median is reached, and stop it.

    Returns:
        Seconds since its start, None if it ended or `longest_s` went by before; the least median so far.

    Raises:
        RuntimeError: it failed.
    """
    start = time.perf_counter()
    with tempfile.TemporaryFile("w+") as said:  # a pipe that nobody reads would fill up and stop the process
        process = subprocess.Popen(
            command, env={**os.environ, **environment}, stdout=subprocess.DEVNULL, stderr=said, text=True
        )
        try:
            while True:
                spent = time.perf_counter() - start
                ended = process.poll() is not None
                best = least_median(metrics)
                if best <= median_mm:
                    return spent, best
                if ended and process.returncode:
                    said.seek(0)
                    last = "\n".join(said.read().splitlines()[-15:])
                    raise RuntimeError(
                        f"{' '.join(command)}: got status {process.returncode}, expected 0: {last}"
                    )
                if ended or spent > longest_s:
                    return None, best
                time.sleep(0.1)
        finally:
            process.kill()
            process.wait()


def least_median(metrics: Path) -> float:
    """Return the least median error [mm] of a run's evaluations so far, infinite before the first."""
    if not metrics.exists():
        return float("inf")
    lines = metrics.read_text("utf-8").splitlines(keepends=True)
    rows = [json.loads(line) for line in lines if line.endswith("\n")]  # the last may be half written
    return min(row.get("evaluation/median_mm", float("inf")) for row in [{}, *rows])
