"""Compilation: options by platform and kind of program, and the persistent cache of compiled programs."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

# jaxlib 0.10 hands products and sums to the library YNNPACK. Learning is a third slower with it, and some
# sums are wrong (see `small_matrices.product`).
_CPU_OPTIONS = {"xla_cpu_experimental_ynn_fusion_type": ""}

# With XLA's fusion emitters (jax >= 0.7) an arm at rest takes twice as long to compile and is no faster, and
# serial chains such as mjx.kinematics are far slower. Networks train a tenth faster with them. jaxlib 0.10
# deadlocks on two cores with the concurrency-optimised scheduler and MJX.
_CPU_ARM_OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_enable_concurrency_optimized_scheduler": False,
}

Kind = Literal["arm", "networks", "once"]
_CPU_OPTIONS_OF: dict[Kind, dict[str, Any]] = {
    "arm": _CPU_ARM_OPTIONS,
    "networks": {},
    "once": {**_CPU_ARM_OPTIONS, "xla_backend_optimization_level": 0},  # compiled in a quarter of the time
}


@functools.cache
def compiler_options(kind: Kind = "arm") -> dict[str, Any]:
    """Return the options for `jax.jit` that the installed jaxlib accepts on CPUs; none for other devices."""
    if jax.default_backend() != "cpu":
        return {}
    accepted = {}
    for name, value in {**_CPU_OPTIONS, **_CPU_OPTIONS_OF[kind]}.items():
        try:
            with jax.ensure_compile_time_eval():  # works while a function is traced, too
                jax.jit(lambda x: x + 1, compiler_options={name: value})(0)
        except (jax.errors.JaxRuntimeError, ValueError):  # this jaxlib does not know the option
            continue
        accepted[name] = value
    return accepted


def jit(function: Callable, kind: Kind = "arm", **kwargs: Any) -> Callable:
    """Compile with `jax.jit`, its further arguments and this platform's options.

    `kind` is "networks" for programs that mostly train networks, without MJX, "once" for programs that run
    once, and "arm" for all others.
    """

    # Set the current mesh: where there is none, JAX sets an empty one while it applies custom rules of
    # derivatives, and would trace helpers again.
    @functools.wraps(function)
    def traced(*args: Any, **kwargs: Any) -> Any:
        with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
            return function(*args, **kwargs)

    return jax.jit(traced, compiler_options=compiler_options(kind), **kwargs)


def in_batches(function: Callable[[Any], Any], size: int, rows: Any) -> Any:
    """Return a compiled function's results for a tree of rows (n, ...), as NumPy, from batches (size, ...).

    Rows become float32. The last batch repeats the first rows.
    """
    n = len(jax.tree.leaves(rows)[0])
    padded = jax.tree.map(lambda x: np.resize(np.float32(x), (-(-n // size) * size, *x.shape[1:])), rows)
    batches = (jax.tree.map(lambda x, k=k: x[k : k + size], padded) for k in range(0, n, size))
    parts = [jax.device_get(function(batch)) for batch in batches]
    return jax.tree.map(lambda *x: np.concatenate(x)[:n], *parts)


def rows_last(function: Callable, n_at_once: int | None = None) -> Callable:
    """Return a function of one row; `jax.vmap` of it calls `function` with the rows as last axis.

    Args:
        function: maps trees of arrays (..., *rows) to another; *rows may be empty. Arrays of its last
            argument have a last axis of 1 where all rows share them.
        n_at_once: rows of a chunk, one after another, the last filled up; None for all rows at once.
    """
    one = jax.custom_batching.custom_vmap(function)

    def many(n: int, batched: list[Any], *arguments: Any) -> tuple[Any, Any]:
        n_chunks = -(-n // (n_at_once or n))
        size = -(-n // n_chunks)

        def chunk(row: Any) -> Any:
            def last(x: Any, is_batched: bool) -> jax.Array:
                x = jnp.asarray(x)
                return jnp.moveaxis(x[row], 0, -1) if is_batched else x[..., None]

            *each, shared = [jax.tree.map(last, *pair) for pair in zip(arguments, batched, strict=True)]
            each = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], size)), each)
            return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), function(*each, shared))

        if n_chunks == 1:
            results = chunk(slice(None))
        else:
            row = jnp.minimum(jnp.arange(n_chunks * size), n - 1).reshape(n_chunks, size)
            results = jax.lax.map(chunk, row)
            results = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n], results)
        return results, jax.tree.map(lambda _: True, results)

    one.def_vmap(many)
    return one


def enable_compilation_cache() -> None:
    """Keep compiled programs in `$XDG_CACHE_HOME/mjx_softarm/xla` or `~/.cache`, for a fast second start."""
    path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mjx_softarm" / "xla"
    path.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
