"""Frames of Qualisys Track Manager over its real-time protocol, by the package `qtm-rt`.

Positions come in millimetres, axes as a matrix column by column. Unseen bodies and markers are NaN.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import logging
import socket
import xml.etree.ElementTree
from functools import partial
from typing import Any

import numpy as np

from mjx_softarm._support.errors import needing
from mjx_softarm.deploy.capture.system import CaptureFrame, CaptureName, check_names, numbered

PORT = 22223  # port of the protocol with little-endian numbers
VERSION = "1.25"  # version of the protocol
WAIT_S = 3.0  # longest wait for QTM's answers
AGAIN_S = 2.0  # time between two tries to reach a server that has gone


class Qualisys:
    """Connection to QTM. Its event loop runs only within `poll`, so there is no thread.

    Raises:
        InputError: the package is missing, or QTM has no such body or no such markers.
        OSError: QTM does not answer.
    """

    def __init__(self, name: CaptureName):
        with needing("capture", "--capture"):
            self._package = importlib.import_module("qtm_rt.qrt")
        logging.getLogger("qtm_rt").addHandler(logging.NullHandler())  # this class reports its errors
        self._name = name
        self._host = socket.gethostbyname(name.host)  # looked up once, not in the loop
        self._error: Exception | None = None  # error of the last try to connect again
        self._connection: Any = None
        self._packet: Any = None  # newest packet that was not taken yet
        self._loop = asyncio.new_event_loop()
        self._task: asyncio.Task | None = None
        try:
            self._loop.run_until_complete(self._connect())
        except (Exception, KeyboardInterrupt):
            self.close()
            raise

    def poll(self) -> CaptureFrame | None:
        """Return the newest frame since the last call, None without one, at once.

        Raises:
            OSError: QTM cannot be reached.
        """
        # Let the event loop take the packets that have come, and try to connect again after a loss.
        if not self._connected() and (self._task is None or self._task.done()):
            self._task = self._loop.create_task(self._again())
        self._loop.run_until_complete(asyncio.sleep(0))
        if not self._connected():
            why = f"; the last try to connect again: {self._error}" if self._error else ""
            raise ConnectionResetError(f"got an end of the connection by {self._name.host}{why}")
        packet = self._packet
        self._packet = None
        return self._frame(packet) if packet is not None else None

    def close(self) -> None:
        if self._loop.is_closed():
            return
        if self._task is not None:
            self._task.cancel()
            self._loop.run_until_complete(asyncio.wait([self._task]))
        if self._connected():
            self._connection.disconnect()
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()

    def _connected(self) -> bool:
        return self._connection is not None and self._connection.has_transport()

    async def _again(self) -> None:
        try:
            await self._connect()
            self._error = None
        except Exception as error:  # it is tried again, and `poll` says why
            self._error = error
            await asyncio.sleep(AGAIN_S)

    async def _connect(self) -> None:
        try:
            async with asyncio.timeout(WAIT_S):
                await self._begin()
        except TimeoutError as error:
            got = f"got no answer and no frame from {self._name.host}:{PORT}"
            raise TimeoutError(f"{got} within {WAIT_S:g} s") from error

    async def _begin(self) -> None:
        """Connect and ask for frames; close the connection if that fails."""
        # Not the package's own `connect`, which leaves the connection open where QTM refuses the protocol
        new_protocol = partial(self._package.QTMProtocol, loop=self._loop)
        try:
            transport, protocol = await self._loop.create_connection(new_protocol, self._host, PORT)
        except OSError as error:
            raise ConnectionError(f"got no connection to {self._name.host}:{PORT}: {error}") from error
        self._packet = None  # one of an earlier connection may have its bodies in another order
        with contextlib.ExitStack() as unless_done:
            unless_done.callback(transport.abort)
            try:
                await protocol.set_version(VERSION)
                connection = self._package.QRTConnection(protocol, WAIT_S)
                await self._ask(connection)
            except self._package.QRTCommandException as error:
                raise ConnectionError(f"got the answer {error} from {self._name.host}:{PORT}") from error
            self._connection = connection
            unless_done.pop_all()

    async def _ask(self, connection: Any) -> None:
        """Find the bodies and markers by name, and ask for frames."""
        name = self._name
        where = f"--capture qualisys:{name.host}"
        settings = await connection.get_parameters(["6d", "3d"])

        # Places of bodies and markers in frames, by the order of QTM's settings
        tree = xml.etree.ElementTree.fromstring(settings)
        self._bodies = [node.text or "" for node in tree.findall("*/Body/Name")]
        for body in (name.body, name.base):
            check_names(where, "body", body, self._bodies)
        labels = [node.text or "" for node in tree.findall("*/Label/Name")]
        self._markers = numbered(name.markers, labels) if name.markers else []
        if name.markers and not self._markers:
            check_names(where, "marker", f"{name.markers}0", labels)

        # Frames
        components = ["6d", "3d"] if self._markers else ["6d"]
        await connection.stream_frames(components=components, on_packet=self._on_packet)

    def _on_packet(self, packet: Any) -> None:
        self._packet = packet

    def _frame(self, packet: Any) -> CaptureFrame:
        poses = (packet.get_6d() or (None, []))[1]
        bodies = {
            body: (1e-3 * np.array(place), np.reshape(turn.matrix, (3, 3)).T)
            for body, (place, turn) in zip(self._bodies, poses, strict=False)
            if np.isfinite([*place, *np.ravel(turn.matrix)]).all()
        }
        marker_m = np.full((len(self._markers), 3), np.nan)
        if self._markers and (markers := packet.get_3d_markers()):
            marker_m = 1e-3 * np.array(markers[1], float)[self._markers]
        return CaptureFrame(1e-6 * packet.timestamp, bodies, marker_m)
