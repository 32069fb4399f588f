"""Kernels, bytes and exchanges of each loop of an environment step and of a training epoch on a GPU.

    python -m benchmarks.speed.kernels WHERE PROGRAM SETTING ...    the worker: compiles one program

They are read from the compiled text. WHERE is `here`, this machine's GPU, or `1x1x1` or `1x8x1`, for
one or eight H200s that need not be there: that takes the package jax-cuda12-plugin but neither CUDA nor a
driver, and XLA chooses by rule what it would choose by trying. PROGRAM is `env_step` or `epoch`.

A kernel is an instruction outside of fusions that computes or copies; a fusion or a library's call is one.
Its bytes are those of its operands and results, read and written whole: an upper bound.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from benchmarks.harness.peers import COMPILER, PeerError, peer_python
from benchmarks.harness.rounds import Facts, Worker, WorkerError, serve, working
from mjx_softarm.spec import ArmSpec

N_ARMS = 8192
OF_EIGHT = ("n_arms=65536", "vector_steps_per_epoch=4", "updates_per_env_step=0.0009765625")
OF_EIGHT += ("batch_size=32768", "replay_capacity=4194304")
H200 = """gpu_device_info { core_count: 132 fpus_per_core: 128 memory_bandwidth: 4800000000000
threads_per_block_limit: 1024 threads_per_warp: 32 threads_per_core_limit: 2048 clock_rate_ghz: 1.98
shared_memory_per_block: 49152 shared_memory_per_core: 233472 shared_memory_per_block_optin: 232448
block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535 l2_cache_size: 52428800
registers_per_core_limit: 65536 registers_per_block_limit: 65536 device_memory_size: 151397597184
cuda_compute_capability { major: 9 } } dnn_version_info { major: 9 minor: 10 } platform_name: "CUDA"
runtime_version { major: 12 minor: 9 } device_description_str: "NVIDIA H200"
"""  # Source: XLA, xla/backends/gpu/target_config/specs/h200.txtpb

_NO_KERNEL = "parameter constant tuple get-tuple-element bitcast after-all partition-id replica-id domain"
_EXCHANGES = ("all-gather", "all-reduce", "all-to-all", "collective-permute", "reduce-scatter")
_COMPUTATION = re.compile(r"(ENTRY )?%(\S+) \(.*\{$")
_INSTRUCTION = re.compile(r"\s+(?:ROOT )?%(\S+) = (\(.*?\)|\S+) ([\w-]+)\((.*)")
_ARRAY = re.compile(r"(pred|[a-z]+(\d+)\w*)\[([\d,]*)\]")
_N_TURNS = re.compile(r'"known_trip_count":\{"n":"(\d+)"')
_BRANCHES = re.compile(r"(?:to_apply|(?:true|false)_computation)=%([\w.-]+)|branch_computations=\{([^}]*)\}")
_SCRATCH = re.compile(r"[su]8\[\d*\]")  # working memory of a library's call, among its results


def measure() -> dict[str, Any]:
    """Count the kernels and bytes that a GPU is given, loop by loop; for an H200 where there is no GPU.

    A whole step lasts until the slowest arm has settled.
    """
    import jax

    from benchmarks.speed import gpu
    from benchmarks.speed.truth import random_references, settle_function

    on_gpu, spec = jax.default_backend() == "gpu", ArmSpec.default()
    try:
        python = None if on_gpu else peer_python(COMPILER)
    except PeerError as error:
        return {"skipped": f"{gpu.NO_DEVICE}; {error}"}
    settled = settle_function(spec)(random_references(spec, N_ARMS).astype(np.float32))
    n_newton, one = int(settled.iterations.max()), "here" if on_gpu else "1x1x1"
    programs = {
        "env step, chain": (one, "env_step", f"n_arms={N_ARMS}", "env.engine=chain"),
        "env step, MJX": (one, "env_step", f"n_arms={N_ARMS}", "env.engine=mjx"),
        "training epoch": (one, "epoch", *gpu.TRAINING),
        "training epoch, 8 GPUs": ("1x8x1", "epoch", *OF_EIGHT),
    }
    loops, rows = [], []
    for name, program in programs.items():
        worker, row = Worker(name, ["benchmarks.speed.kernels", *program], python), {"program": name}
        try:
            with working(worker):
                loops += [row | facts for facts in worker.facts["loops"]]
            if program[1] == "env_step":
                outside, with_one = np.array(worker.facts["totals"])
                n_kernels, n_bytes = outside + n_newton * (with_one - outside)
                row |= {"kernels": int(n_kernels), "gb": round(1e-9 * n_bytes, 2)}
        except WorkerError as error:
            row["failed"] = error.reason
        rows.append(row)
    return {"newton_steps_of_the_slowest_arm": n_newton, "programs": rows, "loops": loops}


class Loop(NamedTuple):
    """A loop of a program, or the whole program as a loop of one turn; loops inside it are kept apart."""

    n_turns: int | None  # None: the program decides
    kernels: tuple[int, ...]  # [bytes] read and written by each kernel of a turn
    exchanges: tuple[tuple[str, int], ...]  # operation and bytes of each exchange between devices in a turn
    inside: tuple[Loop, ...]

    def over_turns(self, n_turns: int) -> np.ndarray:
        """Return kernels and bytes (2,) of all turns, `n_turns` of them where the program decides."""
        own = np.array([len(self.kernels), sum(self.kernels)])
        turn = own + sum(loop.over_turns(n_turns) for loop in self.inside)
        return turn * (n_turns if self.n_turns is None else self.n_turns)

    def rows(self, around: Sequence[str] = ()) -> Iterator[Facts]:
        """Yield figures of one turn of this loop and of each one inside it, outermost first."""
        if self.kernels:
            yield {
                "turns": " x ".join(around) or "once",
                "kernels": len(self.kernels),
                "mb": round(1e-6 * sum(self.kernels), 1),
                "exchanges": ", ".join(f"{name} {1e-6 * size:.3g} MB" for name, size in self.exchanges),
            }
        for loop in self.inside:
            yield from loop.rows([*around, "until settled" if loop.n_turns is None else str(loop.n_turns)])


def read(text: str) -> Loop:
    """Return the loops of a compiled program, given its HLO text."""
    computations: dict[str, list[str]] = {}
    entry, current = "", []
    for line in text.splitlines():
        if found := _COMPUTATION.match(line):
            current = computations.setdefault(found[2], [])
            entry = found[2] if found[1] else entry
        current.append(line)
    return _loop(computations, [entry], 1)


def _loop(computations: Mapping[str, Sequence[str]], names: Sequence[str], n_turns: int | None) -> Loop:
    """Return the loop whose turn does the named computations."""
    kernels, exchanges, inside = [], [], []
    for name in names:
        size: dict[str, int] = {}  # [bytes] of each result
        for found in filter(None, map(_INSTRUCTION.match, computations[name])):
            result, kind, operation, rest = found.groups()
            size[result] = _bytes(_SCRATCH.sub("", kind) if operation == "custom-call" else kind)
            if operation == "while":
                known = _N_TURNS.search(rest)  # then the condition is not computed
                parts = re.findall(rf"{'body' if known else '(?:body|condition)'}=%([\w.-]+)", rest)
                inside.append(_loop(computations, parts, int(known[1]) if known else None))
            elif operation in ("call", "conditional"):
                # Of the branches of a condition the largest counts.
                named = ",".join(one or several for one, several in _BRANCHES.findall(rest)).split(",")
                branches = [_loop(computations, [branch.strip(" %")], 1) for branch in named]
                largest = max(branches, key=lambda branch: branch.over_turns(1)[0])
                kernels += largest.kernels
                exchanges += largest.exchanges
                inside += largest.inside
            elif operation not in _NO_KERNEL.split() and not operation.endswith("-done"):
                operands = sum(size[x] for x in re.findall(r"%([\w.-]+)", rest[: rest.index(")")]))
                kernels.append(size[result] + operands)
                if (exchange := operation.removesuffix("-start")) in _EXCHANGES:
                    made = size[result] - operands * kind.startswith("((")  # such results hold the operands
                    exchanges.append((exchange, max(operands, made)))
    return Loop(n_turns, tuple(kernels), tuple(exchanges), tuple(inside))


def _bytes(kind: str) -> int:
    """Return the bytes of an array's type, or of all arrays of a tuple's."""
    return sum(
        math.prod(map(int, filter(None, shape.split(",")))) * int(bits or 8) // 8
        for _, bits, shape in _ARRAY.findall(kind)
    )


def compiled(where: str, program: str, *settings: str) -> Facts:
    """Compile a program; return rows of its loops, and totals of zero and one turn where it decides."""
    if where != "here":
        os.environ["JAX_SKIP_CUDA_CONSTRAINTS_CHECK"] = "1"  # there is no driver to ask
        os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_gpu_autotune_level=0"
    import jax
    from jax.experimental import topologies

    from mjx_softarm.env import ReachEnv
    from mjx_softarm.mechanics import settle
    from train.agent.hindsight_tqc import HindsightTQC
    from train.config import override
    from train.epoch.devices import AXIS, everywhere
    from train.epoch.job import Job
    from train.presets import PRESETS

    if where == "here":
        mesh = jax.sharding.Mesh(np.array(jax.devices("gpu")[:1]), (AXIS,))
    else:
        gpus = topologies.get_topology_desc(platform="cuda", target_config=H200, topology=where)
        mesh = jax.sharding.Mesh(np.array(gpus.devices), (AXIS,))
    config, key = override(PRESETS["quick"], settings), jax.random.PRNGKey(0)
    learner = HindsightTQC(config, env := ReachEnv(config=config.env))
    job = Job(config, env, learner, mesh=mesh if mesh.size > 1 else None)
    function, shapes = job.epoch, (jax.eval_shape(job.init, key),)
    if program == "env_step":
        action = jax.numpy.zeros((config.n_arms, env.action_size))
        function, shapes = jax.jit(job.arms.step), (jax.eval_shape(job.arms.reset, key), action, key)
    each = jax.tree.broadcast((job.sharding,) if job.sharding else everywhere(mesh), shapes)
    placed = jax.tree.map(lambda x, on: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=on), shapes, each)
    with mock.patch.object(settle, "_arms_at_once", lambda n, _: n):  # as on a GPU; this host is a CPU
        lowered = function.lower(*placed)
    loop = read(str(lowered.compile().as_text()))
    return {"loops": list(loop.rows()), "totals": [loop.over_turns(n).tolist() for n in (0, 1)]}


if __name__ == "__main__":
    serve(lambda: (compiled(*sys.argv[1:]), dict))
