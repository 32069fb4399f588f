"""Example driver over UDP: one line in each datagram."""

from __future__ import annotations

import socket

from mjx_softarm.deploy.drivers import LineArm

LONGEST = 2048  # bytes of an answer


class UdpArm(LineArm):
    """Arm at an address.

    Attributes:
        address: host and port.
    """

    address = ("192.168.1.10", 5005)

    def __init__(self) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(self.address)

    def send(self, line: bytes) -> None:
        self._socket.send(line)

    def receive(self, timeout_s: float) -> bytes:
        self._socket.settimeout(timeout_s)
        try:
            return self._socket.recv(LONGEST)
        except TimeoutError:
            return b""
