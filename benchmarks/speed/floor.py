"""Floor against measured: the least time that the arithmetic of a settle could take, and the time it takes.

Operations and bytes are XLA's own count of the compiled function. A loop it counts once, so the one over
Newton's steps is taken out: one turn of it and what stands outside are counted apart, and the turns are those
of the slowest arm of the batch, since all arms go through them. What the device can do is measured, too: a
large product of matrices and a large copy. The bytes are those of every operation's operands, as if no cache
held them. On a GPU the kernels are counted as well: where the time for each hardly grows with the arms, it is
their number that costs, not their work.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.harness.common import seconds
from benchmarks.speed import hlo
from benchmarks.speed.truth import random_references, settle_function
from mjx_softarm.spec import ArmSpec

MATRIX = {"cpu": 2048, "gpu": 8192}  # rows of the product
UNCOUNTED = ("cholesky", "lu", "triangular_solve", "while", "scan")
COPIED, N_COPIES = {"cpu": 2**24, "gpu": 2**28}, 8  # numbers


def device_rates() -> dict[str, float]:
    """Operations/s of a large float32 product and bytes/s of a large copy, on the default device."""
    backend = "gpu" if jax.default_backend() == "gpu" else "cpu"
    n, n_copied = MATRIX[backend], COPIED[backend]
    matrix, numbers = jnp.ones((n, n)), jnp.ones(n_copied)
    product = jax.jit(functools.partial(jnp.matmul, precision="highest"))
    copy = jax.jit(lambda x: jax.lax.fori_loop(0, N_COPIES, lambda _, x: x + 1.0, x))
    return {
        "product_flop_per_s": 2 * n**3 / seconds(lambda: product(matrix, matrix), 5),
        "copy_bytes_per_s": 8 * N_COPIES * n_copied / seconds(lambda: copy(numbers), 5),
    }


class Cost(NamedTuple):
    """Of one call."""

    flop: float
    moved: float  # bytes


def counted(function: Callable, compiled: Any, *arguments: Any) -> Cost:
    """Operations and bytes of a compiled function.

    Raises:
        RuntimeError: it has a library's factorisation, or a loop.
    """
    for name in _primitives(jax.make_jaxpr(function)(*arguments).jaxpr):
        if name in UNCOUNTED:
            raise RuntimeError(f"{name}: nobody knows whether its operations are counted")
    cost = compiled.cost_analysis()
    return Cost(cost["flops"], cost["bytes accessed"])


def settle_cost(spec: ArmSpec, reference_m: Array) -> tuple[Cost, Cost, int]:
    """What settling by the chain costs outside its loop, and a turn of it; iterations done outside.

    They are found by compiling it with the loop replaced by no turn, by one and by two: in the first turn all
    arms are still alike, and much of it is done once for all of them.
    """
    costs, n_outside = [], 0
    for n_turns in (0, 1, 2):
        with mock.patch.object(jax.lax, "while_loop", functools.partial(_turns, n_turns)):
            function = settle_function(spec)
            compiled = function.lower(reference_m).compile()
            costs.append(counted(function, compiled, reference_m))
        if n_turns == 0:
            n_outside = int(np.max(compiled(reference_m).iterations))
    turn = Cost(*(two - one for one, two in zip(*costs[1:], strict=True)))
    if turn.flop <= 0:
        raise RuntimeError("settle: a turn of its loop costs nothing, so it has none by `jax.lax.while_loop`")
    return costs[0], turn, n_outside


def _turns(n: int, condition: Callable, body: Callable, state: Any) -> Any:
    """So many turns of a loop, whatever the condition says."""
    for _ in range(n):
        state = body(state)
    return state


def _primitives(jaxpr: Any) -> Iterator[str]:
    """Names of all operations, however deep inside."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for parameter in equation.params.values():
            for part in parameter if isinstance(parameter, tuple | list) else (parameter,):
                inner = getattr(part, "jaxpr", part)
                if hasattr(inner, "eqns"):
                    yield from _primitives(inner)


def floor_rows(spec: ArmSpec, arms: Sequence[int]) -> list[dict[str, Any]]:
    """A row for each number of arms, settled by the chain."""
    rates = device_rates()
    on_gpu = jax.default_backend() == "gpu"
    function = settle_function(spec)
    rows = []
    for n in arms:
        reference = jnp.asarray(random_references(spec, n), jnp.float32)
        compiled = function.lower(reference).compile()
        iterations = np.asarray(compiled(reference).iterations)
        outside, turn, n_outside = settle_cost(spec, reference)
        n_turns = int(iterations.max()) - n_outside
        flop, moved = (a + n_turns * b for a, b in zip(outside, turn, strict=True))
        kernels = hlo.read(compiled.as_text()).launches(n_turns) if on_gpu else 0
        measured_s = seconds(functools.partial(compiled, reference))
        rows.append(
            {
                "arms": n,
                "mean_iterations": round(float(iterations.mean()), 2),
                "iterations_run": n_turns + n_outside,
                "kflop_per_arm": round(1e-3 * flop / n, 1),
                "kb_per_arm": round(1e-3 * moved / n, 1),
                "flop_ms": round(1e3 * flop / rates["product_flop_per_s"], 4),
                "bytes_ms": round(1e3 * moved / rates["copy_bytes_per_s"], 4),
                "measured_ms": round(1e3 * measured_s, 3),
                **(
                    {"kernels": kernels, "kernel_us": round(1e6 * measured_s / kernels, 2)} if kernels else {}
                ),
                "gflop_per_s": round(1e-9 * flop / measured_s, 2),
                "product_gflop_per_s": round(1e-9 * rates["product_flop_per_s"], 1),
                "copy_gb_per_s": round(1e-9 * rates["copy_bytes_per_s"], 1),
            }
        )
    return rows
