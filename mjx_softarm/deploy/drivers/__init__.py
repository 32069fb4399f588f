"""Example drivers: an arm behind a microcontroller that answers lines of text, over serial or UDP.

Derive a class with your numbers, and give it as `--arm my_arm:Arm`:

    from mjx_softarm.deploy.drivers.serial_line import SerialArm

    class Arm(SerialArm):
        port, baud = "/dev/ttyACM0", 921600
        n = 9

The microcontroller answers each request once, by a line that repeats its letter and number (K counts up), and
keeps the pressures until the next `P`:

    request         answer                      meaning
    R K             R K r0 ... r8 p0 ... p8     readings in the sensor's unit, taken since the request (nan:
                                                not read); pressures [kPa] measured, or else commanded
    P K p0 ... p8   P K                         pressures [kPa] taken
    any             E K text                    refused, and why

An answer with another number is passed over: it is that of a request given up, and its values are old. A
microcontroller should vent by itself when no `P` came for a second, which no driver can do for it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np


class LineArm:
    """Driver of an arm that answers lines; its subclasses carry the lines.

    Attributes:
        n: number of springs and of chambers.
        timeout_s: time [s] for an answer; the two of a tick must fit into its period.
    """

    n = 9
    timeout_s = 0.008

    def __init__(self) -> None:
        self._count = 0
        self._measured_kpa = np.zeros(self.n)

    def read_sensors(self) -> np.ndarray:
        """Return the readings (n,); see `ArmIO`."""
        values = self._ask("R")
        if len(values) != 2 * self.n:
            raise OSError(f"read_sensors: got {len(values)} numbers, expected {2 * self.n}")
        self._measured_kpa = values[self.n :]
        return values[: self.n]

    def pressures(self) -> np.ndarray:
        """Return the pressures (n,) [kPa] that came with the last readings."""
        return self._measured_kpa

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Command pressures (n,) [kPa]; see `ArmIO`."""
        self._ask("P", pressure_kpa)

    def send(self, line: bytes) -> None:
        """Send a line, its end included."""
        raise NotImplementedError

    def receive(self, timeout_s: float) -> bytes:
        """Return the next line, or what came of it within the timeout [s]."""
        raise NotImplementedError

    def _ask(self, letter: str, values: Sequence[float] | np.ndarray = ()) -> np.ndarray:
        """Send a request and return the numbers of its answer.

        Raises:
            TimeoutError: no answer came in time.
            ValueError: the arm refused it.
            OSError: the arm cannot be reached, or the answer is no list of numbers.
        """
        self._count += 1
        request = " ".join([letter, str(self._count), *(f"{value:.6g}" for value in values)])
        self.send(f"{request}\n".encode("ascii"))
        end_s = time.monotonic() + self.timeout_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            head, count, *words = [*self.receive(left_s).decode("ascii", "replace").split(), "", ""]
            if count != str(self._count):
                continue
            if head == "E":
                raise ValueError(f"{letter}: refused: {' '.join(words).strip()}")
            try:
                return np.array([float(word) for word in words if word])
            except ValueError as error:
                raise OSError(f"{letter}: got {' '.join(words)!r}, expected numbers") from error
        raise TimeoutError(f"{letter}: no answer within {1e3 * self.timeout_s:g} ms")
