"""Floor against measured: the least time that the arithmetic of a settle could take, and the time it takes.

Operations and bytes are XLA's own count of the compiled function. It knows nothing of LAPACK or cuSOLVER,
whose work is added from formulas, and counts the body of a loop once. So the count is taken times the
iterations that the slowest arm of the batch needs, which all arms go through; what stands outside the loop is
counted as often, so it is rather too high than too low. What the device can do is measured, too: a large
product of matrices and a large copy. The bytes are those of every operation's operands, as if no cache held
them. Where the time of a call hardly grows with the arms, it is the number of kernels that costs, not their
work.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import seconds
from benchmarks.truth import random_references, settle_function
from mjx_softarm.spec import ArmSpec

MATRIX = {"cpu": 2048, "gpu": 8192}  # rows of the product
COPIED, N_COPIES = {"cpu": 2**24, "gpu": 2**28}, 8  # numbers
LIBRARY = {"cholesky": "potrf", "triangular_solve": "trsm", "lu": "getrf"}  # as in custom calls' names


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


def counted(function: Callable, compiled: Any, *arguments: Any) -> tuple[float, float]:
    """Operations and bytes of one call of a jitted function that was compiled, the body of a loop once."""
    cost, text = compiled.cost_analysis(), compiled.as_text()
    library = sum(
        flop
        for name, flop in _linear_algebra(jax.make_jaxpr(function)(*arguments).jaxpr)
        if LIBRARY[name] in text
    )
    return cost["flops"] + library, cost["bytes accessed"]


def _linear_algebra(jaxpr: Any) -> Iterator[tuple[str, float]]:
    """Name and operations of each factorisation and triangular solve, however deep inside."""
    for equation in jaxpr.eqns:
        name, shape = equation.primitive.name, equation.invars[0].aval.shape if equation.invars else ()
        if name in LIBRARY:
            n, batch = shape[-1], int(np.prod(shape[:-2]))
            per = {"cholesky": n**3 / 3, "lu": 2 * n**3 / 3, "triangular_solve": n**2}[name]
            columns = equation.invars[1].aval.shape[-1] if name == "triangular_solve" else 1
            yield name, batch * per * columns
        for parameter in equation.params.values():
            if hasattr(parameter, "transpose_solve"):  # of a linear solve, whose other parts are derivatives
                parameter = parameter.solve
            for part in parameter if isinstance(parameter, tuple | list) else (parameter,):
                inner = getattr(part, "jaxpr", part)
                if hasattr(inner, "eqns"):
                    yield from _linear_algebra(inner)


def floor_rows(spec: ArmSpec, arms: Sequence[int]) -> list[dict[str, Any]]:
    """A row for each number of arms, settled by the chain."""
    rates = device_rates()
    function = settle_function(spec)
    rows = []
    for n in arms:
        reference = jnp.asarray(random_references(spec, n), jnp.float32)
        compiled = function.lower(reference).compile()
        iterations = np.asarray(compiled(reference).iterations)
        flop, moved = (int(iterations.max()) * x for x in counted(function, compiled, reference))
        measured_s = seconds(functools.partial(compiled, reference))
        rows.append(
            {
                "arms": n,
                "mean_iterations": round(float(iterations.mean()), 2),
                "iterations_run": int(iterations.max()),
                "kflop_per_arm": round(1e-3 * flop / n, 1),
                "kb_per_arm": round(1e-3 * moved / n, 1),
                "flop_ms": round(1e3 * flop / rates["product_flop_per_s"], 4),
                "bytes_ms": round(1e3 * moved / rates["copy_bytes_per_s"], 4),
                "measured_ms": round(1e3 * measured_s, 3),
                "gflop_per_s": round(1e-9 * flop / measured_s, 2),
                "product_gflop_per_s": round(1e-9 * rates["product_flop_per_s"], 1),
                "copy_gb_per_s": round(1e-9 * rates["copy_bytes_per_s"], 1),
            }
        )
    return rows
