"""End of a drive, alike for runs and recordings.

Whatever ends a drive, the pressures are ramped to zero and the log is written.
"""

from __future__ import annotations

import contextlib
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from mjx_softarm.deploy.link import Link, describe
from mjx_softarm.logs.schema import Log, write_log

# Exit statuses; that of a signal is 128 + its number.
DONE = 0
MISSED = 1
NOT_WRITTEN = 2
FAULT = 3
_INTERRUPTS = {"drive": 0, "vent": 1, "save": 2}  # number of Ctrl-C so far that a step survives


class Terminated(BaseException):
    """A signal that ends a step."""

    def __init__(self, number: int):
        by = f"ended by {signal.Signals(number).name}"
        super().__init__("interrupted" if number == signal.SIGINT else by)
        self.number = number


class Ending(NamedTuple):
    """End of a drive: its cause, exit status, and whether the arm was vented."""

    cause: str = ""  # why it ended early, or was not vented or saved; or ""
    status: int = DONE  # exit status
    vented: bool = True


def vent_at_end(
    body: Callable[[], Any], link: Link, tell: Callable[[str], Any], save: Callable[[], Any] = lambda: None
) -> Ending:
    """Run `body`, which drives the arm, then vent the arm and save the log, whatever happens.

    Any exception, Ctrl-C, SIGTERM and SIGHUP end the body. During venting and saving they are noted and
    change nothing; only a second Ctrl-C ends the venting. `tell` takes a line for each error, last, since a
    terminal may block; its own exceptions are ignored.
    """
    finish = _Finish()
    with _signals(finish.on_signal):
        finish.run("drive", body)
        finish.run("vent", link.vent)
        finish.run("save", save)
    for line in finish.lines:
        with contextlib.suppress(Exception):
            tell(line)
    return Ending("; ".join(finish.causes), finish.status, finish.vented)


class _Finish:
    """Notes of the steps, each of which runs whatever the one before raised."""

    def __init__(self) -> None:
        self._running = ""
        self._signals: list[int] = []  # signals that ended no step
        self._n_interrupts = 0
        self.causes: list[str] = []
        self.lines: list[str] = []  # messages for `tell`
        self.status = DONE
        self.vented = True

    def run(self, step: str, action: Callable[[], Any]) -> None:
        """Run a step, again where a signal ended it that it survives."""
        goes_on = True
        while goes_on:
            error = self._attempt(step, action)
            goes_on = error is not None and self._note(step, error)
            while self._signals:
                self._note(step, Terminated(self._signals.pop(0)), ended=False)

    def on_signal(self, number: int, _frame: Any) -> None:
        """Raise in the step that the signal ends, once; note it otherwise."""
        self._n_interrupts += number == signal.SIGINT
        ends = number == signal.SIGINT and self._n_interrupts > _INTERRUPTS.get(self._running, 2)
        if self._running and (ends or self._running == "drive"):
            self._running = ""
            raise Terminated(number)
        self._signals.append(number)

    def _attempt(self, step: str, action: Callable[[], Any]) -> BaseException | None:
        """Return the exception of a step; a signal may come anywhere in here, even with another error."""
        try:
            try:
                self._running = step
                action()
                self._running = ""
            except BaseException as error:
                self._running = ""
                return error
        except Terminated as error:
            return error
        return None

    def _note(self, step: str, error: BaseException, ended: bool = True) -> bool:
        """Note an error or a signal; return whether the step goes on after it."""
        signalled = isinstance(error, (KeyboardInterrupt, Terminated))
        self._n_interrupts += isinstance(error, KeyboardInterrupt)  # raised by the body itself
        survives = step != "drive" and self._n_interrupts <= _INTERRUPTS[step]
        goes_on = not ended or (signalled and survives)
        if signalled:
            text = str(error) or "interrupted"
            number = error.number if isinstance(error, Terminated) else signal.SIGINT
            self.status = self.status or 128 + number
        else:
            text = describe(error)
            self.status = NOT_WRITTEN if step == "save" else FAULT
        if step == "vent" and not goes_on:
            self.vented = False
            text = f"NOT VENTED, THE ARM MAY BE UNDER PRESSURE, switch off its pumps: {text}"
        elif step == "save" and not goes_on:
            text = f"log not written: {text}"
        self.causes.append(text)
        self.lines.append(f"{text} -> vented" if step == "drive" else text)
        return goes_on


@contextlib.contextmanager
def _signals(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Install the handler for SIGINT, SIGTERM, and SIGHUP of a terminal that closes."""
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    if threading.current_thread() is not threading.main_thread():
        names = ()
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


def save_log(path: Path, log: Log) -> None:
    """Write a log; if that fails, to the folder for temporary files, as npz if the format was the reason.

    Raises:
        OSError: the log could not be written to `path`; the message names the second file.
    """
    try:
        write_log(path, log)
    except Exception as error:
        name = path.name if isinstance(error, OSError) else f"{path.stem}.npz"
        spare = Path(tempfile.mkdtemp()) / name
        write_log(spare, log)
        why = getattr(error, "strerror", None) or error
        raise OSError(f"{path}: got {why}, expected to write it; the log is in {spare}") from error
