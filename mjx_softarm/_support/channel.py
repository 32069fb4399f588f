"""A connection of two processes in which nobody ever waits for the other.

The loop and the page's server each hold one end. What is put replaces what the other has not taken yet, name
by name: a slow reader misses what is old, and a flood of messages is one message. Two threads of each end do
the waiting.
"""

from __future__ import annotations

import threading
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any


class End:
    """One end of the channel."""

    def __init__(self, connection: Connection):
        # Each operation on these is atomic: no lock that a thread, or a signal that raises, could leave shut.
        self._connection, self._ready = connection, SimpleQueue[None]()
        self._out: dict[str, Any] = {}
        self._in: dict[str, Any] = {}
        self.closed = threading.Event()  # set when the other end is gone
        for pump in (self._send, self._receive):
            threading.Thread(target=pump, daemon=True).start()

    def put(self, **values: Any) -> None:
        """Hand values to the other end, by name."""
        self._out.update(values)
        if self._ready.empty():
            self._ready.put(None)

    def take(self) -> dict[str, Any]:
        """Return the newest values that came since the last call, by name."""
        return _emptied(self._in)

    def _send(self) -> None:
        while not self.closed.is_set():
            self._ready.get()
            try:
                self._connection.send(_emptied(self._out))
            except OSError:
                self.closed.set()

    def _receive(self) -> None:
        while not self.closed.is_set():
            try:
                self._in.update(self._connection.recv())
            except (EOFError, OSError):
                self.closed.set()


def _emptied(values: dict[str, Any]) -> dict[str, Any]:
    return {name: values.pop(name) for name in tuple(values)}
