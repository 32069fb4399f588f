"""Stages whose results stay in a folder, so that the same command continues an interrupted benchmark.

Results are written whole or not at all, so a stage that was killed is simply not done.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import write_json

EVALUATION_FILE = "evaluation.json"  # of a run, written once its training is done
N_WORKERS = 2  # each on its share of the cores: faster than one training on all of them
DONE = (0, 1)  # exit statuses of a command that wrote its results; 1: they miss a bound


class WorkStage(NamedTuple):
    """A function of the folder, the settings and some inputs; it is done once its results exist."""

    results: tuple[str, ...]  # paths in the folder
    function: Callable[..., None]
    inputs: tuple[Any, ...] = ()

    def missing(self, folder: Path) -> list[str]:
        """Return the results that do not exist."""
        return [path for path in self.results if not (folder / path).exists()]


def claim(folder: Path, settings: dict[str, Any]) -> None:
    """Make the folder, or raise InputError if its results have other settings."""
    file = folder / "settings.json"
    expected = json.loads(json.dumps(settings))
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_json(file, expected)
    stored = json.loads(file.read_text("utf-8"))
    if names := [name for name in expected if stored.get(name) != expected[name]]:
        got, asked = (", ".join(f"{name} {made.get(name)}" for name in names) for made in (stored, expected))
        raise InputError(f"{file}: got {got}, expected {asked}; choose another folder")


def run_stages(folder: Path, settings: Any, groups: Sequence[Sequence[WorkStage]]) -> None:
    """Run the stages that are not done, group by group; those of a group in two processes.

    Raises:
        InputError: a stage failed, or left no results; those under way are finished, the others not begun.
    """
    context = multiprocessing.get_context("spawn")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    for group in groups:
        pending = [stage for stage in group if stage.missing(folder)]
        shares = context.Queue()
        for k in range(N_WORKERS):
            shares.put(cores[k::N_WORKERS] or cores)
        with ProcessPoolExecutor(N_WORKERS, context, _prepare_worker, (shares,)) as pool:
            stages = {
                pool.submit(stage.function, folder, settings, *stage.inputs): stage for stage in pending
            }
            for n_done, future in enumerate(as_completed(stages), 1):
                stage = stages[future]
                try:
                    future.result()
                    if missing := stage.missing(folder):
                        raise InputError(f"got no {', '.join(missing)} in {folder}, expected its results")
                except Exception as error:
                    pool.shutdown(cancel_futures=True)
                    raise InputError(f"{stage.results[0]}: {type(error).__name__}: {error}") from error
                print(f"{n_done} of {len(pending)}: {stage.results[0]}", flush=True)


def _prepare_worker(shares: Any) -> None:
    """Keep a worker and its children to its cores. It ends with Ctrl-C, and when the benchmark ends."""
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
    """Run `python -m` with some words, and append the output to a file.

    Raises:
        InputError: it failed, or did not write the file `makes`; an exception's status is 1, too.
    """
    arguments = [str(python), "-m", *map(str, words)]
    with log.open("a", encoding="utf-8") as file:
        status = subprocess.run(arguments, stdout=file, stderr=subprocess.STDOUT, check=False).returncode
    if status not in DONE or not makes.exists():
        last = "\n".join(log.read_text("utf-8").splitlines()[-5:])
        asked = f"python -m {' '.join(arguments[2:])}: got exit status {status}"
        raise InputError(f"{asked}, expected one of {DONE} and {makes}; {log} ends with\n{last}")


def train(run: Path, task: str, *words: Any) -> None:
    """Train with `python -m train TASK` into the folder `run`, or resume a training that was interrupted.

    A run without a checkpoint, or without a config, which is written last, starts anew.
    """
    saved = any(path.name.isdecimal() for path in (run / "checkpoints").glob("*"))
    begun = saved and (run / "config.json").exists()
    if not begun:
        shutil.rmtree(run, ignore_errors=True)
    options = ("--resume", run) if begun else (*words, "--out", run)
    command(run.with_suffix(".log"), "train", task, *options, makes=run / EVALUATION_FILE)
