"""Reading of logs: checks, and reduction to the rows that can be believed.

`mjx_softarm.logs.schema` defines the columns. A file that cannot be understood (a missing column, a wrong
unit) is refused. Otherwise each row is kept or dropped whole. Rows are checked in three stages, each on the
rows that the stage before kept: single rows (NaN, time, range); rows beside the row before (motion capture
that was not renewed or is turned); outliers. Only references, goals and estimates of the control loop may be
NaN. Signs of quaternions are repaired. Columns that never change, time gaps and unknown columns are only
reported. Each finding has the number of rows it dropped.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from mjx_softarm.logs import checks
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.logs.files import LogMatrix, read_matrix, refuse
from mjx_softarm.logs.schema import UNITS, Column, Log, log_columns, write_log
from mjx_softarm.posture import hangs, posture
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


def read_log(path: str | Path, spec: ArmSpec | None = None) -> tuple[Log, list[Finding]]:
    """Read a log, keep the rows that can be believed, and report the faults of the others.

    Args:
        path: CSV file, or npz file by its suffix.
        spec: the arm, by default the paper's; a log of an arm with another sensor, or other numbers of
            chambers or springs, is refused.

    Returns:
        The log, with finite numbers only, and the findings.

    Raises:
        LogError: the log cannot be used; the message has a line for each finding.
    """
    spec = spec or ArmSpec.default()
    matrix, findings = read_matrix(path, spec, one_of=NEEDED)
    with np.errstate(over="ignore", invalid="ignore"):  # any number may stand in a file
        refuse(implausible(matrix, spec))
        matrix, cleaning = clean(matrix)
    return matrix.log(), findings + cleaning


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
    return _schema_text(spec)


def _schema_text(spec: ArmSpec) -> str:
    """Describe the columns that a log of an arm may have, with a marker on each section."""
    lines = [_HELP, f"{'columns':<30} {'units':<26} plausible"]
    counts = spec.n_chambers, spec.n_springs, spec.structure.n_sections
    columns = dict.fromkeys(
        column for sensor in SENSORS.values() for column in log_columns(*counts, sensor.reading_name)
    )
    for (_, kind), (first, *others) in itertools.groupby(columns, lambda column: (column.group, column.kind)):
        names = f"{first.name} .. {others[-1].name}" if others else first.name
        units = list(UNITS[kind])
        steps = " between rows" if kind == "time" else ""
        plausible = f"{PLAUSIBLE[kind].low:g} to {PLAUSIBLE[kind].high:g} {units[0]}{steps}"
        lines.append(f"{names:<30} {', '.join(units):<26} {plausible}")
    return "\n".join(lines)


class Plausible(NamedTuple):
    """Plausible values of a quantity of a soft arm a few decimetres long, in the first unit of `UNITS`."""

    low: float  # least plausible value
    high: float  # greatest plausible value
    least: float = 0.0  # size that the largest values reach, unless all values are zero
    spike: float = np.inf  # distance from its neighbours up to which a value is no outlier


# A column whose median is outside has the wrong unit, or is another column; a row with a value outside is
# dropped. The bounds distinguish mm from cm and m for such an arm, and Pa from kPa and bar. They cannot
# distinguish psi from kPa, rad from deg, or one chamber from another.
PLAUSIBLE: Mapping[str, Plausible] = MappingProxyType(
    {
        "time": Plausible(5e-4, 19.0),  # median step: 2 kHz down to a pose every 19 s
        "length": Plausible(0.03, 1.0, spike=1e-3),  # length of a spring
        "position": Plausible(-3.0, 3.0, least=0.1, spike=2e-3),  # tip and markers, from the base
        "pressure": Plausible(-105.0, 1000.0, least=0.5, spike=10.0),  # vacuum to ten bar
        "mass": Plausible(0.0, 5.0, least=1e-3),
        "number": Plausible(-1.1, 1.1),  # part of a unit quaternion
        "id": Plausible(0.0, 1e6),
        "pose_length": Plausible(-3000.0, 3000.0, least=100.0),
        "angle": Plausible(-360.0, 360.0),
        **{kind.reading_name: Plausible(*kind.plausible, spike=kind.spike) for kind in SENSORS.values()},
    }
)
BY_HAND_ROWS = 300  # fewer rows may be poses that were recorded by hand
BY_HAND_S = 600.0  # longest median step of poses that were recorded by hand
MOVES_M = 1e-3  # range of positions up to which a body may be frozen
ALONG_M = 0.05  # least median distance of the tip from the base, along the straight arm
FROM_LOOP = ("reference_m", "goal", "estimate", "load_kg")  # columns of the control loop; may hold NaN
MEASURED = ("readings", "spring_m", "pressure_kpa", "tip_m", "marker_m")


class RowFault(NamedTuple):
    """Rows with one fault."""

    column: str
    problem: str
    mask: np.ndarray  # (n,)
    drops: bool = True


def clean(matrix: LogMatrix) -> tuple[LogMatrix, list[Finding]]:
    """Return the rows that can be believed, with quaternion signs repaired, and all findings."""
    findings = []
    for stage in (_single_rows, _renewal, _neighbours):
        faults = _together([fault for fault in stage(matrix) if fault.mask.any()])
        findings += [_finding(matrix, fault) for fault in faults]
        dropped = [fault.mask for fault in faults if fault.drops]
        if dropped:
            keep = ~np.logical_or.reduce(dropped)
            matrix = matrix._replace(values=matrix.values[keep], row=matrix.row[keep])
        if len(matrix.row) < 2:
            left = f"got {len(matrix.row)} rows left, expected 2 at least"
            raise LogError([*findings, Finding(matrix.file, None, "", left)])
    # Give neighbouring quaternions one sign.
    if quaternion := matrix.indices("tip_quaternion"):
        matrix.values[:, quaternion], flipped = checks.same_sign(matrix.values[:, quaternion])
        if flipped.any():
            problem = "sign flipped, repaired; expected neighbours of one sign"
            findings.append(_finding(matrix, RowFault("tip_qw..qz", problem, flipped, drops=False)))
    return matrix, findings


def _together(faults: list[RowFault]) -> list[RowFault]:
    """Return faults with one for all columns that have the same problem in the same rows."""
    alike: dict[tuple[str, bytes, bool], list[RowFault]] = {}
    for fault in faults:
        alike.setdefault((fault.problem, fault.mask.tobytes(), fault.drops), []).append(fault)
    return [
        first._replace(column=f"{first.column} and {len(others)} more columns") if others else first
        for first, *others in alike.values()
    ]


def _finding(matrix: LogMatrix, fault: RowFault) -> Finding:
    rows = matrix.row[fault.mask]
    n_dropped = len(rows) if fault.drops else 0
    problem = f"{len(rows)} x {fault.problem}"
    return Finding(matrix.file, (int(rows[0]), int(rows[-1])), fault.column, problem, n_dropped)


def implausible(matrix: LogMatrix, spec: ArmSpec) -> list[Finding]:
    """Find reasons to refuse the log: columns without numbers, or that contradict their header or the arm."""
    if len(matrix.row) < 2:
        return [Finding(matrix.file, None, "", f"got {len(matrix.row)} row, expected 2 at least")]
    columns = zip(matrix.columns, matrix.values.T, strict=True)
    problems = {column.name: _implausible_column(column, values) for column, values in columns}
    groups = dict.fromkeys(column.group for column in matrix.columns[1:])
    problems |= {group: _implausible_size(matrix, group) for group in groups}
    if tip := matrix.indices("tip_m"):
        along_m = _typical(matrix.values[:, tip] @ -posture(spec)[:, 2])
        if along_m < ALONG_M:
            turn_deg = spec.mounting.base_turn_deg
            points = "hangs from the base" if hangs(spec) else f"is turned by {turn_deg} deg"
            got = f"got a median of {along_m:.3g} m along the straight arm"
            expected = f"{ALONG_M} m or more, as z is up and the arm {points}"
            problems["tip_z"] = problems["tip_z"] or f"{got}, expected {expected}"
    return [Finding(matrix.file, None, name, problem) for name, problem in problems.items() if problem]


def _typical(values: np.ndarray) -> float:
    """Return the median of the finite values; NaN if there is none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


