"""Tables of numbers from CSV and npz files, or an error that names the line and the column."""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_softarm._support.archive import ZIP_ERRORS
from mjx_softarm._support.fields import FLOAT32_MAX
from mjx_softarm.logs.checks import Finding, LogError

_HEAD_BYTES = 1 << 16
_OTHER_DELIMITERS = {";": "semicolons", "\t": "tabs", "|": "bars"}


class Table(NamedTuple):
    """Numbers of a file."""

    names: tuple[str, ...]  # (k,) names in the header
    values: np.ndarray  # (n, k)
    row: np.ndarray  # (n,) line of the file, counted from 1; the first row of an npz file is line 2


def read_table(path: str | Path) -> Table:
    """Read a CSV file, or an npz file (suffix `.npz`) as `mjx_softarm.logs.schema` describes it.

    A number that float32 cannot hold becomes infinite, which the readers of logs refuse.

    Raises:
        LogError: the file cannot be read.
    """
    path = Path(path)
    try:
        table = _read_npz(path) if path.suffix == ".npz" else _read_csv(path)
    except OSError as error:
        raise _error(path, f"got {error.strerror or str(error)!r}, expected a log") from error
    table.values[np.abs(table.values) > FLOAT32_MAX] = np.inf
    return table


def _error(path: Path, problem: str, line: int | None = None, column: str = "") -> LogError:
    return LogError([Finding(str(path), None if line is None else (line, line), column, problem)])


def _read_npz(path: Path) -> Table:
    expected = "an npz file with `columns` (k,) of text and `table` (n, k) of numbers"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            columns, values = arrays["columns"], arrays["table"]
    except (*ZIP_ERRORS, KeyError, AttributeError, TypeError) as error:
        raise _error(path, f"got {error}, expected {expected}") from error
    shapes = f"columns {columns.shape} of {columns.dtype}, table {values.shape} of {values.dtype}"
    fits = columns.dtype.kind == "U" and values.dtype.kind in "fiu" and values.ndim == 2
    if not fits or columns.shape != values.shape[1:]:
        raise _error(path, f"got {shapes}, expected {expected}")
    if len(values) == 0:
        raise _error(path, "got no rows, expected at least 2")
    return Table(tuple(map(str, columns)), values.astype(np.float64), np.arange(len(values)) + 2)


def _read_csv(path: Path) -> Table:
    # Header: the first line names the columns.
    first, *lines = _text(path).replace("\r\n", "\n").replace("\r", "\n").split("\n")
    names = tuple(name.strip() for name in first.split(","))
    if "," not in first:
        delimiters = [text for mark, text in _OTHER_DELIMITERS.items() if mark in first]
        got = f"{delimiters[0]} between the columns" if delimiters else f"one column, {first[:60]!r}"
        raise _error(path, f"got {got}, expected columns parted by commas, and decimal points", 1)
    # Lines: blank ones are skipped, empty cells are NaN, any other text is an error.
    values, row = [], []
    for number, line in enumerate(lines, 2):
        if not line.strip():
            continue
        cells = line.split(",")
        if len(cells) != len(names):
            hint = " (decimal commas?)" if len(cells) >= 1.5 * len(names) else ""
            hint = next((f" and {text}" for mark, text in _OTHER_DELIMITERS.items() if mark in line), hint)
            problem = f"got {len(cells)} cells{hint}, expected {len(names)} as in the header"
            raise _error(path, problem, number)
        numbers = np.full(len(cells), np.nan)
        for k, cell in enumerate(cells):
            try:
                numbers[k] = float(cell) if cell.strip() else np.nan
            except ValueError:
                problem = f"got {cell.strip()[:40]!r}, expected a number"
                raise _error(path, problem, number, names[k]) from None
        values.append(numbers)
        row.append(number)
    if not values:
        raise _error(path, "got a header and no rows, expected at least 2 rows")
    return Table(names, np.stack(values), np.array(row))


def _text(path: Path) -> str:
    """Return the text of a file, or say which other kind of file it is."""
    data = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    head = data[:_HEAD_BYTES]
    if not head.strip():
        raise _error(path, "got an empty file, expected a header and rows")
    # Some loggers write UTF-16 without its mark: every other byte is zero.
    zeros_alternate = 0 in head and any(head[:512:2]) != any(head[1:512:2])
    if head.startswith((b"\xff\xfe", b"\xfe\xff")) or zeros_alternate:
        raise _error(path, "got UTF-16 text, expected UTF-8; save the file again with that encoding")
    if 0 in head:
        raise _error(path, "got a binary file, expected CSV text (or npz, by the end of its name)")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        got = f"byte 0x{data[error.start]:02x} at {error.start}"
        raise _error(path, f"got {got}, expected UTF-8 text or npz", line) from error
