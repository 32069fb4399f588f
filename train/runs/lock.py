"""A lock on the folder of a run or a sweep, so that one process trains in it at a time."""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path

from train.epoch.devices import is_first_process
from train.runs.checkpoint import RunError

LOCK_FILE = "training.lock"


@contextlib.contextmanager
def sole_trainer(path: Path) -> Iterator[None]:
    """Lock a folder while training in it; a killed process releases the lock.

    Where several processes train together, the first one holds it.

    Raises:
        RunError: another process holds it.
    """
    with contextlib.ExitStack() as stack:
        if is_first_process():
            file = stack.enter_context(open(path / LOCK_FILE, "w"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise RunError(
                    f"{path}: got another process that trains in it, expected none; stop it, or wait"
                ) from error
        yield