def _implausible_column(column: Column, values: np.ndarray) -> str:
    what = "median step" if column.kind == "time" else "median"
    if not np.isfinite(values).any():
        return "" if column.group in FROM_LOOP else "got no number in the whole column, expected some"
    got = _typical(np.diff(values) if column.kind == "time" else values)
    low, high, *_ = PLAUSIBLE[column.kind]
    by_hand = column.kind == "time" and len(values) < BY_HAND_ROWS and low <= got <= BY_HAND_S
    if low <= got <= high or by_hand:
        return ""
    units = UNITS[column.kind].items()
    fitting = [unit for unit, factor in units if low <= got / column.factor * factor <= high]
    hint = f" (plausible in {' or '.join(fitting)})" if fitting else ""
    return f"got a {what} of {_shown(column, got)}{hint}, expected {_range(column)}: wrong unit or column"


def _implausible_size(matrix: LogMatrix, group: str) -> str:
    chosen = [k for k in matrix.indices(group) if PLAUSIBLE[matrix.columns[k].kind].least > 0.0]
    if not chosen:
        return ""
    column = matrix.columns[chosen[0]]
    sizes = np.abs(matrix.values[:, chosen])
    sizes = sizes[np.isfinite(sizes)]
    largest = np.percentile(sizes, 99) if len(sizes) else 0.0
    least = PLAUSIBLE[column.kind].least
    if largest == 0.0 or largest >= least:
        return ""
    got, expected = _shown(column, largest), _shown(column, least)
    return f"got 99 % of the values below {got}, expected the largest to reach {expected}: wrong unit"


