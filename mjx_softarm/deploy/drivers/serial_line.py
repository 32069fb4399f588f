"""Example driver over a serial port; needs pyserial (`pip install 'mjx-softarm[serial]'`)."""

from __future__ import annotations

from typing import Any

from mjx_softarm.deploy.drivers import LineArm


class SerialArm(LineArm):
    """Arm at a serial port.

    Attributes:
        port: name of the port.
        baud: bits per second. A tick's lines have some 350 characters: 115200 is too slow for 50 Hz.
    """

    port = "/dev/ttyACM0"
    baud = 921600

    def __init__(self) -> None:
        import serial

        super().__init__()
        timeouts: dict[str, Any] = {"timeout": self.timeout_s, "write_timeout": self.timeout_s}
        self._serial = serial.Serial(self.port, self.baud, **timeouts)
        self._serial.reset_input_buffer()

    def send(self, line: bytes) -> None:
        self._serial.write(line)

    def receive(self, timeout_s: float) -> bytes:
        return self._serial.read_until(b"\n")
