"""What a GPU is given to do, and eight to exchange: kernels and bytes of each loop of a step and of an epoch.

A kernel is calculated to take a launch, or the time in which what it touches goes through memory at the rate
of the data sheet, whichever is longer. That a launch takes 3 us is an assumption, of a GPU without CUDA
graphs, which XLA uses where it can and which make it shorter; arithmetic and caches are left out. Where there
is no CUDA device the programs are compiled for an H200 all the same, and run on none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.peers import COMPILER, PeerError, peer_python
from benchmarks.harness.rounds import Facts, Worker, WorkerError
from benchmarks.speed import gpu, hlo
from benchmarks.speed.truth import random_references, settle_function
from mjx_softarm.spec import ArmSpec

LAUNCH_S, H200_BYTES_PER_S = 3e-6, 4.8e12
N_ARMS = 8192
ENV_STEPS = {
    f"env step, {engine}, {N_ARMS:,} arms": ("env-step", engine, str(N_ARMS)) for engine in ("chain", "mjx")
}
EPOCH, EPOCH_OF_EIGHT = "training epoch", "training epoch on 8 GPUs"
OF_EIGHT = (
    "n_arms=65536",
    "vector_steps_per_epoch=4",
    "updates_per_env_step=0.0009765625",
    "batch_size=32768",
    "replay_capacity=4194304",
)
PROGRAMS = {**ENV_STEPS, EPOCH: ("epoch", *gpu.TRAINING), EPOCH_OF_EIGHT: ("epoch", *OF_EIGHT)}
NOTES = {
    "turns": "of a loop; settling goes on until the slowest arm rests",
    "kernels, mb": "of one turn, those of loops inside left out; bytes as if every operand were read whole",
    "launch_bound": "share of the kernels that touch too little to take longer than a launch",
    "calculated": f"a kernel takes {1e6 * LAUNCH_S:g} us, or its bytes at {1e-12 * H200_BYTES_PER_S:g} TB/s",
    "exchanges": "of one turn; bytes of what a device has of it before or after, whichever is more",
    EPOCH: " ".join(gpu.TRAINING),
    EPOCH_OF_EIGHT: " ".join(OF_EIGHT),
}


def measure() -> dict[str, Any]:
    """For each program what it takes to compile and, of a step, to run; and a row for each of its loops."""
    on_gpu = jax.default_backend() == "gpu"
    try:
        python = None if on_gpu else peer_python(COMPILER)
    except PeerError as error:
        return {"skipped": f"{gpu.NO_DEVICE}; {error}"}
    turns, programs, loops, exchanged = newton_steps(), [], [], []
    for name, program in PROGRAMS.items():
        where = "h200x8" if name == EPOCH_OF_EIGHT else "here" if on_gpu else "h200"
        worker = Worker(name, ["benchmarks.speed.kernels_worker", where, *program], python)
        print(f"compiling: {name}", flush=True)
        try:
            worker.start()
            facts = dict(worker.facts)
            loop = told_loop(facts.pop("loops"))
            loops += [{"program": name, **row} for row in rows(loop)]
            exchanged += [{"program": name, **row} for row in exchanges(loop)]
            facts |= in_all(loop, turns) if name in ENV_STEPS else {}
        except WorkerError as error:
            facts = {"failed": error.reason}
        finally:
            worker.close()
        programs.append({"program": name, **facts})
    return {
        "newton_steps_of_the_slowest_arm": turns,
        "programs": programs,
        "loops": loops,
        "exchanges": exchanged,
        "notes": NOTES,
    }


def newton_steps() -> int:
    """Of the slowest of as many arms with random references."""
    spec = ArmSpec.default()
    reference = jnp.asarray(random_references(spec, N_ARMS), jnp.float32)
    return int(np.max(settle_function(spec)(reference).iterations))


def told_loop(told: Sequence[Any]) -> hlo.Loop:
    """A loop as a worker tells it, in JSON's lists."""
    turns, kernels, inside, exchanges = told
    made = tuple(hlo.Exchange(*exchange) for exchange in exchanges)
    return hlo.Loop(turns, tuple(kernels), tuple(map(told_loop, inside)), made)


def kernel_s(moved: int) -> float:
    """Time that a kernel is calculated to take, by the bytes it touches."""
    return max(LAUNCH_S, moved / H200_BYTES_PER_S)


def in_all(loop: hlo.Loop, turns: int) -> Facts:
    """An env step of `N_ARMS` whose slowest arm takes so many turns to settle."""
    seconds = loop.total(kernel_s, turns)
    return {
        "kernels": loop.launches(turns),
        "gb": round(1e-9 * loop.total(float, turns), 2),
        "calculated_ms": round(1e3 * seconds, 2),
        "calculated_env_steps_per_s": float(f"{N_ARMS / seconds:.2g}"),
    }


def rows(loop: hlo.Loop) -> Iterator[Facts]:
    """A row for a loop, whose turns are told with those of the loops around it, and for each inside it."""
    for turns, one in _each(loop):
        if n := len(one.kernels):
            yield {
                "turns": turns,
                "kernels": n,
                "mb": round(1e-6 * sum(one.kernels), 1),
                "launch_bound": round(sum(kernel_s(moved) == LAUNCH_S for moved in one.kernels) / n, 2),
                "calculated_us": round(1e6 * sum(map(kernel_s, one.kernels)), 1),
            }


def exchanges(loop: hlo.Loop) -> Iterator[Facts]:
    """A row for each exchange between devices of a loop and of those inside it, likewise."""
    for turns, one in _each(loop):
        for exchange in one.exchanges:
            yield {
                "turns": turns,
                "exchange": exchange.operation,
                "mb": float(f"{1e-6 * exchange.size:.3g}"),
            }


def _each(loop: hlo.Loop, turns: Sequence[str] = ()) -> Iterator[tuple[str, hlo.Loop]]:
    """A loop and those inside it, each after its turns and those of the loops around it."""
    yield " x ".join(turns) or "once", loop
    for inner in loop.inside:
        yield from _each(inner, [*turns, "until at rest" if inner.turns is None else str(inner.turns)])
