"""Example drivers: an arm behind a microcontroller that answers lines of text, over serial or UDP.

Derive a class with your numbers, and give it as `--arm my_arm:Arm`:

    from mjx_softarm.deploy.drivers.serial_line import SerialArm

    class Arm(SerialArm):
        port, baud = "/dev/ttyACM0", 921600
        n = 9

The microcontroller answers each request once, by a line that repeats its letter and number (K counts up) and
ends in a line feed, over UDP too, and keeps the pressures until the next `P`:

    request         answer                      meaning
    R K             R K r0 ... r8 p0 ... p8     readings in the sensor's unit, taken since the request (nan:
                                                not read); pressures [kPa] measured, or else commanded
    P K p0 ... p8   P K                         pressures [kPa] taken
    any             E K text                    refused, and why

An answer with another number is passed over: it is that of a request given up, and its values are old. An
answer that was cut or garbled counts as none. A microcontroller should vent by itself when no `P` came for a
second, which no driver can do for it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np


class LineArm:
    """Driver of an arm that answers lines; its subclasses carry the lines.

    Attributes:
        n: number of springs and of chambers.
        timeout_s: time [s] for a request and its answer; the two of a tick must fit into its period.
    """

    n = 9
    timeout_s = 0.008

    def __init__(self) -> None:
        self._count = 0
        self._measured_kpa = np.full(self.n, np.nan)

    def read_sensors(self) -> np.ndarray:
        """Return the readings (n,); see `ArmIO`."""
        self._measured_kpa = np.full(self.n, np.nan)  # until they came
        values = self._ask("R", 2 * self.n)
        self._measured_kpa = values[self.n :]
        return values[: self.n]

    def pressures(self) -> np.ndarray:
        """Return the pressures (n,) [kPa] that came with the last readings; NaN where those did not come."""
        return self._measured_kpa

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Command pressures (n,) [kPa]; see `ArmIO`."""
        self._ask("P", 0, pressure_kpa)

    def send(self, line: bytes) -> None:
        """Send a line, its end included.

        Raises:
            TimeoutError: it could not be sent within `timeout_s`.
        """
        raise NotImplementedError

    def receive(self, timeout_s: float) -> bytes:
        """Return the next line, its end included, or nothing where none ended within the timeout [s]."""
        raise NotImplementedError

    def _ask(self, letter: str, size: int, values: Sequence[float] | np.ndarray = ()) -> np.ndarray:
        """Send a request and return the numbers (size,) of its answer.

        Raises:
            TimeoutError: no answer came in time, or it is not of so many numbers.
            ValueError: the arm refused it.
            OSError: the arm cannot be reached.
        """
        end_s = time.monotonic() + self.timeout_s
        self._count += 1
        request = " ".join([letter, str(self._count), *(f"{value:.6g}" for value in values)])
        self.send(f"{request}\n".encode("ascii"))
        while (left_s := end_s - time.monotonic()) > 0.0:
            line = self.receive(left_s).decode("ascii", "replace")
            head, count, *words = line.split() if line.endswith("\n") and len(line.split()) > 1 else ("", "")
            if count != str(self._count):
                continue
            text = " ".join(words)
            if head == "E":
                raise ValueError(f"{letter}: got the refusal {text!r}, expected an answer")
            try:
                numbers = np.array([float(word) for word in words])
            except ValueError as error:
                raise TimeoutError(f"{letter}: got {text!r}, expected numbers") from error
            if head != letter or len(numbers) != size:
                got = f"{head!r} and {len(numbers)} numbers"
                raise TimeoutError(f"{letter}: got {got}, expected {letter!r} and {size}")
            return numbers
        raise TimeoutError(f"{letter}: got no answer, expected one within {1e3 * self.timeout_s:g} ms")
