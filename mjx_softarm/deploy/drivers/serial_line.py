"""Driver of an arm behind a microcontroller that answers lines of text over a serial port; needs pyserial.

Name your numbers in a file, and give it as `--arm wiring.toml`,

    [arm]
    driver = "serial"
    port = "/dev/ttyACM0"
    baud = 921600
    n = 9                       # chambers
    n_springs = 9

or derive a class with them, and give it as `--arm my_arm:Arm`. The extra `serial` has pyserial.

The microcontroller answers each request once, by a line that repeats its letter and number (K counts up).
Lines end in a line feed. It keeps the pressures until the next `P`. Of the paper's arm, with 9 springs and 9
chambers:

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
from typing import Any

import numpy as np

from mjx_softarm._support.errors import needing

START_S = 5.0  # longest start of a board; many restart as their port is opened, in about 2 s


class SerialArm:
    """Arm at a serial port.

    Attributes:
        port: name of the port.
        baud: bits per second; 115200 is too slow for 50 Hz, since a tick's lines have some 350 characters.
        n: number of chambers.
        n_springs: number of springs; 0: one for each chamber.
        timeout_s: longest time for a request and its answer; a tick has two of them.
    """

    port: str = "/dev/ttyACM0"
    baud: int = 921600
    n: int = 9
    n_springs: int = 0
    timeout_s: float = 0.008

    def __init__(self) -> None:
        with needing("serial", "serial line"):
            import serial
        self._count = 0
        self._measured_kpa = np.full(self.n, np.nan)
        self._late: Any = serial.SerialTimeoutException
        self._rest = b""
        self._serial = serial.Serial(self.port, self.baud, write_timeout=self.timeout_s)
        self._serial.reset_input_buffer()
        self._wait_for_answer()

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
        try:
            self._serial.write(line)
        except self._late as error:
            expected = f"it sent within {1e3 * self.timeout_s:g} ms"
            raise TimeoutError(f"{self.port}: got a line stuck, expected {expected}") from error

    def receive(self, timeout_s: float) -> bytes:
        """Return the next line, its end included, or nothing after the timeout [s]."""
        if b"\n" not in self._rest:
            self._serial.timeout = timeout_s
            self._rest += self._serial.read(max(1, self._serial.in_waiting))
        line, end, rest = self._rest.partition(b"\n")
        if not end:
            return b""
        self._rest = rest
        return line + end

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
            words = line.split() if line.endswith("\n") else []  # a cut answer counts as none
            if words[1:2] != [str(self._count)]:
                continue
            head, _, *words = words
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

    def _wait_for_answer(self) -> None:
        end_s = time.monotonic() + START_S
        while True:
            try:
                self.read_sensors()
                return
            except TimeoutError as error:
                if time.monotonic() > end_s:
                    self._serial.close()
                    got = f"got no readings, expected some within {START_S:g} s; {error}"
                    raise OSError(f"{self.port}: {got}") from error
