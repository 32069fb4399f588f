"""Seconds from the command `train reach` to the first gradient step, and what they are spent on.

Each start is a process of its own. The first one of a preset finds an empty cache of compiled programs, the
second finds the cache that the first has filled. Threads overlap, so the parts may add up to more than the
whole. On a busy machine compare the processor's seconds, of all threads together.

    python -m benchmarks.speed.start PRESET BEGAN    the worker; BEGAN is the time at which it was started
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Annotated, Any

from benchmarks.harness.common import names_of, target
from benchmarks.harness.rounds import ROOT, WorkerError
from train.presets import PRESETS

EMPTY_S = {
    "analytic": 10.0,
    "quick": 12.0,
    "motion-quick": 15.0,
}  # targets; the filled cache's is one for all
FILLED_S = 4.0
STAGES = {"jaxpr_trace": "trace", "jaxpr_to_mlir_module": "lower", "backend_compile": "compile"}
PROGRAMS = {"solve": "poses", "drawing": "state and epoch"}  # by the names of their functions


def measure(presets: Annotated[tuple[str, ...], names_of(PRESETS)] = tuple(EMPTY_S)) -> dict[str, Any]:
    """How long does training take to begin? Two minutes.

    Args:
        presets: presets to start

    Raises:
        WorkerError: a start failed.
    """
    rows, targets = [], []
    for preset in presets:
        with tempfile.TemporaryDirectory() as cache:
            for state, limit_s in ("empty", EMPTY_S.get(preset)), ("filled", FILLED_S):
                row = {"preset": preset, "cache": state, **_start(preset, cache)}
                rows.append(row)
                text, found_s = f"{preset}, {state} cache: {limit_s:g} s" if limit_s else "", row["total_s"]
                targets += [target(text, f"{found_s:.1f} s", found_s <= limit_s)] if limit_s else []
    return {"starts": rows, "targets": targets}


def _start(preset: str, cache: str) -> dict[str, float]:
    """Return the seconds of one start with a cache folder."""
    command = [sys.executable, "-m", "benchmarks.speed.start", preset, repr(time.time())]
    environment = {**os.environ, "XDG_CACHE_HOME": cache}
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise WorkerError(f"start of {preset}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def work(preset: str, began: float) -> None:
    """Train up to the first gradient step, print the seconds as a line of JSON, and leave."""
    # Listen to the compiler.
    import jax

    seconds: defaultdict[str, float] = defaultdict(float)

    def listen(event: str, duration_secs: float, **facts: Any) -> None:
        stage = STAGES.get(event.rsplit("/", 1)[-1].removesuffix("_duration"))
        name = str(facts.get("fun_name", "")).removeprefix("jit(").removesuffix(")")
        if stage:
            seconds[f"{PROGRAMS.get(name, 'others')}: {stage}"] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(listen)

    # Import the command, and stop it where an epoch begins that has a gradient step.
    from train.__main__ import main
    from train.runs import command, run

    imports_s, epoch_of = time.time() - began, run.timed_epoch

    def timed_epoch(job: Any, state: Any, learner: Any, epoch: int) -> Any:
        if not learner.n_updates(epoch + 1):
            return epoch_of(job, state, learner, epoch)
        jax.block_until_ready(state)
        parts = {name: round(spent, 2) for name, spent in sorted(seconds.items()) if spent >= 0.05}
        whole = {"total_s": time.time() - began, "processor_s": time.process_time(), "imports_s": imports_s}
        print(json.dumps({name: round(spent, 2) for name, spent in whole.items()} | parts))
        sys.stdout.flush()
        os._exit(0)

    assert command  # imported for its time
    run.timed_epoch = timed_epoch
    main(["reach", "--preset", preset, "--out", str(Path(os.environ["XDG_CACHE_HOME"], f"run{began:.0f}"))])


if __name__ == "__main__":
    work(sys.argv[1], float(sys.argv[2]))
