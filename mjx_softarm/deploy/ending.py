"""The one end of all that drives an arm: pressures ramped to zero and the log written, whatever happened."""

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

DONE, MISSED, NOT_WRITTEN, FAULT, INTERRUPTED = (
    0,
    1,
    2,
    3,
    130,
)  # exit statuses; 128 and its number after a signal
_INTERRUPTS = {"drive": 0, "vent": 1, "save": 2}  # Ctrl-C so far that a step goes on after


class Terminated(BaseException):
    """A signal that asks the process to end."""

    def __init__(self, number: int):
        super().__init__(f"ended by {signal.Signals(number).name}")
        self.number = number


class Ending(NamedTuple):
    """End of a drive: its cause, exit status, and whether the arm was vented."""

    cause: str = ""  # why it ended early, or was not vented or saved; or ""
    status: int = DONE  # exit status
    vented: bool = True


def vent_at_end(
    body: Callable[[], Any], link: Link, tell: Callable[[str], Any], save: Callable[[], Any] = lambda: None
) -> Ending:
    """Run `body`, vent the arm and save the log, whatever happens on the way.

    Any exception, Ctrl-C, SIGTERM and SIGHUP end the body. While the arm is vented and the log written, they
    are told and change nothing, but for a second Ctrl-C, which ends the venting.

    Args:
        body: drives the arm.
        link: the arm.
        tell: takes a line for each thing that goes wrong; what it raises then is ignored.
        save: writes the log.
    """
    finish = _Finish({"drive": body, "vent": link.vent, "save": save}, tell)
    with _signals_raise():
        finish.run()
    return Ending("; ".join(finish.causes), finish.status, finish.vented)


class _Finish:
    """Steps that follow one another, whatever each of them raises."""

    def __init__(self, steps: dict[str, Callable[[], Any]], tell: Callable[[str], Any]):
        self._steps, self._tell = steps, tell
        self._left, self._untold, self._n_interrupts = list(steps), [], 0
        self.causes: list[str] = []
        self.status, self.vented = DONE, True

    def run(self) -> None:
        while self._left or self._untold:
            try:  # all that takes time stands in here: an interrupt may come anywhere
                while self._untold:
                    with contextlib.suppress(Exception):
                        self._tell(self._untold.pop(0))
                if self._left:
                    self._steps[self._left[0]]()
                    self._left.pop(0)
            except BaseException as error:
                self._note(error)

    def _note(self, error: BaseException) -> None:
        step = self._left[0] if self._left else ""
        signalled = isinstance(error, (KeyboardInterrupt, Terminated))
        self._n_interrupts += isinstance(error, KeyboardInterrupt)
        text = (str(error) or "interrupted") if signalled else describe(error)
        goes_on = signalled and step != "drive" and self._n_interrupts <= _INTERRUPTS.get(step, 2)
        if signalled:
            number = error.number if isinstance(error, Terminated) else signal.SIGINT
            self.status = self.status or 128 + number
        else:
            self.status = NOT_WRITTEN if step == "save" else FAULT
        if step == "vent" and not goes_on:
            self.vented = False
            text = f"NOT VENTED, THE ARM MAY BE UNDER PRESSURE, switch off its pumps: {text}"
        elif step == "save" and not goes_on:
            text = f"log not written: {text}"
        self.causes.append(text)
        self._untold.append(f"{text} -> vent" if step == "drive" else text)
        if step and not goes_on:
            self._left.pop(0)


@contextlib.contextmanager
def _signals_raise() -> Iterator[None]:
    """Let SIGTERM, and SIGHUP of a terminal that closes, raise `Terminated`, as SIGINT raises by itself."""

    def end(number: int, _frame: Any) -> None:
        raise Terminated(number)

    names = ("SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ()
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def save_log(path: Path, log: Log) -> None:
    """Write a log; where that fails, write it to the folder for temporary files, so that no row is lost.

    Raises:
        OSError: it could not be written to `path`; the message names the file that it is in.
    """
    try:
        write_log(path, log)
    except OSError as error:
        spare = Path(tempfile.mkdtemp()) / path.name
        write_log(spare, log)
        raise OSError(f"{path}: {error.strerror or error}; the log is in {spare}") from error
