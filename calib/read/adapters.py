"""Readers of public logs of two other soft arms, in their own formats.

All rows are kept, as transients need the pressures of each. `fresh` marks rows with renewed motion capture,
and a quaternion that motion capture turned by 180 degrees is NaN. The faults are found by the detectors of
`mjx_softarm.logs.checks`, as in any log.

Source: ASU-RISE-Lab/4-chamber-softarm-control (commit 6df7ec9d), StanfordASL/trunk-stack (commit 8b4b9234).
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_softarm.logs import checks
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.logs.schema import UNITS
from mjx_softarm.logs.tables import Table, read_table

N_BODIES = 3
WIRE_M_PER_V = 1.0 / 5.0  # draw-wire encoders: 5 V at 1 m


class AsuLog(NamedTuple):
    """Log of the two-section pneumatic arm of ASU RISE."""

    source: str
    row: np.ndarray  # (n,) line of the file
    time_s: np.ndarray  # (n,)
    desired_kpa: np.ndarray  # (n, 6) section 1, then section 2
    pressure_kpa: np.ndarray  # (n, 6) measured, relative to the atmosphere
    wire_v: np.ndarray  # (n, 4) draw wires from the base: section 1 left, 1 right, 2 right, 2 left
    position_m: np.ndarray  # (n, 3, 3) base, middle, tip
    quaternion: np.ndarray  # (n, 3, 4) w, x, y, z; NaN where turned
    fresh: np.ndarray  # (n,) whether every body has moved since the row before


class TrunkLog(NamedTuple):
    """Log of the three-segment tendon-driven trunk of Stanford ASL."""

    source: str
    row: np.ndarray  # (n,) line of the file
    motor_deg: np.ndarray  # (n, 6) measured
    position_m: np.ndarray  # (n, 3, 3) disks from the base, the last being the tip; y up
    quaternion: np.ndarray | None  # (n, 3, 4) w, x, y, z; NaN where turned
    fresh: np.ndarray  # (n,) whether the tip has moved since the row before


def wire_length_m(wire_v: np.ndarray) -> np.ndarray:
    """Return the length [m] of a draw-wire encoder, up to an offset that differs from day to day."""
    return WIRE_M_PER_V * wire_v


def read_asu(path: str | Path) -> tuple[AsuLog, list[Finding]]:
    """Read one `*_data_collect_*.txt`: 38 columns, no header, pressures in psi, quaternions scalar last.

    Raises:
        LogError: the file is not such a log; the message names line and column.
    """
    kinds = ("desired", "measured")
    pressures = [f"{kind}{k}" for half in (0, 3) for kind in kinds for k in range(half, half + 3)]
    axes = ("x", "y", "z", "qx", "qy", "qz", "qw")
    bodies = [f"{body}_{axis}" for body in range(N_BODIES) for axis in axes]
    names = ["time", *pressures, *(f"wire{k}" for k in range(4)), *bodies]
    table = _finite(str(path), read_table(path, names))
    pressure_kpa = UNITS["pressure"]["psi"] * table.values[:, 1:13].reshape(-1, 2, 2, 3)
    body = table.values[:, 17:].reshape(-1, N_BODIES, 7)
    quaternion, findings = _orientation(str(path), table.row, body[..., [6, 3, 4, 5]])
    stale = np.stack([checks.stale_rows(body[:, k]) for k in range(N_BODIES)], axis=1)
    findings = _stale(str(path), table.row, stale, np.any(stale, axis=1)) + findings
    late = checks.late_rows(table.values[:, 0])
    if late.any():
        problem = "repeated or going back, expected increasing"
        findings.append(_finding(str(path), table.row[late], "time", problem))
    log = AsuLog(
        source=str(path),
        row=table.row,
        time_s=table.values[:, 0],
        desired_kpa=pressure_kpa[:, :, 0].reshape(-1, 6),
        pressure_kpa=pressure_kpa[:, :, 1].reshape(-1, 6),
        wire_v=table.values[:, 13:17],
        position_m=body[..., :3],
        quaternion=quaternion,
        fresh=~np.any(stale, axis=1),
    )
    return log, findings


def read_trunk(path: str | Path) -> tuple[TrunkLog, list[Finding]]:
    """Read one `observations_controlled_*.csv`, with or without quaternions (scalar last).

    Raises:
        LogError: the file is not such a log; the message names line and column.
    """
    table = read_table(path)
    disks = range(1, N_BODIES + 1)
    positions = [f"{axis}{disk}" for disk in disks for axis in "xyz"]
    quaternions = [f"{part}{disk}" for disk in disks for part in ("w", "qx", "qy", "qz")]
    motors = [f"phi{k}" for k in range(1, 7)]
    turns = any(name in table.names for name in quaternions)
    needed = [*positions, *motors, *(quaternions if turns else [])]
    missing = [name for name in needed if name not in table.names]
    if missing:
        problem = "got no such columns, expected a log of the trunk"
        raise LogError([Finding(str(path), (1, 1), ", ".join(missing), problem)])
    values = table.values[:, [table.names.index(name) for name in needed]]
    table = _finite(str(path), Table(tuple(needed), values, table.row))
    position_m = table.values[:, :9].reshape(-1, N_BODIES, 3)
    stale = np.stack([checks.stale_rows(position_m[:, k]) for k in range(N_BODIES)], axis=1)
    findings = _stale(str(path), table.row, stale, stale[:, -1])
    quaternion = None
    if turns:
        quaternion, found = _orientation(str(path), table.row, table.values[:, 15:].reshape(-1, N_BODIES, 4))
        findings += found
    log = TrunkLog(str(path), table.row, table.values[:, 9:15], position_m, quaternion, ~stale[:, -1])
    return log, findings


def _finding(file: str, rows: np.ndarray, column: str, problem: str, n_dropped: int = 0) -> Finding:
    return Finding(file, (int(rows[0]), int(rows[-1])), column, f"{len(rows)} x {problem}", n_dropped)


def _finite(file: str, table: Table) -> Table:
    """Return the table, or raise an error that names each column with a NaN."""
    bad = ~np.isfinite(table.values)
    found = [
        _finding(file, table.row[bad[:, k]], table.names[k], "NaN or inf, expected numbers")
        for k in np.flatnonzero(bad.any(axis=0))
    ]
    if found:
        raise LogError(found)
    return table


def _stale(file: str, row: np.ndarray, stale: np.ndarray, dropped: np.ndarray) -> list[Finding]:
    problem = "equal to the row before, expected motion capture renewed in each row"
    return [
        _finding(file, row[stale[:, k]], f"body {k}", problem, int(np.count_nonzero(stale[:, k] & dropped)))
        for k in np.flatnonzero(stale.any(axis=0))
    ]


def _orientation(file: str, row: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, list[Finding]]:
    """Return quaternions (n, bodies, 4), signs repaired and turned ones NaN, and the findings."""
    repaired, findings = np.full(quaternion.shape, np.nan), []
    for k in range(quaternion.shape[1]):
        turned = checks.turned_rows(quaternion[:, k])
        repaired[~turned, k], flipped = checks.same_sign(quaternion[~turned, k])
        if turned.any():
            problem = "turned by 180 degrees between jumps, voided; expected a continuous orientation"
            findings.append(_finding(file, row[turned], f"body {k} quaternion", problem))
        if flipped.any():
            problem = "sign flipped, repaired; expected neighbours of one sign"
            findings.append(_finding(file, row[~turned][flipped], f"body {k} quaternion", problem))
    return repaired, findings
