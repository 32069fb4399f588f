"""Interface of an arm's driver, which a real arm and its twin both implement.

A driver is a class without arguments. Of an arm with n springs and c chambers (9 each of the paper's arm) it
has

    read_sensors() -> (n,)           needed    readings, in the unit of the specification's sensor
    write_pressures((c,))            needed    pressures to regulate to [kPa]
    pressures() -> (c,)              optional  measured pressures [kPa], logged in place of the commands
    motion_capture() -> Capture      optional  tip (3,), (4,), markers (m, 3), springs (n,); for calibration
    time_s                           optional  clock [s] of a simulated arm, for which no tick waits

No controller uses motion capture; an OSError of `motion_capture` is a missed frame, a gap in the log.
`mjx_softarm.deploy.drivers` has a driver over a serial line that needs only your numbers. An exception other
than those named here ends the run as a fault: the arm is vented and the log is written.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np


class ArmIO(Protocol):
    """Sensors and pumps of one arm with n springs and c chambers, both numbered as in the model.

    The control loop calls `read_sensors`, then `write_pressures`, once per tick of the policy's `rate_hz`,
    from one thread. Neither repeats a failed exchange, nor puts old or made-up values in its place: the loop
    decides whether the arm stops.
    """

    def read_sensors(self) -> np.ndarray:
        """Return the readings (n,), float64, of the springs' sensors, each taken after the last call.

        The unit is that of the specification's sensor: frequencies [Hz] of coils, voltages [V] of draw wires.
        Readings are raw: not calibrated, not filtered, not clipped. A spring that could not be read is NaN.
        The call blocks until the readings are there, for less than one tick.

        Raises:
            TimeoutError: the readings did not come within a tick.
            OSError: the sensors cannot be reached.
        """
        ...

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Set the pressures that the chambers are regulated to, until the next call.

        The call returns once the values are handed over; it does not wait for the chambers to fill.

        Args:
            pressure_kpa (c,) [kPa]: relative to the atmosphere, negative for vacuum.

        Raises:
            ValueError: wrong shape, not finite, or beyond what the hardware can stand; nothing was sent.
            TimeoutError: the values were not accepted within a tick.
            OSError: the pumps cannot be reached.
        """
        ...


class Capture(NamedTuple):
    """One frame of motion capture, in the base frame (see `mjx_softarm.sensing.pose`)."""

    tip_m: np.ndarray  # (3,) centre of the last plate
    tip_quaternion: np.ndarray  # (4,) w, x, y, z; 1, 0, 0, 0 where the arm hangs straight
    marker_m: np.ndarray  # (n_markers, 3) from the base to the tip; (0, 3) without markers
    spring_m: np.ndarray | None = None  # (n,) spring lengths between markers at their ends, if there are any
