"""Error of the settled arm against the true equilibrium, over Newton iterations."""

from __future__ import annotations

import functools
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import seconds
from mjx_softarm import settle as solver
from mjx_softarm import xla
from mjx_softarm.kinematics import chain_frames
from mjx_softarm.spec import ArmSpec
from mjx_softarm.statics import ArmParams

ITERATIONS = (2, 3, 4, 5, 6, 8, 12)
N_ARMS = 512


def measure() -> dict[str, Any]:
    """Tip error [mm] after a fixed number of iterations, against the solution in double precision.

    `tests/test_settle.py` holds that solution against C MuJoCo stepped to rest.
    """
    spec = ArmSpec.default()
    low, high = spec.springs.length_min_m, spec.springs.length_max_m
    reference = np.random.default_rng(0).uniform(low, high, (N_ARMS, spec.n_chambers))
    with jax.enable_x64(True):
        truth = _settle(spec, np.float64, reference)
        exact_mm = 1e3 * np.asarray(truth.tip_position_m)
        saturated = float(np.mean(truth.at_limit))
    rows = []
    for n in ITERATIONS:
        with mock.patch.multiple(solver, MAX_ITERATIONS=n, SMALL_STEP=0.0):
            found = _settle(spec, np.float32, reference)
        error = np.linalg.norm(1e3 * np.asarray(found.tip_position_m, np.float64) - exact_mm, axis=-1)
        quantiles = dict(
            zip(("median_mm", "p95_mm", "max_mm"), np.quantile(error, [0.5, 0.95, 1.0]), strict=True)
        )
        rows.append({"iterations": n, **{k: float(f"{v:.3g}") for k, v in quantiles.items()}})
    found = _settle(spec, np.float32, reference)
    return {
        "chambers_at_limit": round(saturated, 3),
        "fixed": rows,
        "default": {
            "mean_iterations": round(float(np.mean(found.iterations)), 2),
            "unsettled": int(np.sum(~np.asarray(found.settled))),
            "solves_per_s": round(_rate(spec, reference)),
        },
    }


def _function(spec: ArmSpec, dtype: Any):
    params = jax.tree.map(jnp.asarray, ArmParams.from_spec(spec, dtype))
    kinematics = functools.partial(chain_frames, link_length_m=params.link_length_m)
    return xla.jit(jax.vmap(functools.partial(solver.settle, kinematics, params)))


def _settle(spec: ArmSpec, dtype: Any, reference: np.ndarray) -> solver.Settled:
    return jax.device_get(_function(spec, dtype)(jnp.asarray(reference, dtype)))


def _rate(spec: ArmSpec, reference: np.ndarray) -> float:
    function = _function(spec, np.float32)
    batch = jnp.asarray(reference[:128], jnp.float32)
    return len(batch) / seconds(lambda: function(batch))