def _shown(column: Column, value: float) -> str:
    """Format a value in the unit of the file."""
    return f"{value / column.factor:.6g} {column.unit}".removesuffix(" 1")


def _range(column: Column) -> str:
    low, high, *_ = PLAUSIBLE[column.kind]
    return f"{_shown(column, low)} to {_shown(column, high)}"


def _single_rows(matrix: LogMatrix) -> Iterator[RowFault]:
    for k, column in enumerate(matrix.columns):
        values = matrix.values[:, k]
        finite = np.isfinite(values)
        missing = np.isinf(values) if column.group in FROM_LOOP else ~finite
        yield RowFault(column.name, "NaN or inf, expected numbers", missing)
        if column.kind == "time":
            late = np.zeros(len(values), bool)
            late[finite] = checks.late_rows(values[finite])
            yield RowFault("time", "repeated or going back, expected times that increase", late)
            ordered = np.flatnonzero(finite & ~late)
            gap = np.zeros(len(values), bool)
            gap[ordered] = checks.gap_rows(values[ordered])
            if gap.any():
                steps_s = np.diff(values[ordered])
                expected = f"expected steps near {np.median(steps_s):.4g} s"
                yield RowFault("time", f"gap, longest {steps_s.max():.4g} s, {expected}", gap, drops=False)
            continue
        low, high, *_ = PLAUSIBLE[column.kind]
        outside = finite & ((values < low) | (values > high))
        if outside.any():
            problem = f"out of range, first {_shown(column, values[outside][0])}, expected {_range(column)}"
            yield RowFault(column.name, problem, outside)


def _renewal(matrix: LogMatrix) -> Iterator[RowFault]:
    everywhere = np.ones(len(matrix.row), bool)
    for k in matrix.indices("readings", "spring_m", "pressure_kpa"):
        if np.ptp(matrix.values[:, k]) == 0.0:
            always = _shown(matrix.columns[k], matrix.values[0, k])
            problem = f"the same value, {always}, expected a sensor that changes"
            yield RowFault(matrix.columns[k].name, problem, everywhere, drops=False)
    for axes in np.reshape(matrix.indices("tip_m", "marker_m"), (-1, 3)).astype(int):
        name, body = matrix.columns[axes[0]].name[:-2], matrix.values[:, axes]
        if np.ptp(body, axis=0).max() > MOVES_M:
            # A quaternion that changes shows that the tip was seen, though its position stays.
            seen = matrix.indices("tip_quaternion") if name == "tip" else []
            stale = checks.stale_rows(matrix.values[:, [*axes, *seen]])
            problem = "equal to the row before, expected motion capture renewed in each row"
            yield RowFault(f"{name}_x..z", problem, stale)
        elif name == "tip":
            problem = "the same place to 1 mm, expected a tip that moves"
            yield RowFault("tip_x..z", problem, everywhere, drops=False)
    if quaternion := matrix.indices("tip_quaternion"):
        values = matrix.values[:, quaternion]
        wrong = checks.not_unit_rows(values)
        first = f"{np.linalg.norm(values[wrong][:1]):.4g}"
        yield RowFault("tip_qw..qz", f"length not 1, first {first}, expected unit quaternions", wrong)
        turned = np.zeros(len(wrong), bool)
        turned[~wrong] = checks.turned_rows(values[~wrong])
        problem = "turned by 180 degrees between jumps, expected a continuous orientation"
        yield RowFault("tip_qw..qz", problem, turned)


def _neighbours(matrix: LogMatrix) -> Iterator[RowFault]:
    for k in matrix.indices(*MEASURED):
        column = matrix.columns[k]
        outlier = checks.outlier_rows(matrix.values[:, k], PLAUSIBLE[column.kind].spike)
        if outlier.any():
            first = _shown(column, matrix.values[outlier, k][0])
            problem = f"outlier, first {first}, expected a value like its neighbours"
            yield RowFault(column.name, problem, outlier)
