"""Gradient updates a second over batch sizes, against the peers' learners in one run on the same machine.

The TQC of Stable-Baselines3-contrib and of SBX (Stable-Baselines Jax), and brax's SAC, run in virtual
environments of their own, brax's with the older jax that it needs; `benchmarks.speed.learner_contestants`
describes each. At every size each has a process of its own; all prepare themselves, then they take turns. A
rate is the median of the rounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness.peers import PINS, PeerError, peer_python
from benchmarks.harness.rounds import Worker, take_turns

CONTESTANTS = {"ours": "ours", "sb3-contrib": "sb3-contrib TQC", "sbx": "SBX TQC", "brax": "brax SAC"}
BATCH_SIZES = (256, 1024, 4096, 16_384, 32_768)
N_ROUNDS = 5
N_FIRST = 256  # updates a round at the smallest batch
ROUND_S = 1.5  # time that a round at any other batch should take
SLOW_S = 15.0  # a contestant whose update is expected to take longer is left out


def measure() -> dict[str, Any]:
    """Measure gradient updates/s over batch sizes, against sb3-contrib, SBX and brax."""
    left_out: dict[str, str] = {}
    pythons = _pythons(left_out)
    rates: dict[int, dict[str, list[float]]] = {}
    rows_per_s = dict.fromkeys(pythons, BATCH_SIZES[0] * N_FIRST / ROUND_S)
    for batch_size in BATCH_SIZES:
        workers, where = [], f"from batch {batch_size:,} on"
        for name in [name for name in pythons if name not in left_out]:
            update_s = batch_size / rows_per_s[name]
            if update_s > SLOW_S:
                left_out[name] = f"{where}: an update is expected to take {update_s:.0f} s"
            else:
                size = str(batch_size), str(updates_per_round(update_s))
                program = ["benchmarks.speed.learner_contestants", name, *size]
                workers.append(Worker(name, program, pythons[name]))
        print(f"batch {batch_size:,}: {', '.join(worker.name for worker in workers)} ...", flush=True)
        rounds, failed = take_turns(workers, N_ROUNDS)
        left_out |= {name: f"{where}: {why}" for name, why in failed.items()}
        rates[batch_size] = {name: [x["updates_per_s"] for x in told] for name, told in rounds.items()}
        rows_per_s |= {name: batch_size * float(np.median(x)) for name, x in rates[batch_size].items()}
    return {
        "updates_per_s": table(rates),
        "left_out": [{"contestant": CONTESTANTS[name], "why": why} for name, why in left_out.items()],
        "rounds": [{"batch": size, **rounds} for size, rounds in rates.items()],
    }


def updates_per_round(update_s: float) -> int:
    """Return the power of two of updates that takes about `ROUND_S`, given the time [s] of one."""
    return 2 ** max(0, round(np.log2(ROUND_S / update_s)))


def table(rates: Mapping[int, Mapping[str, Sequence[float]]]) -> list[dict[str, Any]]:
    """Return a row for each batch size: medians, and how many times as fast this project is."""
    rows = []
    for batch_size, rounds in rates.items():
        medians = {name: float(np.median(values)) for name, values in rounds.items()}
        row: dict[str, Any] = {"batch": batch_size}
        row |= {CONTESTANTS[name]: _rounded(value) for name, value in medians.items()}
        if "ours" in medians:
            peers = {name: value for name, value in medians.items() if name != "ours"}
            row |= {f"ours / {name}": _rounded(medians["ours"] / value) for name, value in peers.items()}
        rows.append(row)
    return rows


def _pythons(left_out: dict[str, str]) -> dict[str, Path | None]:
    """Return the interpreter of each contestant that can be had; None is this one."""
    pythons: dict[str, Path | None] = {}
    for name in CONTESTANTS:
        try:
            pythons[name] = peer_python(name) if name in PINS else None
        except PeerError as error:
            left_out[name] = str(error)
    return pythons


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")
