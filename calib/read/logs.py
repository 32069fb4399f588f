"""Reading of logs: checks, and reduction to the rows that can be believed.

`mjx_softarm.logs.schema` defines the columns. A file that cannot be understood (a missing column, a wrong
unit) is refused. Otherwise each row is kept or dropped whole. A row is dropped for a NaN, a reading out of
range, a time that does not increase, motion capture that was not renewed or is turned, or an outlier; only
references, goals and estimates of the control loop may be NaN. Signs of quaternions are repaired. Columns
that never change, time gaps and unknown columns are only reported. Each finding has the number of rows it
dropped.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.read.table_checks import PLAUSIBLE, clean, implausible, quantity
from mjx_softarm.logs.checks import Finding
from mjx_softarm.logs.files import read_matrix, refuse
from mjx_softarm.logs.schema import UNITS, Column, Log, log_columns, write_log
from mjx_softarm.sensing.sensors import SENSORS
from mjx_softarm.spec import ArmSpec

_HELP = """\
A log is a CSV file (commas, decimal points), or an npz file with the arrays `columns` and `table`.
The header names each column with its unit, as in `pressure0 [kPa]`; the order does not matter.
Needed are time and one at least of sensor readings (of one kind), spring, pressure and tip. A group of
columns is there whole or not at all. Markers are numbered from base to tip, springs and chambers as in the
spec. Base frame: z up, the arm hangs from the origin towards -z. The tip is the centre of the last plate, its
quaternion 1, 0, 0, 0 where the arm hangs straight.
Chambers and the sim-to-real network are fitted to poses at rest: rows whose pressures have been held for 3 s.
One row per pose will do if the rows are more than 3 s apart.
"""
NEEDED = ("readings", "spring_m", "pressure_kpa", "tip_m")  # a log has one of these at least


def read_log(
    path: str | Path, spec: ArmSpec | None = None, strict: bool = False
) -> tuple[Log, list[Finding]]:
    """Read a log, keep the rows that can be believed, and report the faults of the others.

    Args:
        path: CSV file, or npz file by its suffix.
        spec: the arm, by default the paper's; a log of an arm with other numbers of chambers or springs is
            refused.
        strict: refuse a log with any finding.

    Returns:
        The log, with finite numbers only, and the findings.

    Raises:
        LogError: the log cannot be used or is refused; the message has a line for each finding.
    """
    spec = spec or ArmSpec.default()
    matrix, findings = read_matrix(path, spec, one_of=NEEDED)
    with np.errstate(over="ignore", invalid="ignore"):  # any number may stand in a file
        refuse(implausible(matrix, spec))
        matrix, found = clean(matrix)
    findings += found
    if strict:
        refuse(findings)
    return matrix.log(), findings


def template(path: str | Path) -> str:
    """Write a small log of the default arm, without faults.

    Returns:
        A text on the format of the file, and the columns it may have.

    Raises:
        FileExistsError: the file exists already.
    """
    if Path(path).exists():
        raise FileExistsError(f"{path}: got a file that exists already, expected the name of a new one")
    # Ten ticks of an arm that bends to and fro: springs, tip and markers are made up, but fit together.
    spec = ArmSpec.default()
    n_sections = spec.structure.n_sections
    phase = 2.0 * np.pi * (np.arange(10)[:, None] / 10.0 + np.arange(spec.n_springs) / spec.n_springs)
    length_m = spec.at_springs(spec.geometry.section_length_m) + 0.01 * np.sin(phase)
    bend = np.stack([np.zeros(10), np.sin(phase[:, 0]), np.cos(phase[:, 0])], axis=1)
    tip_m = [0.0, 0.0, -spec.length_m] + bend * [0.0, 0.03, 0.01]
    half = 0.1 * bend[:, 1]
    share = np.arange(1, n_sections + 1)[:, None] / n_sections
    log = Log(
        source=str(path),
        row=np.arange(10) + 2,
        time_s=np.arange(10) / spec.control.rate_hz,
        readings=np.round(spec.spring_sensor.readings(length_m)),
        pressure_kpa=np.round(5.0 * np.sin(phase + 1.0), 2),
        tip_m=np.round(tip_m, 5),
        tip_quaternion=np.stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half], axis=1).round(6),
        marker_m=np.round(tip_m[:, None] * share, 5),
        payload_kg=np.zeros(10),
    )
    write_log(path, log)
    return schema_text(spec.n_chambers, spec.n_springs, n_sections)


def schema_text(n_chambers: int, n_springs: int, n_markers: int) -> str:
    """Describe the columns that a log may have, from the schema."""
    lines = [_HELP, f"{'columns':<30} {'units':<26} plausible"]
    groups: dict[tuple[str, str], list[Column]] = {}
    names = [sensor.reading_name for sensor in SENSORS.values()]
    counts = n_chambers, n_springs, n_markers
    for column in dict.fromkeys(c for name in names for c in log_columns(*counts, name)):
        groups.setdefault((column.group, column.kind), []).append(column)
    for columns in groups.values():
        first, last = columns[0], columns[-1]
        names = first.name if first == last else f"{first.name} .. {last.name}"
        units = list(UNITS[first.kind])
        bounds = PLAUSIBLE[quantity(first)]
        steps = " between rows" if first.kind == "time" else ""
        plausible = f"{bounds.low:g} to {bounds.high:g} {units[0]}{steps}"
        lines.append(f"{names:<30} {', '.join(units):<26} {plausible}")
    return "\n".join(lines)
