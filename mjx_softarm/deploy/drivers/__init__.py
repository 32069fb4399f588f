"""Example drivers: an arm behind a microcontroller that answers lines of text, over serial or UDP.

Derive a class with your numbers, and give it as `--arm my_arm:Arm`:

    from mjx_softarm.deploy.drivers.serial_line import SerialArm

    class Arm(SerialArm):
        port, baud = "/dev/ttyACM0", 921600
        n = 9

The microcontroller answers each request once, by a line that repeats its letter and number (K counts up).
Lines end in a line feed, over UDP, too. It keeps the pressures until the next `P`. Of the paper's arm, with 9
springs and 9 chambers:

    request         answer                      meaning
    R K             R K r0 ... r8 p0 ... p8     readings in the sensor's unit, taken since the last request
                                                (nan: not read); pressures [kPa] measured, or else commanded
    P K p0 ... p8   P K                         pressures [kPa] taken
    any             E K text                    refused, and why

An answer with another number belongs to an earlier request: it is skipped. A cut or garbled answer counts as
none. The microcontroller should vent by itself after a second without `P`: no driver can do that for it.
`python -m mjx_softarm firmware` writes one that does, for LDC1612 converters and two valves a chamber.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np


class LineArm:
    """Driver of an arm that answers lines; subclasses send and receive them.

    Attributes:
        n: number of chambers.
        n_springs: number of springs; 0: one for each chamber.
        timeout_s: longest time for a request and its answer; a tick has two of them.
    """

    n = 9
    n_springs = 0
    timeout_s = 0.008

    def __init__(self) -> None:
        self._count = 0
        self._measured_kpa = np.full(self.n, np.nan)

    def read_sensors(self) -> np.ndarray:
        """Return the readings (n_springs,); see `ArmIO`."""
        self._measured_kpa = np.full(self.n, np.nan)
        n_springs = self.n_springs or self.n
        readings, self._measured_kpa = np.split(self._ask("R", n_springs + self.n), [n_springs])
        return readings

    def pressures(self) -> np.ndarray:
        """Return the pressures (n,) [kPa] that came with the last readings, NaN if none came."""
        return self._measured_kpa

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Command pressures (n,) [kPa]; see `ArmIO`."""
        self._ask("P", 0, pressure_kpa)

    def send(self, line: bytes) -> None:
        """Send a line, its end included.

        Raises:
            TimeoutError: the line could not be sent within `timeout_s`.
        """
        raise NotImplementedError

    def receive(self, timeout_s: float) -> bytes:
        """Return the next line, its end included, or nothing after the timeout [s]."""
        raise NotImplementedError

    def _ask(self, letter: str, size: int, values: Sequence[float] | np.ndarray = ()) -> np.ndarray:
        """Send a request and return the numbers (size,) of its answer.

        Raises:
            TimeoutError: no answer came in time, or it has another number of values.
            ValueError: the arm refused it.
            OSError: the arm cannot be reached.
        """
        # Request
        end_s = time.monotonic() + self.timeout_s
        self._count += 1
        request = " ".join([letter, str(self._count), *(f"{value:.6g}" for value in values)])
        self.send(f"{request}\n".encode("ascii"))

        # Its answer; answers to earlier requests are skipped.
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
