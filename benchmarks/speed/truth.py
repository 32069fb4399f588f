"""The true equilibrium: the solution in double precision, which `tests/mechanics` hold against C MuJoCo."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm._support.lazy import put
from mjx_softarm.mechanics import settle as solver
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.mjx_rest import measured
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.spec import ArmSpec

QUANTILES = {"median_mm": 0.5, "p95_mm": 0.95, "max_mm": 1.0}
REPORTED = ("reference_m", "tip_mm")  # facts that a worker reports of its settled arms


class Truth(NamedTuple):
    """Equilibria of arms, solved in double precision."""

    tip_mm: np.ndarray  # (n, 3)
    settled: np.ndarray  # (n,) bool; where false, the equilibrium is not known
    share_at_limit: float  # of the chambers


def settle_function(spec: ArmSpec, engine: str = "chain", dtype: Any = np.float32) -> Callable:
    """Return a function to be jitted, references (n, n_springs) -> `Settled`."""
    params = jax.tree.map(jnp.asarray, ArmParams.from_spec(spec, dtype))
    n_at_once = solver.arms_at_once(spec.n_links)
    model, data = put(build_model(spec)) if engine == "mjx" else (None, None)

    def at_rest(reference_m: Array) -> solver.Settled:
        proposed = solver.settle(params, reference_m, n_at_once)
        return proposed if model is None else measured(model, data, params, proposed)

    return jax.vmap(at_rest)


def true_rest(spec: ArmSpec, reference_m: np.ndarray) -> Truth:
    """Return the equilibria of arms under the control law, at references (n, n_springs) [m]."""
    with jax.enable_x64(True):
        solve = xla.jit(settle_function(spec, dtype=np.float64))
        solution = jax.device_get(solve(jnp.asarray(reference_m, np.float64)))
    share_at_limit = float(np.mean(solution.at_limit[solution.settled]))
    return Truth(1e3 * solution.tip_position_m, solution.settled, share_at_limit)


def error_figures(tip_mm: np.ndarray, truth: Truth) -> dict[str, float]:
    """Return quantiles of the distance of the first n tips (n, 3) [mm] from their equilibria, where known."""
    n = len(tip_mm)
    settled = truth.settled[:n]
    error = np.linalg.norm(np.asarray(tip_mm, np.float64) - truth.tip_mm[:n], axis=-1)[settled]
    errors = {name: float(f"{np.quantile(error, share):.3g}") for name, share in QUANTILES.items()}
    return {**errors, "without_truth": int(np.sum(~settled))}


def reported_error(spec: ArmSpec, answers: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the error of the tips that a worker's answers report; nothing if none has any."""
    answers = [facts for facts in answers if "tip_mm" in facts]
    if not answers:
        return {}
    reference_m, tip_mm = (np.concatenate([facts[name] for facts in answers]) for name in REPORTED)
    return error_figures(tip_mm, true_rest(spec, reference_m))


def random_references(spec: ArmSpec, n: int) -> np.ndarray:
    """Return spring lengths (n, n_springs) [m], uniform over the range that may be commanded."""
    low_m, high_m = map(spec.at_springs, (spec.springs.length_min_m, spec.springs.length_max_m))
    return np.random.default_rng(0).uniform(low_m, high_m, (n, spec.n_springs))
