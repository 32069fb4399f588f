"""Tables of pressures to record, one pose per row, with the columns of a log: `pressure0 [kPa]`, ..."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm.logs.tables import read_table
from mjx_softarm.spec import ArmSpec


def _columns(n_chambers: int) -> tuple[str, ...]:
    return tuple(f"pressure{k} [kPa]" for k in range(n_chambers))


def write_plan(path: Path, pressure_kpa: np.ndarray) -> None:
    """Write pressures (n, n_chambers) [kPa].

    Raises:
        OSError: the file cannot be written.
    """
    header = ",".join(_columns(pressure_kpa.shape[1]))
    np.savetxt(path, pressure_kpa, fmt="%.3f", delimiter=",", header=header, comments="")


def read_plan(path: Path, spec: ArmSpec) -> np.ndarray:
    """Read pressures (n, n_chambers) [kPa] for an arm.

    Raises:
        InputError: the file cannot be read, has other columns, or pressures beyond the arm's limits.
    """
    table, columns = read_table(path), _columns(spec.n_chambers)
    if table.names != columns:
        raise InputError(f"{path}: got columns {','.join(table.names)}, expected {','.join(columns)}")
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    off = ~((table.values >= low) & (table.values <= high))
    if off.any():
        row, k = np.argwhere(off)[0]
        got = f"got {table.values[row, k]:g}"
        raise InputError(f"{path}: line {table.row[row]}: {columns[k]}: {got}, expected {low:g} to {high:g}")
    return table.values
