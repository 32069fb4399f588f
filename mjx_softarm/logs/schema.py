"""Logs of an arm: one table of columns with units, written by the control loop and read by `calib`.

A log is a CSV file whose header names each column with its unit, `pressure0 [kPa]`, or an npz file with
`columns` (k,) of text and `table` (n, k) of float64.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from mjx_softarm._support.files import replacing
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.sensing.sensors import SENSORS, Coil, Sensor

# Kind of quantity -> units of a file, each with its factor to the internal unit, which comes first.
UNITS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "time": {"s": 1.0, "ms": 1e-3},
        "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2},
        "position": {"m": 1.0, "mm": 1e-3, "cm": 1e-2},
        "pressure": {"kPa": 1.0, "Pa": 1e-3, "bar": 100.0, "mbar": 0.1, "psi": 6.894757293168},
        "mass": {"kg": 1.0, "g": 1e-3},
        "number": {"1": 1.0},
        "id": {"1": 1.0},
        "pose_length": {"mm": 1.0, "m": 1e3, "cm": 10.0},
        "angle": {"deg": 1.0, "rad": 180.0 / np.pi},
        **{sensor.reading_name: sensor.units for sensor in SENSORS.values()},
    }
)
TABLES = (".csv", ".npz")  # endings of logs
_XYZ = ("x", "y", "z")
_POSE = dict.fromkeys(_XYZ, ("pose_length", "mm")) | dict.fromkeys(("yaw", "pitch", "roll"), ("angle", "deg"))


@dataclass(frozen=True)
class Column:
    """One column of a log file."""

    group: str  # field of `Log` with this column
    name: str  # name in the header, without the unit
    kind: str  # kind of quantity, a key of UNITS
    unit: str  # unit that `write_log` uses

    @property
    def header(self) -> str:
        return f"{self.name} [{self.unit}]"

    @property
    def factor(self) -> float:
        """Factor from the file's unit to the internal one."""
        return UNITS[self.kind][self.unit]


def log_columns(
    n_chambers: int, n_springs: int, n_markers: int = 0, reading_name: str = Coil.reading_name
) -> tuple[Column, ...]:
    """Return all columns that a log of an arm may have, in the order of the file."""
    chambers, springs, markers = range(n_chambers), range(n_springs), range(n_markers)
    reading_unit = next(iter(UNITS[reading_name]))
    return (
        Column("time_s", "time", "time", "s"),
        *(Column("readings", f"{reading_name}{k}", reading_name, reading_unit) for k in springs),
        *(Column("spring_m", f"spring{k}", "length", "mm") for k in springs),
        *(Column("pressure_kpa", f"pressure{k}", "pressure", "kPa") for k in chambers),
        *(Column("commanded_kpa", f"commanded{k}", "pressure", "kPa") for k in chambers),
        *(Column("tip_m", f"tip_{axis}", "position", "mm") for axis in _XYZ),
        *(Column("tip_quaternion", f"tip_q{part}", "number", "1") for part in "wxyz"),
        *(Column("marker_m", f"marker{k}_{axis}", "position", "mm") for k in markers for axis in _XYZ),
        Column("payload_kg", "payload", "mass", "g"),
        *(Column("reference_m", f"reference{k}", "length", "mm") for k in springs),
        *(Column("goal", f"goal_{axis}", *_POSE[axis]) for axis in _POSE),
        *(Column("estimate", f"estimate_{axis}", *_POSE[axis]) for axis in _POSE),
        Column("load_kg", "load", "mass", "g"),
        Column("sequence", "sequence", "id", "1"),
    )


@dataclass(frozen=True)
class Log:
    """Rows of one log, ordered by time; a quantity that was not logged is None.

    Chambers and springs are numbered as in the model. Positions and orientation are in the base frame (see
    `mjx_softarm.sensing.pose`). The tip is the centre of the last plate.
    """

    source: str  # file name, for messages
    row: np.ndarray  # (n,) line of the file for each row; the header is line 1
    time_s: np.ndarray  # (n,)
    readings: np.ndarray | None = None  # (n, n_springs) readings of the springs' sensors
    spring_m: np.ndarray | None = None  # (n, n_springs) spring lengths from another instrument
    pressure_kpa: np.ndarray | None = None  # (n, n_chambers) relative to the atmosphere
    commanded_kpa: np.ndarray | None = None  # (n, n_chambers) commands in force, where pressures are measured
    tip_m: np.ndarray | None = None  # (n, 3)
    tip_quaternion: np.ndarray | None = None  # (n, 4) w, x, y, z
    marker_m: np.ndarray | None = None  # (n, n_markers, 3) from the base to the tip
    payload_kg: np.ndarray | None = None  # (n,)
    reference_m: np.ndarray | None = None  # (n, n_springs) references of the springs
    goal: np.ndarray | None = None  # (n, 6) [mm, deg]
    estimate: np.ndarray | None = None  # (n, 6) [mm, deg] tip pose that the controller estimated
    load_kg: np.ndarray | None = None  # (n,) payload that the controller estimated
    sequence: np.ndarray | None = None  # (n,) index of the demonstration that a row belongs to, from 0
    reading_name: str = Coil.reading_name  # quantity of the readings, as their columns are named

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def groups(self) -> dict[str, np.ndarray]:
        """Logged quantities by their fields, in the order of the file."""
        return {name: value for name in GROUPS if (value := getattr(self, name)) is not None}

    def lengths_m(self, sensor: Sensor) -> np.ndarray | None:
        """Return the spring lengths (n, n_springs) [m]: by the readings, NaN where one is not believed.

        Raises:
            LogError: the readings are of another kind of sensor.
        """
        if self.readings is None:
            return self.spring_m
        if self.reading_name != sensor.reading_name:
            problem = f"got readings of another sensor, expected {sensor.reading_name} of a {sensor.kind}"
            raise LogError([Finding(self.source, None, f"{self.reading_name}0", problem)])
        return sensor.lengths(self.readings, np.nan).length_m

    def take(self, rows: np.ndarray) -> Log:
        """Return a log of some rows, given by indices or a mask (n,)."""
        groups: dict[str, Any] = {name: value[rows] for name, value in self.groups.items()}
        return dataclasses.replace(self, row=self.row[rows], **groups)


_NO_GROUPS = ("source", "row", "reading_name")
GROUPS = tuple(item.name for item in dataclasses.fields(Log) if item.name not in _NO_GROUPS)


def log_table(log: Log) -> tuple[tuple[Column, ...], np.ndarray]:
    """Return the columns (k,) of a log, and its numbers (n, k) in the units of the columns."""
    groups = log.groups

    def width(*names: str) -> int:
        return max((groups[name].shape[1] for name in names if name in groups), default=0)

    n_springs = width("readings", "spring_m", "reference_m")
    n_chambers, n_markers = width("pressure_kpa", "commanded_kpa"), width("marker_m")
    known = log_columns(n_chambers, n_springs, n_markers, log.reading_name)
    columns = tuple(column for column in known if column.group in groups)
    table = np.concatenate([np.reshape(value, (len(log), -1)) for value in groups.values()], axis=1)
    return columns, table / [column.factor for column in columns]


def write_log(path: str | Path, log: Log) -> None:
    """Write a log as CSV, or as npz by the suffix of the name; whole or not at all."""
    path = Path(path)
    columns, table = log_table(log)
    headers = [column.header for column in columns]
    with replacing(path) as part, part.open("wb") as file:
        if path.suffix == ".npz":
            np.savez(file, columns=np.array(headers), table=table)
        else:
            np.savetxt(file, table, "%.9g", ",", header=",".join(headers), comments="")
