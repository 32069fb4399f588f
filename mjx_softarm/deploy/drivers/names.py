"""Arms by name, and checks before any pressure that an arm is the one of a specification or of a policy.

A name is `package.module:Class`, a driver; `wiring.toml`, an arm at a serial line (`drivers.serial_line`); or
that of a twin, such as `twin:SEED` (`mjx_softarm.twin.names`).
"""

from __future__ import annotations

import importlib
import os
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from mjx_softarm._support.errors import InputError, needing
from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.drivers.serial_line import SerialArm
from mjx_softarm.deploy.link import LOST_TICKS
from mjx_softarm.sensing.estimator import expected_springs
from mjx_softarm.spec import ArmSpec

_TWIN = "mjx_softarm.twin.names"  # imported only when asked for, since it needs MuJoCo
# Deviation of another arm's mean spring length, in mean section lengths; by hand. A payload of 1 kg: 0.05.
_OTHER_LENGTH = 0.25
_ANOTHER = "is it another arm, or not yet switched on"


def open_arm(name: str) -> Any:
    """Open an arm by its name, an `ArmIO`; the module of a class may be in the working directory.

    Raises:
        InputError: the name is malformed, cannot be imported, or is no arm.
    """
    if name.endswith(".toml") and ":" not in name:
        return _wired(Path(name))
    module_name, _, item = name.partition(":")
    if not module_name or not item:
        raise InputError(f"--arm: got {name!r}, expected twin:SEED, wiring.toml or package.module:Class")
    if module_name == "twin":
        with needing("sim", "--arm"):
            twins = importlib.import_module(_TWIN)
        try:
            return twins.twin_of(item)
        except (ValueError, FloatingPointError) as error:
            raise InputError(f"--arm: {error}") from error

    # A driver's class
    if (folder := os.getcwd()) not in sys.path:
        sys.path.insert(0, folder)
    try:
        kind = getattr(importlib.import_module(module_name), item)
    except (ImportError, AttributeError) as error:
        raise InputError(f"--arm {name}: got {error}, expected twin:SEED or a class of yours") from error
    methods = ("read_sensors", "write_pressures")
    if missing := [method for method in methods if not callable(getattr(kind, method, None))]:
        got = f"no method {' or '.join(missing)}"
        raise InputError(f"--arm {name}: got {got}, expected those of deploy.ArmIO")
    try:
        return kind()
    except (ImportError, OSError, TypeError, ValueError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError(f"--arm {name}: got {got}; expected an arm that opens") from error


def _wired(path: Path) -> SerialArm:
    """Open the arm that a file describes."""
    where = f"--arm {path}"
    try:
        tables = tomllib.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        got = error.strerror if isinstance(error, OSError) else f"{error}: no TOML"
        raise InputError(f"{where}: got {got}, expected a TOML file") from error
    table = tables.get("arm")
    if {*tables} != {"arm"} or not isinstance(table, dict) or table.get("driver") != "serial":
        raise InputError(f'{where}: got {tables}, expected the table arm with driver = "serial"')
    # Settings are the class attributes that a class of one's own would have.
    known = SerialArm.__annotations__
    if unknown := table.keys() - known - {"driver"}:
        raise InputError(f"{where}: got {', '.join(sorted(unknown))}, expected some of {', '.join(known)}")
    try:
        return type("Arm", (SerialArm,), table)()
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"{where}: got {type(error).__name__}: {error}") from error


def twin_spec(name: str) -> Path | None:
    """Return the arm, as for `--spec`, that a twin's name has after its @; None if it names none."""
    arm = name.partition("@")[2].partition(":")[0]
    return Path(arm) if name.startswith("twin:") and arm else None


class Paced:
    """A simulated arm that is no faster than a real one."""

    def __init__(self, arm: Any):
        self._arm = arm
        self._began_s = time.monotonic() - arm.time_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Drive a control period and wait for its end; a late period delays all later ones."""
        self._arm.write_pressures(pressure_kpa)
        left_s = self._began_s + self._arm.time_s - time.monotonic()
        self._began_s -= min(left_s, 0.0)
        time.sleep(max(left_s, 0.0))


def check_number(arm: ArmIO, spec: ArmSpec, name: str) -> np.ndarray | None:
    """Return an arm's readings (n_springs,), None where it could not be read: the run then says why.

    Raises:
        InputError: their number is not the specification's.
    """
    try:
        readings = np.array(arm.read_sensors(), float)
    except Exception:  # a driver may raise anything
        return None
    if readings.shape != (spec.n_springs,):
        got = " x ".join(map(str, readings.shape)) + " readings" if readings.ndim else f"{readings}"
        raise InputError(
            f"{name}: read_sensors: got {got}, expected {spec.n_springs} readings, of "
            f"the {spec.structure.n_sections} sections of {spec.name!r}; {_ANOTHER}?"
        )
    return readings


def check_arm(arm: ArmIO, controller: Controller, name: str) -> None:
    """Refuse an arm that is not the policy's, before any pressure: by number, range and lengths of springs.

    Raises:
        InputError: it is another.
    """
    # Readings; a run, too, waits LOST_TICKS ticks for them
    policy = controller.policy
    spec = policy.spec
    length_m = np.full(spec.n_springs, np.nan)
    for _ in range(LOST_TICKS):
        readings = check_number(arm, spec, name)
        if readings is None:
            return
        length_m = policy.sensor.lengths(readings, np.nan).length_m
        if np.isfinite(length_m).any() or not np.isfinite(readings).all():
            break
        time.sleep(0.0 if hasattr(arm, "time_s") else controller.dt_s)
    else:
        (low, high), unit = policy.sensor.range, policy.sensor.unit
        raise InputError(
            f"{name}: got readings of {readings.min():.4g} to {readings.max():.4g} {unit}, expected "
            f"{low:.4g} to {high:.4g} {unit} as of the policy's arm {spec.name!r}; {_ANOTHER}?"
        )

    # Mean length without pressure
    if np.isfinite(length_m).any():
        got_m = np.nanmean(length_m)
        asked_m = np.mean(expected_springs(policy.spring_model, np.zeros(spec.n_chambers)))
        if abs(got_m - asked_m) > _OTHER_LENGTH * spec.length_m / spec.structure.n_sections:
            raise InputError(
                f"{name}: got springs of {1e3 * got_m:.0f} mm in the mean without pressure, expected "
                f"{1e3 * asked_m:.0f} mm as of the policy's arm {spec.name!r}; {_ANOTHER}, or still under "
                "pressure?"
            )
