"""What every benchmark shares: timing, memory, goals, tables, the machine it ran on, where results go.

Figures are nested dictionaries of plain values, made for JSON. `show` prints any of them: a list of flat
dictionaries becomes a table with their keys as its head, loose values become a table of names and values.
"""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mjx_softarm._support.provenance import provenance, write_json
from train.epoch.devices import mesh_of

RESULTS = Path(__file__).parents[1] / "results"
WIDTH = 160  # of what is printed elsewhere than to a terminal
VERDICT = {True: "met", False: "NOT MET", None: "skipped"}


def seconds(call: Callable[[], Any], repeats: int = 10) -> float:
    """Median wall time of a call, after one that is not counted."""
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def n_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def mesh_of_cores(n_arms: int) -> Mesh | None:
    """This process's cores as devices, as many as n arms spread over evenly; call it before JAX is used.

    XLA runs most of settling on one core, so a CPU that is one device leaves the others idle.

    Returns:
        None where a single device is meant: on a GPU, or where the arms cannot be spread evenly.
    """
    jax.config.update("jax_num_cpu_devices", n_cores())
    n = max(n for n in range(1, n_cores() + 1) if n_arms % n == 0)
    return mesh_of(str(n)) if jax.default_backend() == "cpu" else None


def peak_memory() -> dict[str, int]:
    """Most memory that this process has needed so far [MB]: on the device where that tells, else resident."""
    on_device = (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    if on_device is not None:
        return {"peak_device_mb": round(on_device / 1e6)}
    return {"peak_rss_mb": round(_peak_rss_bytes() / 1e6)}


def _peak_rss_bytes() -> int:
    status = Path("/proc/self/status")
    if status.exists():  # getrusage would give the parent's, where that is larger
        line = next(line for line in status.read_text("utf-8").splitlines() if line.startswith("VmHWM:"))
        return 1024 * int(line.split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS


def goal(text: str, measured: str, met: bool | None) -> dict[str, str]:
    """A goal beside what was measured; `met` is None where it could not be, and `measured` says why."""
    return {"goal": text, "measured": measured, "verdict": VERDICT[met]}


def show(figures: Mapping[str, Any], title: str = "", console: Console | None = None) -> None:
    """Print figures as tables."""
    console = console or Console(width=None if sys.stdout.isatty() else WIDTH)
    loose = []
    inner = []
    for name, value in figures.items():
        words = name.replace("_", " ")
        path = f"{title}, {words}" if title else words
        if rows := _rows(value):
            inner.append((_print_table, (console, path, rows)))
        elif parts := _parts(value):
            inner.append((show, (parts, path, console)))
        else:
            loose.append({"figure": words, "value": value})
    if loose:
        _print_table(console, title, loose)
    for function, arguments in inner:
        function(*arguments)


def _rows(value: Any) -> list[dict[str, Any]]:
    """The rows of a table: dictionaries without others inside, in a list or, if their keys agree, by name."""
    parts = _parts(value)
    rows = list(parts.values())
    if not rows or not all(isinstance(row, Mapping) and not any(map(_parts, row.values())) for row in rows):
        return []
    if not isinstance(value, Mapping):
        return rows
    alike = len({tuple(row) for row in rows}) == 1
    return [{"": name.replace("_", " "), **row} for name, row in parts.items()] if alike else []


def _parts(value: Any) -> dict[str, Any]:
    """What a dictionary or a list of dictionaries holds, by name; nothing for any other value."""
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, list | tuple) and all(isinstance(part, Mapping) for part in value):
        return {str(k): part for k, part in enumerate(value, 1)}
    return {}


def _print_table(console: Console, title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = Table()
    for name in names:
        numbers = all(isinstance(row.get(name), int | float | None) for row in rows)
        table.add_column(
            Text(name.replace("_", " ")), justify="right" if numbers else "left", overflow="fold"
        )
    for row in rows:
        table.add_row(*(Text(_cell(row.get(name))) for name in names))
    console.print()
    console.print(Text(title, "bold"))
    console.print(table)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "" if value is None else str(value)


def save(name: str, figures: dict[str, Any]) -> Path:
    """Write figures with what they depend on to `benchmarks/results/NAME.json`."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    write_json(path, {"figures": figures, **provenance("benchmarks")})
    return path
