"""Frames of OptiTrack's Motive over NatNet, by the package `natnet`. Positions are in metres.

Motive streams to a multicast group or to each client that asks; both are tried. Switch *Broadcast Frame Data*
and *Rigid Bodies* on in its streaming settings, *Marker Sets* for markers, and *Local Interface* to the
network of this computer.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import socket
import struct
import time
from typing import Any

import numpy as np

from mjx_softarm._support.errors import needing
from mjx_softarm.deploy.capture.system import CaptureFrame, CaptureName, check_names
from mjx_softarm.sensing.pose import rotation_from_quaternion

COMMAND_PORT = 1510
DATA_PORT = 1511
WAIT_S = 2.0  # longest wait for the server's answer, for its descriptions, and for the first frame
AGAIN_S = 1.0  # time without a frame after which the server is asked again; it may have begun anew
MOST = 20  # number of packets that one poll reads at most, so that a flood does not hold up the loop


class _Enough(Exception):
    """Signal that a poll has read the largest number of packets."""


class NatNet:
    """Connection to a NatNet server.

    Raises:
        InputError: the package is missing, or the server has no such body or marker set.
        OSError: the server does not answer, or streams no frame.
    """

    def __init__(self, name: CaptureName):
        with needing("capture", "--capture"):
            self._package = importlib.import_module("natnet")
        self._name = name
        self._host = socket.gethostbyname(name.host)  # looked up once: the package sends at each poll
        self._new: list[Any] = []  # frames that have come since the last poll
        self._described: Any = None  # None while the server is asked, and its bodies' numbers are not known
        self._asked_s = time.monotonic()
        for multicast in (False, True):
            self._client = self._connect(multicast)
            end_s = time.monotonic() + WAIT_S
            while not (self._described and self._new) and time.monotonic() < end_s:
                self._read()
                time.sleep(0.01)
            if self._described and self._new:
                break
            self._client.shutdown()
        else:
            what = "no frame" if self._described else "no description of its bodies"
            raise TimeoutError(f"got {what} from {name.host}, expected Motive to stream")

        # Bodies and markers, as the server describes them
        described = self._described
        where = f"--capture natnet:{name.host}"
        sets = {one.name: len(one.marker_names) for one in described.marker_sets}
        for body in (name.body, name.base):
            check_names(where, "body", body, sorted(one.name for one in described.rigid_bodies))
        check_names(where, "marker set", name.markers, sorted(sets))
        self._n_markers = sets.get(name.markers, 0)

    def poll(self) -> CaptureFrame | None:
        """Return the newest frame since the last call, None without one, at once.

        Raises:
            OSError: a packet cannot be read, or the network is gone.
        """
        self._read()
        frame = self._new[-1] if self._new else None
        now_s = time.monotonic()
        self._new.clear()
        # After a while without a frame the server may have begun anew, and its bodies have other numbers.
        if now_s - self._asked_s > AGAIN_S:
            self._asked_s = now_s
            self._described = None
            self._client.send_request(self._client.NAT_CONNECT)
            self._client.request_modeldef()
        if frame is None or self._described is None:
            return None
        self._asked_s = now_s
        return self._frame(frame)

    def close(self) -> None:
        self._client.shutdown()

    def _connect(self, multicast: bool) -> Any:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((self._host, COMMAND_PORT))  # sends nothing; shows which of our addresses is used
            local = probe.getsockname()[0]
        client = self._package.NatNetClient(
            self._host, local, command_port=COMMAND_PORT, data_port=DATA_PORT, use_multicast=multicast
        )
        client.on_data_frame_received_event.handlers.append(self._on_frame)
        client.on_data_description_received_event.handlers.append(self._on_descriptions)
        try:
            client.connect(WAIT_S)
        except TimeoutError as error:
            raise TimeoutError(f"got no answer from {self._name.host}:{COMMAND_PORT}") from error
        except self._package.NatNetError as error:
            raise OSError(str(error)) from error
        client.request_modeldef()
        return client

    def _read(self) -> None:
        """Read the packets that have come."""
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # the package prints each odd packet
                self._client.update_sync()
        except _Enough:
            pass
        except (struct.error, UnicodeDecodeError, TypeError, self._package.NatNetError) as error:
            raise OSError(f"got a packet that cannot be read: {error}") from error

    def _on_frame(self, frame: Any) -> None:
        self._new.append(frame)
        if len(self._new) >= MOST:
            raise _Enough

    def _on_descriptions(self, described: Any) -> None:
        self._described = described

    def _frame(self, frame: Any) -> CaptureFrame:
        names = {body.id_num: body.name for body in self._described.rigid_bodies}
        bodies = {
            names[body.id_num]: (
                np.array(body.pos),
                np.asarray(rotation_from_quaternion(np.roll(body.rot, 1))),
            )
            for body in frame.rigid_bodies
            if body.id_num in names and body.tracking_valid is not False  # None before NatNet 2.6
        }
        marker_m = np.full((self._n_markers, 3), np.nan)
        for one in frame.marker_sets:
            if one.model_name == self._name.markers and len(one.marker_pos_list) == self._n_markers:
                marker_m = np.array(one.marker_pos_list).reshape(-1, 3)
        marker_m[(marker_m == 0.0).all(axis=1)] = np.nan  # a hidden marker stands at the origin
        return CaptureFrame(frame.suffix.timestamp, bodies, marker_m)
