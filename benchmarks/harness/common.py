"""The machine, targets, spreads over runs, tables, and where results go.

Figures are nested dictionaries of plain values, made for JSON; `show` prints any of them.
"""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text
from tyro.constructors import PrimitiveConstructorSpec

from benchmarks.harness.rounds import n_cores
from mjx_softarm._support import cli
from mjx_softarm._support.provenance import provenance, write_json

RESULTS = Path(__file__).parents[2] / "docs/results"
WIDTH = 160  # of tables, where they are not printed to a terminal
VERDICT = {True: "met", False: "NOT MET", None: "skipped"}

Row = Mapping[str, Any]


def cpu_kind() -> str:
    """Return the CPU's name and the number of its cores that this process may use."""
    info = Path("/proc/cpuinfo")
    name = re.search(r"model name\s*: (.+)", info.read_text("utf-8")) if info.exists() else None
    return f"{name[1].strip() if name else platform.processor() or platform.machine()}, {n_cores()} cores"


def machine_kind() -> str:
    """Return the name of the GPU if JAX runs on one, else `cpu_kind`."""
    return jax.devices()[0].device_kind if jax.default_backend() == "gpu" else cpu_kind()


def names_of(known: Iterable[str]) -> PrimitiveConstructorSpec:
    """Return the reader of an option whose value is some known names with commas between them."""
    known = tuple(known)

    def read(words: list[str]) -> tuple[str, ...]:
        names = tuple(dict.fromkeys(words[0].split(",")))
        if unknown := [name for name in names if name not in known]:
            raise ValueError(f"got {', '.join(unknown)}, expected some of {', '.join(known)}")
        return names

    return cli.listed(read, "NAME,NAME,...")


def target(text: str, measured: str, met: bool | None) -> dict[str, str]:
    """Return a row for a target; if `met` is None it could not be measured, and `measured` says why."""
    return {"target": text, "measured": measured, "verdict": VERDICT[met]}


def status_of(figures: Row) -> int:
    """Return the exit status: 1 where a target is missed, or something `failed` to be measured, else 0."""
    missed = any(row["verdict"] == VERDICT[False] for row in figures.get("targets", ()))
    return int(missed or bool(figures.get("failed")))


def grouped(rows: Iterable[Row], keys: Sequence[str]) -> dict[tuple[Any, ...], list[Row]]:
    """Return rows by their values of some keys, in the order of the first row of each group."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def over_runs(rows: Iterable[Row], keys: Sequence[str], figures: Sequence[str]) -> list[dict[str, Any]]:
    """Return a row for each group of runs with the same values of `keys`: the spread of each figure."""
    return [
        dict(zip(keys, values, strict=True))
        | {"runs": len(runs)}
        | {name: spread([run[name] for run in runs]) for name in figures if name in runs[0]}
        for values, runs in grouped(rows, keys).items()
    ]


def spread(values: Sequence[float]) -> str:
    """Return "mean ± standard deviation (least to greatest)", or the value if all are the same."""
    x = np.asarray(values, float)
    mean, off, low, high = x.mean(), x.std(), x.min(), x.max()
    return f"{mean:.4g}" if low == high else f"{mean:.4g} ± {off:.2g} ({low:.4g} to {high:.4g})"


def labels_once(panel: Any) -> tuple[list[Any], list[str]]:
    """Return handles and labels of a picture's legend, each label once."""
    handles, labels = panel.get_legend_handles_labels()
    legend = dict(zip(labels, handles, strict=True))
    return list(legend.values()), list(legend)


def show(figures: Row, title: str = "", console: Console | None = None) -> None:
    """Print figures: a line for each value, a table for each list of rows."""
    console = console or Console(width=None if sys.stdout.isatty() else WIDTH, highlight=False)
    for name, value in figures.items():
        path = ", ".join(filter(None, [title, name.replace("_", " ")]))
        if isinstance(value, Mapping):
            show(value, path, console)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            _print_table(console, path, value)
        else:
            console.print(Text(f"{path}: {_cell(value)}"))


def _print_table(console: Console, title: str, rows: Sequence[Row]) -> None:
    table = Table()
    names = list(dict.fromkeys(name for row in rows for name in row))
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


def save(name: str, figures: Row, folder: Path | None = None) -> Path:
    """Write figures with machine, versions, command and commit to NAME.json in `docs/results` or a folder."""
    path = (folder or RESULTS) / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"figures": figures, **provenance("benchmarks")})
    return path
