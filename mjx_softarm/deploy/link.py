"""One arm behind its driver: guarded calls, the pressures in force, time, and the ramp to zero.

Users write drivers, so any method may raise anything: each call names the method that failed, and checks its
answer. A simulated arm has a clock of its own, `time_s`, which advances as pressures are written: a run is as
fast as the computer. For a real arm the loop waits for each tick.
"""

from __future__ import annotations

import time
import traceback
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.xp import Array, array_namespace
from mjx_softarm.deploy.arm_io import ArmIO, Capture
from mjx_softarm.logs.schema import Log
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import ArmSpec

LOST_TICKS = 3  # ticks in a row without a reading after which a sensor counts as lost; by hand
LATE_TICKS = 5  # late ticks in a row after which the arm counts as late; by hand
VENT_KPA_PER_S = 20.0  # ramp to zero; by hand
VENT_TRIES = 250  # failed writes in a row after which the arm counts as not vented; some 5 s, by hand
LOOKS = 50  # number of frames tried before an arm moves
LOOK_S = 0.02  # time between two of them


def vented(pressure_kpa: Array, dt_s: float) -> Array:
    """Return pressures (n_chambers,) [kPa] a tick further along the ramp to zero."""
    step_kpa = VENT_KPA_PER_S * dt_s
    return pressure_kpa - array_namespace(pressure_kpa).clip(pressure_kpa, -step_kpa, step_kpa)


class ArmFault(Exception):
    """A fault that ends a drive; the message names the cause."""


