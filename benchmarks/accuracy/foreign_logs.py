"""Readers of public logs of two other soft arms, in their own formats.

All rows are kept, as transients need the pressures of each; `fresh` marks those with renewed motion capture.

Source: ASU-RISE-Lab/4-chamber-softarm-control (commit 6df7ec9d), StanfordASL/trunk-stack (commit 8b4b9234).
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_softarm.logs import checks
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.logs.schema import UNITS
from mjx_softarm.logs.tables import read_table

N_BODIES = 3
WIRE_M_PER_V = 1.0 / 5.0  # draw-wire encoders: 5 V at 1 m, up to an offset that differs from day to day


class AsuLog(NamedTuple):
    """Log of the two-section pneumatic arm of ASU RISE."""

    time_s: np.ndarray  # (n,)
    pressure_kpa: np.ndarray  # (n, 6) measured in section 1, then section 2, relative to the atmosphere
    wire_m: np.ndarray  # (n, 4) draw wires from the base: section 1 left, 1 right, 2 right, 2 left
    position_m: np.ndarray  # (n, 3, 3) base, middle, tip
    quaternion: np.ndarray  # (n, 3, 4) w, x, y, z as logged
    fresh: np.ndarray  # (n,) whether every body has moved since the row before

    @property
    def section_m(self) -> np.ndarray:
        """Length (n,) [m] of the first section, from its base to its end."""
        return np.linalg.norm(self.position_m[:, 1] - self.position_m[:, 0], axis=1)


class TrunkLog(NamedTuple):
    """Log of the three-segment tendon-driven trunk of Stanford ASL."""

    motor_deg: np.ndarray  # (n, 6) measured
    position_m: np.ndarray  # (n, 3, 3) disks from the base, the last being the tip; y up
    quaternion: np.ndarray | None  # (n, 3, 4) w, x, y, z as logged
    fresh: np.ndarray  # (n,) whether the tip has moved since the row before


def read_asu(path: Path) -> AsuLog:
    """Read one `*_data_collect_*.txt`: 38 columns, no header, pressures in psi, quaternions scalar last.

    Raises:
        LogError: the file is not such a log; the message names line and column.
    """
    kinds = ("desired", "measured")
    pressures = [f"{kind}{k}" for half in (0, 3) for kind in kinds for k in range(half, half + 3)]
    axes = ("x", "y", "z", "qx", "qy", "qz", "qw")
    bodies = [f"{body}_{axis}" for body in range(N_BODIES) for axis in axes]
    values = _columns(path, ["time", *pressures, *(f"wire{k}" for k in range(4)), *bodies], header=False)
    pressure_psi = values[:, 1:13].reshape(-1, 2, 2, 3)[:, :, 1]
    body = values[:, 17:].reshape(-1, N_BODIES, 7)
    return AsuLog(
        time_s=values[:, 0],
        pressure_kpa=UNITS["pressure"]["psi"] * pressure_psi.reshape(-1, 6),
        wire_m=WIRE_M_PER_V * values[:, 13:17],
        position_m=body[..., :3],
        quaternion=body[..., [6, 3, 4, 5]],
        fresh=~np.any([checks.stale_rows(body[:, k]) for k in range(N_BODIES)], axis=0),
    )


def read_trunk(path: Path) -> TrunkLog:
    """Read one `observations_controlled_*.csv`, with or without quaternions.

    Raises:
        LogError: the file is not such a log; the message names line and column.
    """
    disks = range(1, N_BODIES + 1)
    positions = [f"{axis}{disk}" for disk in disks for axis in "xyz"]
    parts = [f"{part}{disk}" for disk in disks for part in ("w", "qx", "qy", "qz")]
    turns = "w1" in read_table(path).names
    names = [*positions, *(f"phi{k}" for k in range(1, 7)), *(parts if turns else [])]
    values = _columns(path, names, header=True)
    position_m = values[:, :9].reshape(-1, N_BODIES, 3)
    quaternion = values[:, 15:].reshape(-1, N_BODIES, 4) if turns else None
    return TrunkLog(values[:, 9:15], position_m, quaternion, ~checks.stale_rows(position_m[:, -1]))


def _columns(path: Path, names: list[str], header: bool) -> np.ndarray:
    """Return the columns (n, k) of a file by their names, which only a header tells."""
    table = read_table(path, None if header else names)
    if missing := [name for name in names if name not in table.names]:
        problem = "got no such columns, expected those of the public log"
        raise LogError([Finding(str(path), (1, 1), ", ".join(missing), problem)])
    values = table.values[:, [table.names.index(name) for name in names]]
    if len(bad := np.argwhere(~np.isfinite(values))):
        row, column = bad[0]
        line = int(table.row[row])
        problem = f"got {values[row, column]}, expected a finite number"
        raise LogError([Finding(str(path), (line, line), names[column], problem)])
    return values
