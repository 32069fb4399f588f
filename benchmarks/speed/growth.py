"""Time and memory of an epoch over the number of arms, and over the number of devices.

Each size is a process of its own, so its peak of memory is its own. An epoch is four actions of every arm,
with the updates that follow. The devices are parts of one CPU: more of them than cores only cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.harness.rounds import Worker, take_turns
from benchmarks.speed.jax_worker import N_VECTOR_STEPS
from benchmarks.speed.throughput import figures_of

N_ROUNDS = 1  # each lasts a second or an epoch; the exponents are over a factor of 128 and more
ARMS = {"analytic": (64, 512, 4096, 32_768, 65_536), "motion-quick": (64, 512, 2048, 8192)}
BATCH = {"analytic": 0, "motion-quick": 128}
DEVICES, ARMS_ON_DEVICES = (1, 2, 4, 8), 4096
FITTED_FROM = 512  # arms: below, an epoch's fixed costs count most


def measure() -> dict[str, Any]:
    """How do time and memory of an epoch grow with arms and devices? Five minutes."""
    over_arms = _rows([(preset, n, 1) for preset, sizes in ARMS.items() for n in sizes])
    over_devices = _rows([("analytic", ARMS_ON_DEVICES, n) for n in DEVICES])
    fits = [{"preset": preset, **exponents(_of(preset, over_arms))} for preset in ARMS]
    return {"over_arms": over_arms, "over_devices": over_devices, "exponents": fits}


def _rows(points: Sequence[tuple[str, int, int]]) -> list[dict[str, Any]]:
    """Return a row for each preset, number of arms and number of devices; a size that fails says why."""
    rows = []
    for preset, n, n_devices in points:
        words = (preset, n, BATCH[preset], n_devices)
        program = ["benchmarks.speed.jax_worker", "learn", *map(str, words)]
        worker = Worker(f"{preset}, {n} arms, {n_devices} devices", program)
        figures = figures_of(worker, *take_turns([worker], N_ROUNDS))
        if rate := figures.get("env_steps_per_s"):
            figures["epoch_s"] = round(N_VECTOR_STEPS * n / rate, 3)
        rows.append({"preset": preset, "arms": n, "devices": n_devices, **figures})
    return rows


def _of(preset: str, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if row["preset"] == preset and "epoch_s" in row]


def exponents(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Return the slopes of an epoch's logarithmic time and memory over the logarithm of the number of arms.

    Memory is that above the smallest size, which is the program's own. None where too few sizes ran.
    """
    large = [row for row in rows if row["arms"] >= FITTED_FROM]
    if len(large) < 2:
        return {"time": None, "memory": None}
    least = min(row["peak_mib"] for row in rows)
    arms = np.log([row["arms"] for row in large])
    grown = np.log([max(1, row["peak_mib"] - least) for row in large])
    slopes = (np.polyfit(arms, y, 1)[0] for y in (np.log([row["epoch_s"] for row in large]), grown))
    return dict(zip(("time", "memory"), (round(float(slope), 2) for slope in slopes), strict=True))
