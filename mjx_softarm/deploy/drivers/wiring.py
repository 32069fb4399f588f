"""Arms without code: `--arm wiring.toml`, a file that names drivers of this package and their settings.

Either one driver has everything,

    [arm]                       # an arm behind a microcontroller; see `mjx_softarm.deploy.drivers`
    driver = "serial"           # or "udp", with address = ["192.168.1.10", 5005]
    port = "/dev/ttyACM0"
    n = 9                       # chambers
    n_springs = 9

or springs and pressures have one each (see `ldc1612`, `festo`):

    [springs]
    driver = "ldc1612"
    channels = [[1, 0x2A, 0], [1, 0x2A, 1], [1, 0x2B, 0]]    # ... bus, address, channel of each spring

    [pressures]
    driver = "cpx-e"
    host = "192.168.1.20"
    modules = "60E-EP-3NO3NI"
    n = 9
    range_kpa = [-100.0, 100.0]
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.drivers.festo import CpxRegulators
from mjx_softarm.deploy.drivers.ldc1612 import LdcSprings
from mjx_softarm.deploy.drivers.serial_line import SerialArm
from mjx_softarm.deploy.drivers.udp import UdpArm


class Wired:
    """An arm whose springs and pressures have a driver each."""

    def __init__(self, springs: Any, pressures: Any):
        self._springs, self._pressures = springs, pressures
        if hasattr(pressures, "pressures"):
            self.pressures = pressures.pressures

    def read_sensors(self) -> np.ndarray:
        return self._springs.read_sensors()

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        self._pressures.write_pressures(pressure_kpa)


def _line(kind: type) -> Callable[..., Any]:
    """Return a function that opens a line driver; its settings are class attributes of the driver."""

    def open_line(**settings: Any) -> Any:
        known = {name for base in kind.__mro__ for name in vars(base) if not name.startswith("_")}
        known -= {name for name in known if callable(getattr(kind, name))}
        if unknown := settings.keys() - known:
            raise TypeError(f"got {', '.join(sorted(unknown))}, expected some of {', '.join(sorted(known))}")
        settings |= {name: tuple(value) for name, value in settings.items() if isinstance(value, list)}
        return type("Arm", (kind,), settings)()

    return open_line


DRIVERS: Mapping[str, Mapping[str, Callable[..., Any]]] = {
    "arm": {"serial": _line(SerialArm), "udp": _line(UdpArm)},
    "springs": {"ldc1612": LdcSprings},
    "pressures": {"cpx-e": CpxRegulators},
}


def wired(path: Path) -> Any:
    """Open the arm that a file describes.

    Raises:
        InputError: the file cannot be read, names other tables, drivers or settings, or a driver cannot
            reach its hardware.
    """
    try:
        tables = tomllib.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"--arm {path}: got {error}, expected a TOML file") from error
    if {*tables} not in ({"arm"}, {"springs", "pressures"}):
        got = ", ".join(tables) or "nothing"
        raise InputError(f"--arm {path}: got {got}, expected the table arm, or springs and pressures")
    opened = {name: _opened(f"--arm {path}: {name}", name, table) for name, table in tables.items()}
    return opened["arm"] if "arm" in opened else Wired(**opened)


def _opened(where: str, name: str, table: Any) -> Any:
    drivers = DRIVERS[name]
    if not isinstance(table, dict) or table.get("driver") not in drivers:
        raise InputError(f"{where}: got {table}, expected a table with driver = {' or '.join(drivers)}")
    settings = {key: value for key, value in table.items() if key != "driver"}
    try:
        return drivers[table["driver"]](**settings)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except (ImportError, OSError, TypeError, ValueError) as error:
        raise InputError(f"{where}: got {type(error).__name__}: {error}") from error
