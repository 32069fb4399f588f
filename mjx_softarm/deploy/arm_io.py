"""Interface of an arm's driver, which a real arm and its twin both implement.

A driver is a class without arguments. Of an arm with n springs and n chambers (9 of the paper's arm), it has

    read_sensors() -> (n,)           needed    readings, in the unit of the specification's sensor
    write_pressures((n,))            needed    pressures to regulate to [kPa]
    pressures() -> (n,)              optional  pressures measured [kPa], logged in place of those commanded
    motion_capture() -> Capture      optional  tip (3,), (4,), markers (m, 3), springs (n,); for calibration
    time_s                           optional  clock [s] of a simulated arm, which nobody waits for

`mjx_softarm.deploy.drivers` has drivers over serial and UDP that need only your numbers.

Whatever else a driver raises ends the run as a fault: the arm is vented and the log is written.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np


class ArmIO(Protocol):
    """Sensors and pumps of one arm with n springs and n chambers, both numbered as in the model.

    The control loop calls `read_sensors`, then `write_pressures`, once per tick of the policy's
    `rate_hz`, from one thread. Neither repeats a failed exchange by itself, nor puts old or made-up values in
    its place: whether the arm stops is for the loop to say.
    """

    def read_sensors(self) -> np.ndarray:
        """Return what the springs' sensors read (n,), float64, each read after the last call.

        In the unit of the specification's sensor: frequencies [Hz] of coils, voltages [V] of draw wires.

        Blocks until the readings are there, for less than one tick. They are raw: not calibrated, not
        filtered, not clipped. A single spring that could not be read is NaN; `Sensor.lengths` reports
        it as a fault.

        Raises:
            TimeoutError: the readings did not come within a tick.
            OSError: the sensors cannot be reached.
        """
        ...

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Set what the chambers' pressures are regulated to.

        Returns once the values are handed over, without waiting for the chambers to fill; they hold until the
        next call.

        Args:
            pressure_kpa (n,) [kPa]: relative to the atmosphere, negative for vacuum.

        Raises:
            ValueError: wrong shape, not finite, or beyond what the hardware can stand; nothing was sent.
            TimeoutError: the values were not accepted within a tick.
            OSError: the pumps cannot be reached.
        """
        ...


class Capture(NamedTuple):
    """One frame of motion capture, in the base frame (see `mjx_softarm.sensing.pose`).

    Attributes:
        tip_m (3,) [m]: centre of the last plate.
        tip_quaternion (4,): w, x, y, z; 1, 0, 0, 0 where the arm hangs straight.
        marker_m (n_markers, 3) [m]: from the base to the tip; (0, 3) without markers.
        spring_m (n,) [m]: spring lengths between markers at their ends, if there are any.
    """

    tip_m: np.ndarray
    tip_quaternion: np.ndarray
    marker_m: np.ndarray
    spring_m: np.ndarray | None = None


class MotionCapture(Protocol):
    """Motion capture of an arm, for calibration logs and to verify; no controller may look at it."""

    def motion_capture(self) -> Capture:
        """Return where tip and markers are now.

        Raises:
            OSError: this frame is missing; it becomes a gap in the log.
        """
        ...
