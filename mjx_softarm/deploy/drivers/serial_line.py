"""Example driver over a serial port; needs pyserial (extra `serial`)."""

from __future__ import annotations

import time
from typing import Any

from mjx_softarm._support.errors import needing
from mjx_softarm.deploy.drivers import LineArm

START_S = 5.0  # longest start of a board; many restart as their port is opened, in about 2 s


class SerialArm(LineArm):
    """Arm at a serial port.

    Attributes:
        port: name of the port.
        baud: bits per second; 115200 is too slow for 50 Hz, since a tick's lines have some 350 characters.
    """

    port = "/dev/ttyACM0"
    baud = 921600

    def __init__(self) -> None:
        with needing("serial", "serial line"):
            import serial
        super().__init__()
        self._late: Any = serial.SerialTimeoutException
        self._rest = b""
        self._serial = serial.Serial(self.port, self.baud, write_timeout=self.timeout_s)
        self._serial.reset_input_buffer()
        self._wait_for_answer()

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

    def send(self, line: bytes) -> None:
        try:
            self._serial.write(line)
        except self._late as error:
            expected = f"it sent within {1e3 * self.timeout_s:g} ms"
            raise TimeoutError(f"{self.port}: got a line stuck, expected {expected}") from error

    def receive(self, timeout_s: float) -> bytes:
        if b"\n" not in self._rest:
            self._serial.timeout = timeout_s
            self._rest += self._serial.read(max(1, self._serial.in_waiting))
        line, end, rest = self._rest.partition(b"\n")
        if not end:
            return b""
        self._rest = rest
        return line + end
