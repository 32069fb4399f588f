"""Programs that take turns, so that whatever else the machine does slows all of them alike.

Each is a process of its own: compilation starts from an empty cache, memory is its own, and it may run in
another virtual environment. It prepares itself, then does one round of work on each request.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

ANSWER_S = 1800.0  # a program that is silent for longer is stopped; compiling takes minutes

Facts = dict[str, Any]


class WorkerError(RuntimeError):
    """A program that stopped before it was told to; the message says which, and the last lines it wrote."""

    @property
    def reason(self) -> str:
        """The message in a line: its first and, if it has more, its last."""
        lines = str(self).splitlines()
        return " ".join(lines[:1] + lines[1:][-1:])


class Worker:
    """A program that answers with one line of JSON once it is ready, and with one for each round.

    Args:
        name: its name in messages.
        program: module and arguments, as after `python -m`.
        python: the interpreter; this one if None.
        n_cores: number of this process's cores that it may use; all if None.
        answer_s: longest silence; None stands for `ANSWER_S`.

    Raises:
        WorkerError: in `start` and `round`, the program stopped or was silent for too long.
    """

    def __init__(
        self,
        name: str,
        program: Sequence[str],
        python: Path | None = None,
        n_cores: int | None = None,
        answer_s: float | None = None,
    ):
        self.name, self.facts, self._answer_s = name, {}, answer_s
        self._command = [str(python or sys.executable), "-m", *program]
        self._n_cores = n_cores
        self._process: Any = None

    def start(self) -> None:
        """Start the program and wait until it is prepared; its first answer is in `facts`."""
        paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3", "PYTHONPATH": os.pathsep.join(paths)}
        with _few_cores(self._n_cores):
            self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115  (closed with the worker)
            self._process = subprocess.Popen(
                self._command,
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._said,
                text=True,
            )
        self.facts = self._answer()

    def round(self) -> Facts:
        """Do one round and return its answer."""
        with contextlib.suppress(BrokenPipeError):  # the answer says why it stopped
            self._process.stdin.write("\n")
            self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """Let the program end, or kill it; do nothing if it is not running."""
        if self._process is None:
            return
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._said.close()
        self._process = None

    def _answer(self) -> Facts:
        limit_s = ANSWER_S if self._answer_s is None else self._answer_s
        start, timer = time.perf_counter(), threading.Timer(limit_s, self._process.kill)
        timer.start()
        line = self._process.stdout.readline()
        timer.cancel()
        if not line:
            status = self._process.wait()
            late = f" after {limit_s:g} s in silence" if time.perf_counter() - start > limit_s else ""
            self._said.seek(0)
            last = "\n".join(self._said.read().splitlines()[-15:])
            raise WorkerError(f"{self.name}: got status {status}{late}, expected a result:\n{last}")
        return json.loads(line)


@contextlib.contextmanager
def working(worker: Worker) -> Iterator[None]:
    """Start a worker, and close it at the end."""
    try:
        print(f"starting: {worker.name}", flush=True)
        worker.start()
        yield
    finally:
        worker.close()


@contextlib.contextmanager
def _few_cores(n: int | None) -> Iterator[None]:
    """Keep programs that are started inside to the first n cores."""
    if n is None:
        yield
        return
    if not hasattr(os, "sched_setaffinity"):
        raise WorkerError(f"cores: got {n} on {sys.platform}, expected Linux to keep programs to some")
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(cores)[:n])
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def take_turns(
    workers: Sequence[Worker], n_rounds: int, n_starting: int = 1
) -> tuple[dict[str, list[Facts]], dict[str, str]]:
    """Start workers, do rounds, one of each worker in turn, and close them.

    Args:
        workers: the programs.
        n_rounds: number of rounds.
        n_starting: number of programs that prepare themselves at once.

    Returns:
        The rounds of each worker that did them all, and the reason of each that failed, by name.
    """
    rounds: dict[str, list[Facts]] = {worker.name: [] for worker in workers}
    failed: dict[str, str] = {}

    def attempt(worker: Worker, work: Callable[[], Any]) -> None:
        try:
            work()
        except WorkerError as error:
            print(f"failed: {error}", flush=True)
            failed[worker.name] = error.reason
            worker.close()

    def start(worker: Worker) -> None:
        print(f"starting: {worker.name}", flush=True)
        attempt(worker, worker.start)

    with contextlib.ExitStack() as stack:
        # Start all workers, some at once.
        for worker in workers:
            stack.callback(worker.close)
        with ThreadPoolExecutor(n_starting) as pool:
            list(pool.map(start, workers))
        # Do the rounds, one worker at a time.
        for _ in range(n_rounds):
            for worker in (worker for worker in workers if worker.name not in failed):
                attempt(worker, lambda worker=worker: rounds[worker.name].append(worker.round()))
    return {name: told for name, told in rounds.items() if name not in failed}, failed


def serve(prepare: Callable[[], tuple[Facts, Callable[[], Facts]]]) -> None:
    """Answer requests in a worker; `prepare` returns the first answer, and the function that does a round."""
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # output of libraries is no answer
    facts, work = prepare()
    channel.write(json.dumps(facts) + "\n")
    for _ in sys.stdin:
        channel.write(json.dumps(work()) + "\n")