class Link:
    """An arm without pressure at first, and a control loop of a period `dt_s`."""

    def __init__(self, arm: ArmIO, spec: ArmSpec, dt_s: float):
        self._arm: Any = arm
        self._spec = spec
        self._dt_s = dt_s
        self._n_late = 0
        self._simulated = hasattr(arm, "time_s")
        self.measures = hasattr(arm, "pressures")
        self.sees = hasattr(arm, "motion_capture")
        # Shapes of logged arrays; the first frame gives the shape of the markers.
        self._shapes: dict[str, tuple[int, ...]] = {"tip_m": (3,), "tip_quaternion": (4,)}
        self._unsure = False  # the arm may have taken the last pressures, but has not confirmed them
        self.pressure_kpa = np.zeros(spec.n_chambers)  # in force

    def now(self) -> float:
        """Return the time [s].

        Raises:
            ArmFault: the arm's own clock failed.
        """
        if not self._simulated:
            return time.monotonic()
        time_s = self._call("time_s", lambda: float(self._arm.time_s), timeouts=False)
        if not np.isfinite(time_s):
            raise ArmFault(f"time_s: got {time_s}, expected a finite number")
        return time_s

    def wait_until(self, time_s: float) -> None:
        """Sleep until a time [s]; return at once for a simulated arm."""
        if not self._simulated:
            time.sleep(max(0.0, time_s - time.monotonic()))

    def read(self, time_s: float) -> tuple[np.ndarray | None, dict[str, Any]]:
        """Return the readings (n_springs,), None where they did not come in time, and a row of the log.

        The row has time, readings, pressures, measured if they are, and motion capture unless it missed.

        Raises:
            ArmFault: a method failed, or the shape of an array is another.
        """
        n_springs, n_chambers = self._spec.n_springs, self._spec.n_chambers
        try:
            readings = self._call("read_sensors", lambda: np.array(self._arm.read_sensors(), float))
            row = {"readings": self._shaped("read_sensors", readings, (n_springs,))}
        except TimeoutError:
            readings = None
            row = {"readings": np.full(n_springs, np.nan)}
        row |= {"time_s": time_s, "pressure_kpa": self.pressure_kpa}
        if self.measures:
            kpa = self._call("pressures", lambda: np.array(self._arm.pressures(), float), timeouts=False)
            row["pressure_kpa"] = self._shaped("pressures", kpa, (n_chambers,))
            row["commanded_kpa"] = self.pressure_kpa
        if self.sees:
            for name, value in self._call("motion_capture", self._frame).items():
                shape = self._shapes.setdefault(name, value.shape)
                row[name] = self._shaped(f"motion_capture: {name}", value, shape)
        return readings, row

    def write(self, pressure_kpa: np.ndarray) -> bool:
        """Command pressures (n_chambers,) [kPa]; return whether they were taken in time.

        Raises:
            ArmFault: the pressures are not finite, the driver refuses them, or the pumps cannot be reached.
        """
        if not np.isfinite(pressure_kpa).all():
            raise ArmFault(f"write_pressures: got {pressure_kpa} kPa, expected finite numbers")
        self._unsure = True
        try:
            self._call("write_pressures", lambda: self._arm.write_pressures(pressure_kpa))
        except TimeoutError as error:
            self._n_late += 1
            if self._n_late <= 2 * LATE_TICKS:
                return False
            got = f"got {self._n_late} late in a row, expected {2 * LATE_TICKS} at most"
            raise ArmFault(f"write_pressures: {got}") from error
        self.pressure_kpa = pressure_kpa
        self._n_late = 0
        self._unsure = False  # last: a signal may come between these lines
        return True

    def vent(self) -> None:
        """Ramp all pressures to zero, and repeat writes that fail; needs the pumps alone.

        Raises:
            ArmFault: the pumps took no pressures for VENT_TRIES ticks.
        """
        n_failed = 0
        while self._unsure or self.pressure_kpa.any():
            begin_s = time.monotonic()
            try:
                in_time = self.write(vented(self.pressure_kpa, self._dt_s))
                why = "not in time"
            except ArmFault as error:
                in_time, why = False, str(error)
            n_failed = 0 if in_time else n_failed + 1
            if n_failed == VENT_TRIES:
                raise ArmFault(
                    f"vent: got {n_failed} failed writes in a row, expected fewer; the last: {why}"
                )
            self.wait_until(begin_s + self._dt_s)

    def _frame(self) -> dict[str, np.ndarray]:
        try:
            seen = self._arm.motion_capture()
        except OSError:  # a missed frame is a gap in the log
            return {}
        if not isinstance(seen, Capture):
            raise ValueError(f"got {type(seen).__name__}, expected mjx_softarm.deploy.arm_io.Capture")
        return {name: np.array(value, float) for name, value in seen._asdict().items() if value is not None}

    def _call(self, name: str, method: Callable[[], Any], timeouts: bool = True) -> Any:
        """Call the driver; a TimeoutError passes if the caller can go on without an answer."""
        try:
            return method()
        except Exception as error:
            if timeouts and isinstance(error, TimeoutError):
                raise
            raise ArmFault(f"{name}: {describe(error)}") from error

    @staticmethod
    def _shaped(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        if value.shape != shape:
            raise ArmFault(f"{name}: got shape {value.shape}, expected {shape}")
        return value


def describe(error: BaseException) -> str:
    """Return an error's message, with type and place unless it is a documented one."""
    try:
        text = str(error)
    except Exception:  # the driver's own exception cannot make its text
        text = ""
    if isinstance(error, (ArmFault, OSError, ValueError)) and text:
        return text
    place = traceback.extract_tb(error.__traceback__)[-1:]
    where = "".join(f" ({Path(frame.filename).name}, line {frame.lineno})" for frame in place)
    return ": ".join(filter(None, [type(error).__name__, text])) + where


def first_frame(arm: Any, where: str) -> Capture:
    """Return the first frame of motion capture with the tip; look for it for a second at most.

    Raises:
        InputError: there is none; the message begins with `where`.
    """
    why = "an arm without the method motion_capture"
    for _ in range(LOOKS if hasattr(arm, "motion_capture") else 0):
        try:
            seen = arm.motion_capture()
            if np.isfinite(seen.tip_m).all():
                return seen
            why = "motion capture that does not see the tip"
        except Exception as error:  # a driver may raise anything
            why = f"no frame of motion capture: {describe(error)}"
        time.sleep(LOOK_S)
    raise InputError(f"{where}: got {why}, expected a frame with the tip within {LOOKS * LOOK_S:g} s")


class Recorder:
    """Rows of a growing log; at most `kept` of the newest. Its length counts all rows."""

    def __init__(self, kept: int | None = None) -> None:
        self._rows: deque[dict[str, Any]] = deque(maxlen=kept)
        self._n_rows = 0

    def __len__(self) -> int:
        return self._n_rows

    def add(self, row: dict[str, Any]) -> None:
        """Keep a row."""
        self._rows.append(row)
        self._n_rows += 1

    def last(self, n: int) -> list[dict[str, Any]]:
        """Return the last n rows."""
        return list(self._rows)[-n:]

    def log(self, source: str, sensor: Sensor) -> Log:
        """Return the log so far, of an arm with this sensor; NaN for missing values."""
        shapes = {name: np.shape(value) for row in self._rows for name, value in row.items()}
        arrays = {
            name: np.array([row.get(name, np.full(shape, np.nan)) for row in self._rows], float)
            for name, shape in ({"time_s": ()} | shapes).items()
        }
        arrays["time_s"] = arrays["time_s"] - arrays["time_s"][:1]
        row = np.arange(2, len(self._rows) + 2)
        return Log(source=source, row=row, reading_name=sensor.reading_name, **arrays)
