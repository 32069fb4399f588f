"""What a GPU is given to do: kernels and bytes of each loop of a step and of a training epoch.

Launching a kernel takes some microseconds, in which a GPU is idle unless the kernel before takes longer.
`least_us` is what a kernel of the loop takes in the mean if all that it touches goes through memory at the
rate of the data sheet: where that is less than a launch, launches set the pace. Where there is no CUDA device
the programs are compiled for an H200 all the same; nothing is run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax

from benchmarks import gpu, hlo
from benchmarks.peers import COMPILER, PeerError, peer_python
from benchmarks.rounds import Facts, Worker, WorkerError

H200_BYTES_PER_S = 4.8e12  # data sheet
N_ARMS = 8192
PROGRAMS = {
    f"env step, chain, {N_ARMS:,} arms": ("env-step", "chain", str(N_ARMS)),
    f"env step, mjx, {N_ARMS:,} arms": ("env-step", "mjx", str(N_ARMS)),
    "training epoch": ("epoch", *gpu.TRAINING),
}
NOTES = {
    "turns": "of a loop; settling goes on until the slowest arm rests, which takes it six or seven",
    "kernels, mb": "of one turn, those of loops inside not among them; bytes as if nothing were cached and "
    "every operand read whole",
    "least_us": f"mb / kernels at {1e-12 * H200_BYTES_PER_S:g} TB/s",
    "training epoch": " ".join(gpu.TRAINING),
}


def measure() -> dict[str, Any]:
    """For each program what it takes to compile, and a row for each of its loops."""
    on_gpu = jax.default_backend() == "gpu"
    try:
        python = None if on_gpu else peer_python(COMPILER)
    except PeerError as error:
        return {"skipped": f"{gpu.NO_DEVICE}; {error}"}
    programs, loops = [], []
    for name, program in PROGRAMS.items():
        worker = Worker(name, ["benchmarks.kernels_worker", "here" if on_gpu else "h200", *program], python)
        print(f"compiling: {name}", flush=True)
        try:
            worker.start()
            facts = dict(worker.facts)
            loops += [{"program": name, **row} for row in rows(told_loop(facts.pop("loops")))]
        except WorkerError as error:
            facts = {"failed": error.reason}
        finally:
            worker.close()
        programs.append({"program": name, **facts})
    return {"compiled": programs, "loops": loops, "notes": NOTES}


def told_loop(told: Sequence[Any]) -> hlo.Loop:
    """A loop as a worker tells it, in JSON's lists."""
    turns, kernels, moved, inside = told
    return hlo.Loop(turns, kernels, moved, tuple(map(told_loop, inside)))


def rows(loop: hlo.Loop, turns: Sequence[str] = ()) -> Iterator[Facts]:
    """A row for a loop, whose turns are told with those of the loops around it, and for each inside it."""
    yield {
        "turns": " x ".join(turns) or "once",
        "kernels": loop.kernels,
        "mb": round(1e-6 * loop.moved, 1),
        "least_us": round(1e6 * loop.moved / H200_BYTES_PER_S / max(loop.kernels, 1), 2),
    }
    for inner in loop.inside:
        yield from rows(inner, [*turns, "until at rest" if inner.turns is None else str(inner.turns)])
