"""Log files as matrices: the columns that the schema knows, in internal units.

A file that cannot be understood is refused. Each reader decides which rows to believe.
"""

from __future__ import annotations

import collections
import dataclasses
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.logs.schema import GROUPS, TABLES, UNITS, Column, Log, log_columns
from mjx_softarm.logs.tables import read_table
from mjx_softarm.sensing.sensors import SENSORS, Sensor
from mjx_softarm.spec import ArmSpec

_READINGS = {sensor.reading_name for sensor in SENSORS.values()}
_CELL = re.compile(r"(\w+)\s*(?:\[(.*)\])?")


class LogMatrix(NamedTuple):
    """Known columns of a log."""

    file: str
    columns: tuple[Column, ...]  # (k,) with the file's units, in the order of `log_columns`: time first
    values: np.ndarray  # (n, k) in internal units
    row: np.ndarray  # (n,) line of the file

    def indices(self, *groups: str) -> list[int]:
        """Return the indices of the columns of these fields of `Log`."""
        return [k for k, column in enumerate(self.columns) if column.group in groups]

    def log(self) -> Log:
        """Return the columns as a log."""
        groups: dict[str, Any] = {
            name: self.values[:, chosen] for name in GROUPS if (chosen := self.indices(name))
        }
        for name in ("time_s", "payload_kg", "load_kg", "sequence"):
            if name in groups:
                groups[name] = groups[name][:, 0]
        if "marker_m" in groups:
            groups["marker_m"] = groups["marker_m"].reshape(len(self.row), -1, 3)
        if readings := self.indices("readings"):
            groups["reading_name"] = self.columns[readings[0]].kind
        return Log(source=self.file, row=self.row, **groups)


@np.errstate(over="ignore", invalid="ignore")  # a file may hold any number
def read_matrix(
    path: str | Path,
    spec: ArmSpec,
    needed: Sequence[str] = (),
    one_of: Sequence[str] = (),
) -> tuple[LogMatrix, list[Finding]]:
    """Read the known columns of a file; unknown columns are findings.

    Args:
        path: CSV file, or an npz file with the suffix `.npz`.
        spec: the arm; a log of an arm with another sensor, or other numbers of chambers or springs, is
            refused.
        needed: fields of `Log` whose columns are required, besides time.
        one_of: fields of `Log`; the columns of at least one are required.

    Raises:
        LogError: the file cannot be understood; the message has a line for each finding.
    """
    # Split the header into names and units.
    file, table = str(path), read_table(path)
    cells = [(m[1], m[2]) if (m := _CELL.fullmatch(cell)) else (cell, None) for cell in table.names]
    names, units = [name for name, _ in cells], dict(cells)
    markers = [int(match[1]) for name in names if (match := re.fullmatch(r"marker(\d+)_[xyz]", name))]
    n_markers = min(1 + max(markers, default=-1), len(names))
    columns = log_columns(spec.n_chambers, spec.n_springs, n_markers, spec.sensor.reading_name)
    known = {column.name: column for column in columns}

    # Refuse headers that do not fit the arm.
    if any(name[:1].isalpha() for name in names):
        problems = [*_header_errors(names, units, known, spec.sensor)]
        problems += _absent(names, known, ("time_s", *needed), one_of)
    else:
        got = ", ".join(names)[:60]
        problems = [("", f"got {got}, expected a header such as `time [s],pressure0 [kPa],...`")]
    refuse([Finding(file, (1, 1), name, problem) for name, problem in problems])
    # Bring the known columns to internal units.
    present = [column for name, column in known.items() if name in names]
    columns = tuple(dataclasses.replace(column, unit=units[column.name]) for column in present)
    values = table.values[:, [names.index(column.name) for column in columns]]
    values *= [column.factor for column in columns]
    extra = [Finding(file, (1, 1), name, "unknown column, ignored") for name in names if name not in known]
    return LogMatrix(file, columns, values, table.row), extra


def refuse(findings: Sequence[Finding]) -> None:
    """Raise a `LogError` with the findings, if there are any."""
    if findings:
        raise LogError(findings)


def _stem(name: str) -> str:
    """Return the name of a numbered column without its number, empty for another column."""
    match = re.fullmatch(r"(\D+)\d+", name)
    return match[1] if match else ""


def _header_errors(names: list[str], units: dict, known: dict, sensor: Sensor) -> Iterator[tuple[str, str]]:
    """Yield the columns that do not fit the schema, each with its problem."""
    groups = [known[name].group for name in names if name in known]
    foreign = [name for name in names if _stem(name) in _READINGS - {sensor.reading_name}]
    if foreign and "readings" not in groups:
        yield foreign[0], f"got readings of another sensor, expected {sensor.reading_name} of a {sensor.kind}"
    n_columns = collections.Counter(map(_stem, known))
    for name, unit in units.items():
        if names.count(name) > 1:
            yield name, f"got {names.count(name)} columns of this name, expected one"
        if name in known and unit not in UNITS[known[name].kind]:
            expected = ", ".join(f"[{unit}]" for unit in UNITS[known[name].kind])
            yield name, f"got {'no unit' if unit is None else f'[{unit}]'}, expected one of {expected}"
        stem = _stem(name)
        if stem and name not in known and stem in n_columns:
            yield name, f"got this column, expected {stem}0 to {stem}{n_columns[stem] - 1}"
    for group in dict.fromkeys(groups):
        columns = [name for name, column in known.items() if column.group == group]
        if missing := [name for name in columns if name not in names]:
            beside = next(name for name in columns if name in names)
            yield ", ".join(missing), f"got no such column, expected it beside {beside}"


def _absent(
    names: list[str], known: dict, needed: Sequence[str], one_of: Sequence[str]
) -> Iterator[tuple[str, str]]:
    """Yield the required groups without a column, each with its problem."""
    groups = {known[name].group for name in names if name in known}
    for group in needed:
        if group not in groups:
            first, *others = [column for column in known.values() if column.group == group]
            expected = f"columns `{first.header}` to `{others[-1].name}`" if others else f"`{first.header}`"
            yield first.name, f"got nothing, expected {expected}"
    if one_of and not groups & set(one_of):
        firsts = [next(column for column in known.values() if column.group == group) for group in one_of]
        *most, last = [f"{column.name}.." for column in firsts]
        yield "", f"got only {', '.join(names)[:60]}, expected {', '.join(most)} or {last}"


def check_file(option: str, path: Path | None, endings: Sequence[str] = TABLES) -> None:
    """Refuse a file that exists, could not be written, or is of another format, before the arm moves."""
    if path is None:
        return
    if path.suffix and path.suffix not in endings:
        raise InputError(f"{option}: got {path}, expected a name that ends in {' or '.join(endings)}")
    if not path.parent.is_dir():
        raise InputError(f"{option}: got {path}, expected a file in a folder that exists")
    if path.is_dir():
        raise InputError(f"{option}: got {path}, a folder, expected a file")
    if path.exists():
        raise InputError(f"{option}: got {path}, which is there already, expected a new file")
