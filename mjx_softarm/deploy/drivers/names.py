"""Arms by name.

    package.module:Class   a driver
    wiring.toml            hardware by its settings (`mjx_softarm.deploy.drivers.wiring`)
    twin:SEED              a twin; `twin:rod:SEED` is a rod; `twin:SEED@ARM` has another arm, as for `--spec`

Options follow a twin's name, in this order: `:pipe300`, or another name of
`mjx_softarm.mechanics.pipe.PIPES`, puts it into a pipe. `:aged` is the same
arm some months later: each spring's zero is 1 mm off, and the chambers are 5 % softer. `:exact` has all parts
as specified, with friction, hysteresis and noise. `:lost4` takes the pressure of chamber 4. `:500g` hangs a
payload of 500 g to it.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from mjx_softarm._support.errors import InputError, needing
from mjx_softarm.deploy.drivers.wiring import wired

_TWIN = "mjx_softarm.twin.names"  # imported only when asked for, since it needs MuJoCo
_METHODS = ("read_sensors", "write_pressures")


def open_arm(name: str) -> Any:
    """Open an arm: an `ArmIO`, maybe with `pressures`, `motion_capture` or a clock of its own, `time_s`.

    Args:
        name: a name as this module describes them. A class has no arguments; its module may be in the
            working directory.

    Raises:
        InputError: the name is malformed, cannot be imported, or is no arm.
    """
    # Hardware by its settings
    if name.endswith(".toml") and ":" not in name:
        return wired(Path(name))

    # A twin
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
    if (here := os.getcwd()) not in sys.path:
        sys.path.insert(0, here)
    try:
        kind = getattr(importlib.import_module(module_name), item)
    except ImportError as error:
        raise InputError(f"--arm {name}: got {error}, expected a module that can be imported") from error
    except AttributeError as error:
        got = f"no {item!r} in {module_name}"
        raise InputError(f"--arm {name}: got {got}, expected an arm's class") from error
    if missing := [method for method in _METHODS if not callable(getattr(kind, method, None))]:
        got = f"no method {' or '.join(missing)}"
        raise InputError(f"--arm {name}: got {got}, expected those of deploy.ArmIO")
    try:
        return kind()
    except (ImportError, OSError, TypeError, ValueError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError(f"--arm {name}: got {got}; expected an arm that opens") from error


def twin_spec(name: str) -> Path | None:
    """Return the arm, as for `--spec`, that a twin's name has after its @; None if it names none."""
    arm = name.partition("@")[2].partition(":")[0]
    return Path(arm) if name.startswith("twin:") and arm else None


class Paced:
    """A simulated arm that is no faster than a real one."""

    def __init__(self, arm: Any):
        self._arm, self._began_s = arm, time.monotonic() - arm.time_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Drive a control period and wait for its end; a late period delays all later ones."""
        self._arm.write_pressures(pressure_kpa)
        left_s = self._began_s + self._arm.time_s - time.monotonic()
        self._began_s -= min(left_s, 0.0)
        time.sleep(max(left_s, 0.0))
