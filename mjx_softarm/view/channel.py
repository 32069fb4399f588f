"""A channel between two processes in which neither end waits for the other.

The control loop and the page's server hold one end each. A new value replaces the value of the same name that
the other end has not taken yet: a slow reader misses old values, and a flood of messages becomes one message.
Each end has two threads that wait on the connection.
"""

from __future__ import annotations

import threading
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any


class ChannelEnd:
    """One end of the channel."""

    def __init__(self, connection: Connection):
        # Operations on these dictionaries are atomic, so no lock can stay closed after a signal that raises.
        self._connection, self._ready = connection, SimpleQueue[None]()
        self._out: dict[str, Any] = {}
        self._in: dict[str, Any] = {}
        self.closed = threading.Event()  # set once the other end is gone
        for pump in (self._send, self._receive):
            threading.Thread(target=pump, daemon=True).start()

    def put(self, **values: Any) -> None:
        """Send values by name to the other end."""
        self._out.update(values)
        if self._ready.empty():
            self._ready.put(None)

    def take(self) -> dict[str, Any]:
        """Return the newest values by name that came since the last call."""
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
