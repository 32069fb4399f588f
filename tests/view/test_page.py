"""The page's server under clients that stall, go and flood it with drags."""

import threading
import time
from multiprocessing import Pipe

import numpy as np
import pytest

from mjx_softarm.view.channel import ChannelEnd
from mjx_softarm.view.look import look_at
from tests.linear_arm import GOALS, POLICY, REST_M, SPEC, N
from tests.view.conftest import taken

pytest.importorskip("viser", reason="needs viser: pip install -e '.[view]'")
import msgspec
import viser
from viser import _messages
from websockets.sync.client import connect

from mjx_softarm.view.page import Page, Setup

FLOOD_HZ = 500  # a browser sends a drag 60 times a second


class Client:
    """A page without a browser; it reads nothing unless the test does."""

    def __init__(self, server):
        address = f"ws://127.0.0.1:{server.get_port()}"
        self.socket = connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None)
        here, ahead = (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        self.send(
            _messages.ViewerCameraMessage(
                (1.0, 0.0, 0.0, 0.0), here, 1.0, 0.1, 100.0, 100, 100, ahead, (0.0, 0.0, 1.0)
            )
        )

    def send(self, message):
        self.socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    def drag(self, x):
        pose = (1.0, 0.0, 0.0, 0.0), (x, 0.0, -0.5)
        self.send(_messages.TransformControlsUpdateMessage("/gizmo", *pose))


@pytest.fixture
def page(server):
    """The page, and the loop's end of its channel."""
    ours, theirs = Pipe()
    return Page(server, ChannelEnd(theirs), Setup(POLICY, "arm", "127.0.0.1", 8420, True)), ChannelEnd(ours)


def button(server, label):
    handles = server.gui._gui_input_handle_from_uuid.values()
    return next(handle for handle in handles if getattr(handle, "label", "") == label)._impl.uuid


def test_vent_passes_through_a_flood_of_drags(server, page):
    _, loop = page
    flooder, other, over = Client(server), Client(server), threading.Event()

    def flood():
        while not over.wait(1.0 / FLOOD_HZ):
            flooder.drag(0.1)

    thread = threading.Thread(target=flood)
    thread.start()
    taken(loop, "goal")
    began = time.monotonic()
    other.send(_messages.GuiUpdateMessage(button(server, "Vent"), {"value": True}))
    found = taken(loop, "vent")
    over.set()
    thread.join()
    assert time.monotonic() - began < 2.0 and found["vent"] is True
    flooder.drag(0.2)
    wanted = [200.0, 0.0, -500.0, 0.0, 0.0, 0.0]
    deadline = time.monotonic() + 10.0
    while not np.allclose(taken(loop, "goal")["goal"], wanted):  # one for all that were not taken
        assert time.monotonic() < deadline
    flooder.socket.close()
    assert taken(loop, "pages")["pages"] == 1


def test_client_that_reads_nothing_holds_up_no_frame(server, page):
    shown, loop = page
    stalled = Client(server)
    taken(loop, "pages")
    row = {"time_s": 0.0, "goal": GOALS[0], "estimate": GOALS[0]}
    spent_s = []
    for k in range(100):
        look = look_at(row, np.full(N, REST_M + 1e-5 * k), SPEC)._replace(time_s=0.02 * k)
        loop.put(look=look, doing="holds", armed=True, lines=())
        time.sleep(0.002)
        began = time.perf_counter()
        shown.refresh()
        spent_s.append(time.perf_counter() - began)
    assert max(spent_s) < 1.0 and np.median(spent_s) < 0.2
    n_kept = len(server._websock_server._broadcast_buffer.message_from_id)
    assert n_kept < 1000  # newest of each kind: nothing piles up for the client
    stalled.socket.close()
