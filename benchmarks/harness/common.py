"""Shared parts of the benchmarks: the machine, targets, tables, and where results go.

Figures are nested dictionaries of plain values, made for JSON. `show` prints any of them: a list of flat
dictionaries becomes a table with their keys as its head, other values become a table of names and values.
"""

from __future__ import annotations

import os
import platform
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh
from rich.console import Console
from rich.table import Table
from rich.text import Text
from tyro.constructors import PrimitiveConstructorSpec

from mjx_softarm._support import cli
from mjx_softarm._support.provenance import provenance, write_json
from train.epoch.devices import mesh_of

RESULTS = Path(__file__).parents[2] / "docs/results"
WIDTH = 160  # of tables, where they are not printed to a terminal
VERDICT = {True: "met", False: "NOT MET", None: "skipped"}


def n_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cpu_kind() -> str:
    """Return the CPU's name and the number of its cores that this process may use."""
    info = Path("/proc/cpuinfo")
    name = re.search(r"model name\s*: (.+)", info.read_text("utf-8")) if info.exists() else None
    return f"{name[1].strip() if name else platform.processor() or platform.machine()}, {n_cores()} cores"


def machine_kind() -> str:
    """Return the name of the GPU if JAX runs on one, else `cpu_kind`."""
    return jax.devices()[0].device_kind if jax.default_backend() == "gpu" else cpu_kind()


def mesh_of_cores(n_arms: int) -> Mesh | None:
    """Make devices of this process's cores, as many as n arms spread over evenly; call it before JAX is used.

    XLA runs most of settling on one core, so a CPU that is one device leaves the others idle.

    Returns:
        None for a single device: on a GPU, or where the arms cannot be spread evenly.
    """
    jax.config.update("jax_num_cpu_devices", n_cores())
    n = max(n for n in range(1, n_cores() + 1) if n_arms % n == 0)
    return mesh_of(str(n)) if jax.default_backend() == "cpu" else None


def target(text: str, measured: str, met: bool | None) -> dict[str, str]:
    """Return a row for a target; if `met` is None it could not be measured, and `measured` says why."""
    return {"target": text, "measured": measured, "verdict": VERDICT[met]}


def names_of(known: Iterable[str]) -> PrimitiveConstructorSpec:
    """Return how an option is read whose value is some known names with commas between them."""
    known = tuple(known)

    def read(words: list[str]) -> tuple[str, ...]:
        names = tuple(dict.fromkeys(words[0].split(",")))
        if unknown := [name for name in names if name not in known]:
            raise ValueError(f"got {', '.join(unknown)}, expected some of {', '.join(known)}")
        return names

    return cli.listed(read, "NAME,NAME,...")


def grouped(
    rows: Iterable[Mapping[str, Any]], keys: Sequence[str]
) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Return rows by their values of some keys, in the order of the first row of each group."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def status_of(figures: Mapping[str, Any]) -> int:
    """Return the exit status: 1 where a target is missed, else 0."""
    return int(any(row["verdict"] == VERDICT[False] for row in figures.get("targets", ())))


def show(figures: Mapping[str, Any], title: str = "", console: Console | None = None) -> None:
    """Print figures as tables."""
    console = console or Console(width=None if sys.stdout.isatty() else WIDTH)
    loose = {name: value for name, value in figures.items() if not _parts(value)}
    if loose:
        rows = [{"figure": name.replace("_", " "), "value": value} for name, value in loose.items()]
        _print_table(console, title, rows)
    for name, value in figures.items():
        if name in loose:
            continue
        path = ", ".join(filter(None, [title, name.replace("_", " ")]))
        if rows := _rows(value):
            _print_table(console, path, rows)
        else:
            show(_parts(value), path, console)


def _rows(value: Any) -> list[dict[str, Any]]:
    """Return rows of a table: flat dictionaries in a list or, if their keys agree, by name; else none."""
    parts = _parts(value)
    rows = list(parts.values())
    if not all(isinstance(row, Mapping) and not any(map(_parts, row.values())) for row in rows):
        return []
    if not isinstance(value, Mapping):
        return rows
    alike = len({tuple(row) for row in rows}) == 1
    return [{"": name.replace("_", " "), **row} for name, row in parts.items()] if alike else []


def _parts(value: Any) -> dict[str, Any]:
    """Return the items of a dictionary or of a list of dictionaries by name; none for other values."""
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, list | tuple) and all(isinstance(part, Mapping) for part in value):
        return {str(k): part for k, part in enumerate(value, 1)}
    return {}


def _print_table(console: Console, title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = Table()
    for name in names:
        side = "right" if all(isinstance(row.get(name), int | float | None) for row in rows) else "left"
        table.add_column(Text(name.replace("_", " ")), justify=side, overflow="fold")
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


def save(name: str, figures: dict[str, Any], folder: Path | None = None) -> Path:
    """Write figures with machine, versions, command and commit to NAME.json in `docs/results` or a folder."""
    path = (folder or RESULTS) / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"figures": figures, **provenance("benchmarks")})
    return path
