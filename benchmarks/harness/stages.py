"""Stages whose results stay in a folder, so that the same command continues an interrupted benchmark.

A benchmark is a list of groups of stages. The stages of a group run in processes of their own, two at a time;
the next group begins once all of them are done. A stage whose results exist is skipped. Results are written
whole or not at all, so a stage that was killed is simply not done.
"""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.files import replacing
from mjx_softarm._support.provenance import write_json

SETTINGS_FILE = "settings.json"
N_WORKERS = 2  # each on its share of the cores: faster than one training on all of them
DONE = (0, 1)  # exit statuses of a command that wrote its results; 1: they miss a bound


class WorkStage(NamedTuple):
    """A job, called with the folder, the settings and its inputs; it is done once its results exist."""

    name: str
    results: tuple[str, ...]  # paths in the folder
    function: Callable[..., None]
    inputs: tuple[Any, ...] = ()


def claim(folder: Path, settings: Any, more: Sequence[str] = ()) -> None:
    """Make the folder, or check that its results have these settings.

    Args:
        folder: working folder.
        settings: a dataclass.
        more: fields that may differ, since they add results to the others.

    Raises:
        InputError: the folder has other settings.
    """
    file, given = folder / SETTINGS_FILE, json.loads(json.dumps(dataclasses.asdict(settings)))
    shared = {name: value for name, value in given.items() if name not in more}
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_json(file, shared)
    if differing := difference(json.loads(file.read_text("utf-8")), shared):
        raise InputError(f"{file}: {differing}; choose another folder")


def difference(stored: dict[str, Any], expected: dict[str, Any]) -> str:
    """Return "got ..., expected ..." of the settings that differ, or "" if none does."""
    names = [name for name in expected if stored.get(name) != expected[name]]
    got, asked = (", ".join(f"{name} {values.get(name)}" for name in names) for values in (stored, expected))
    return f"got {got}, expected {asked}" if names else ""


def run_stages(folder: Path, settings: Any, groups: Sequence[Sequence[WorkStage]]) -> None:
    """Run the stages that are not done, group by group.

    Raises:
        InputError: a stage failed, or left no results; those under way are finished, the others not begun.
    """
    for group in groups:
        pending = [stage for stage in group if missing(folder, stage)]
        if pending:
            _in_parallel(folder, settings, pending)


def missing(folder: Path, stage: WorkStage) -> list[str]:
    """Return the results of a stage that do not exist."""
    return [path for path in stage.results if not (folder / path).exists()]


def _in_parallel(folder: Path, settings: Any, stages: Sequence[WorkStage]) -> None:
    """Run stages in processes of their own, `N_WORKERS` at a time."""
    # Workers, each with a share of the cores
    context = multiprocessing.get_context("spawn")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    n_workers = min(N_WORKERS, len(cores) or 1)
    shares = context.Queue()
    for k in range(n_workers):
        shares.put(cores[k::n_workers])
    # All stages, in the order of the list; the first that fails ends them
    pool = ProcessPoolExecutor(n_workers, context, _prepare_worker, (shares,))
    try:
        waiting = {pool.submit(stage.function, folder, settings, *stage.inputs): stage for stage in stages}
        for n_done, future in enumerate(as_completed(waiting), 1):
            stage = waiting[future]
            try:
                future.result()
                if absent := missing(folder, stage):
                    raise InputError(f"got no {', '.join(absent)} in {folder}, expected its results")
            except Exception as error:
                pool.shutdown(wait=True, cancel_futures=True)
                raise InputError(f"{stage.name}: {type(error).__name__}: {error}") from error
            print(f"{n_done} of {len(stages)}: {stage.name}", flush=True)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _prepare_worker(shares: Any) -> None:
    """Keep a worker and its children to its cores; Ctrl-C ends it, as training saves by itself.

    The end of the benchmark, however it comes, ends it too.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if share := shares.get():
        os.sched_setaffinity(0, share)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # of a worker
    parent.join()
    os._exit(1)


def command(log: Path, *words: Any, makes: Path, python: Path | str = sys.executable) -> None:
    """Run a command of this project and append its output to a file.

    Args:
        log: file for the output.
        words: of the command line, after `python -m`.
        makes: file that the command writes. A command that ends with an exception has status 1, too.
        python: interpreter, whose environment may have other packages.

    Raises:
        InputError: it failed, or wrote no such file; the message has the last lines of its output.
    """
    arguments = [str(python), "-m", *map(str, words)]
    with log.open("a", encoding="utf-8") as file:
        status = subprocess.run(arguments, stdout=file, stderr=subprocess.STDOUT, check=False).returncode
    if status not in DONE or not makes.exists():
        last = "\n".join(log.read_text("utf-8").splitlines()[-5:])
        asked = f"python -m {' '.join(arguments[2:])}: got exit status {status}"
        raise InputError(f"{asked}, expected one of {DONE} and {makes}; {log} ends with\n{last}")


def save_arrays(path: Path, arrays: Any) -> None:
    """Write a named tuple of arrays whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays._asdict())


def load_arrays(kind: Any, path: Path) -> Any:
    """Read the named tuple, of the class `kind`, that `save_arrays` wrote.

    Raises:
        InputError: it lacks an array.
    """
    with np.load(path) as file:
        if absent := [name for name in kind._fields if name not in file]:
            why = f"got no {', '.join(absent)}, expected the arrays of this version"
            raise InputError(f"{path}: {why}; remove the file, or choose another folder")
        return kind(**{name: file[name] for name in kind._fields})
