"""What every benchmark shares: timing, the machine it ran on, where results go."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_softarm.provenance import provenance, write_json

RESULTS = Path(__file__).parent / "results"


def seconds(call: Callable[[], Any], repeats: int = 10) -> float:
    """Median wall time of a call, after one that is not counted."""
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def save(name: str, figures: dict[str, Any]) -> Path:
    """Write figures with what they depend on to `benchmarks/results/NAME.json`."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    write_json(path, {"figures": figures, **provenance("benchmarks")})
    return path
