"""Programs that take turns, so that whatever else the machine does slows all of them alike.

Each is a process of its own, maybe in another virtual environment. It does a round of work on each request.
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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mjx_softarm._support.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
ANSWER_S = 1800.0  # longest silence of a program; compiling takes minutes

Facts = dict[str, Any]


def n_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Worker:
    """A program that answers with one line of JSON once it is ready, and with one for each round.

    `start` and `round` raise InputError with its last line if it stopped, or was silent for too long.
    """

    def __init__(self, name: str, program: Sequence[str], python: Path | None = None):
        """Name a program of module and arguments, and its interpreter, by default this one."""
        self.name, self.facts = name, {}
        self.command = [str(python or sys.executable), "-m", *program]
        self._process: Any = None

    def start(self) -> None:
        """Start the program and wait until it is prepared; its first answer is in `facts`."""
        print(f"starting: {self.name}", flush=True)
        paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3", "PYTHONPATH": os.pathsep.join(paths)}
        self._output = tempfile.TemporaryFile("w+")  # noqa: SIM115  (closed with the worker)
        self._process = subprocess.Popen(
            self.command,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._output,
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
        try:
            self._process.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
        self._output.close()
        self._process = None

    def _answer(self) -> Facts:
        start, timer = time.perf_counter(), threading.Timer(ANSWER_S, self._process.kill)
        timer.start()
        line = self._process.stdout.readline()
        timer.cancel()
        if line:
            return json.loads(line)
        status = self._process.wait()
        late = f" after {ANSWER_S:g} s in silence" if time.perf_counter() - start > ANSWER_S else ""
        self._output.seek(0)
        last = self._output.read().splitlines()[-15:]
        print(f"failed: {self.name}", *last, sep="\n", flush=True)
        got = " ".join([f"got status {status}{late}, expected a result:", *last[-1:]])
        raise InputError(f"{self.name}: {got}")


def take_turns(workers: Sequence[Worker], n_rounds: int) -> tuple[dict[str, list[Facts]], dict[str, str]]:
    """Return the rounds of each worker that did them all, and the reason of each that failed, by name."""
    rounds: dict[str, list[Facts]] = {worker.name: [] for worker in workers}
    failed: dict[str, str] = {}

    def attempt(worker: Worker, work: Callable[[], Any]) -> None:
        try:
            work()
        except InputError as error:
            failed[worker.name] = str(error)
            worker.close()

    with contextlib.ExitStack() as stack:
        for worker in workers:
            stack.callback(worker.close)
            attempt(worker, worker.start)
        for _ in range(n_rounds):
            for worker in (worker for worker in workers if worker.name not in failed):
                attempt(worker, lambda worker=worker: rounds[worker.name].append(worker.round()))
    return {name: facts for name, facts in rounds.items() if name not in failed}, failed


def serve(prepare: Callable[[], tuple[Facts, Callable[[], Facts]]]) -> None:
    """Answer requests in a worker; `prepare` returns the first answer, and the function that does a round."""
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # output of libraries is no answer
    facts, work = prepare()
    channel.write(json.dumps(facts) + "\n")
    for _ in sys.stdin:
        channel.write(json.dumps(work()) + "\n")
