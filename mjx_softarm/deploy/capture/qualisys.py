"""Frames of Qualisys Track Manager over its real-time protocol, by the package `qtm-rt`.

Positions come in millimetres, axes as a matrix column by column. Unseen bodies and markers are NaN.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import re
import xml.etree.ElementTree
from typing import Any

import numpy as np

from mjx_softarm._support.errors import needing
from mjx_softarm.deploy.capture.system import CaptureFrame, CaptureName, check_names

PORT = 22223  # port of the protocol with little-endian numbers
VERSION = "1.25"  # version of the protocol
WAIT_S = 3.0  # longest wait for QTM's answers
ROUNDS = 50  # most rounds of the event loop in a poll; they read more than a socket holds


class Qualisys:
    """Connection to QTM. Its event loop runs only within `poll`, so there is no thread.

    Raises:
        InputError: the package is missing, or QTM has no such body or no such markers.
        OSError: QTM does not answer.
    """

    def __init__(self, name: CaptureName):
        with needing("capture", "--capture"):
            self._package = importlib.import_module("qtm_rt")
        self._name = name
        self._connection: Any = None
        self._packet: Any = None  # newest packet that was not taken yet
        self._loop = asyncio.new_event_loop()
        with contextlib.ExitStack() as unless_done:
            unless_done.callback(self.close)
            self._loop.run_until_complete(self._connect())
            unless_done.pop_all()

    def poll(self) -> CaptureFrame | None:
        """Return the newest frame since the last call, None without one, at once.

        Raises:
            OSError: the connection has ended.
        """
        newest = None
        for _ in range(ROUNDS):  # each takes a part of the packets that have queued up
            self._loop.run_until_complete(asyncio.sleep(0))
            if self._packet is None:
                break
            newest = self._packet
            self._packet = None
        if not self._connection.has_transport():
            host = self._name.host
            raise ConnectionResetError(f"got an end of the connection by {host}, which is not made again")
        return self._frame(newest) if newest is not None else None

    def close(self) -> None:
        if self._loop.is_closed():
            return
        if self._connection is not None and self._connection.has_transport():
            self._connection.disconnect()
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()

    async def _connect(self) -> None:
        """Connect, find the bodies and markers by name, and ask for frames."""
        name = self._name
        server = f"{name.host}:{PORT}"
        try:
            async with asyncio.timeout(WAIT_S):
                self._connection = await self._package.connect(name.host, PORT, VERSION, timeout=WAIT_S)
                if self._connection is None:
                    raise ConnectionError(f"got no connection to {server} by version {VERSION}")
                self._find(await self._connection.get_parameters(["6d", "3d"]))
                components = ["6d", "3d"] if self._markers else ["6d"]
                await self._connection.stream_frames(components=components, on_packet=self._on_packet)
        except TimeoutError as error:
            raise TimeoutError(f"got no answer and no frame from {server} within {WAIT_S:g} s") from error
        except self._package.QRTCommandException as error:
            raise ConnectionError(f"got the answer {error} from {server}") from error

    def _find(self, settings: bytes) -> None:
        """Find the places of bodies and markers in frames, by their order in QTM's settings."""
        name = self._name
        where = f"--capture qualisys:{name.host}"
        tree = xml.etree.ElementTree.fromstring(settings)
        self._bodies = [node.text or "" for node in tree.findall("*/Body/Name")]
        for body in (name.body, name.base):
            check_names(where, "body", body, self._bodies)
        self._markers: list[int] = []
        if name.markers:
            labels = [node.text or "" for node in tree.findall("*/Label/Name")]
            ours = [label for label in labels if re.fullmatch(re.escape(name.markers) + r"\d+", label)]
            if not ours:
                check_names(where, "marker", f"{name.markers}0", labels)
            ours.sort(key=lambda label: int(label.removeprefix(name.markers)))
            self._markers = [labels.index(label) for label in ours]

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
