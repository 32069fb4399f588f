"""Jobs in processes of their own, a few at a time."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

from mjx_softarm._support.errors import InputError

N_WORKERS = 2  # each on cores of its own: faster than one training on all of them

Job = tuple[str, Callable[..., Any], tuple[Any, ...]]  # name, function, arguments


class JobError(InputError):
    """A job that cannot be done; the message says which, and why."""


def in_parallel(jobs: Sequence[Job]) -> dict[str, Any]:
    """Do jobs in processes of their own, a few at a time; return their results by name.

    Raises:
        JobError: one failed; those under way are finished, the others are not begun.
    """
    # Workers, each with a share of the cores.
    context = multiprocessing.get_context("spawn")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else []
    n, queue = min(N_WORKERS, len(cores) or 1), context.Queue()
    for k in range(n):
        queue.put(cores[k::n])
    # All jobs, in the order of the list; the first that fails ends them.
    given: dict[str, Any] = {}
    pool = ProcessPoolExecutor(n, context, _settle_worker, (queue,))
    try:
        waiting = {pool.submit(function, *arguments): name for name, function, arguments in jobs}
        for done in as_completed(waiting):
            name = waiting[done]
            try:
                given[name] = done.result()
            except Exception as error:
                pool.shutdown(wait=True, cancel_futures=True)
                raise JobError(f"{name}: {type(error).__name__}: {error}") from error
            print(f"{len(given)} of {len(jobs)}: {name}", flush=True)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    return given


def _settle_worker(queue: Any) -> None:
    """Keep a worker and its children to its cores; Ctrl-C ends it, as training saves by itself.

    The end of the benchmark, however it comes, ends it too.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if share := queue.get():
        os.sched_setaffinity(0, share)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # of a worker
    parent.join()
    os._exit(1)
