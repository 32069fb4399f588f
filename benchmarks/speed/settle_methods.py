"""Workers of the settling benchmark, one for each way to find an arm's rest.

    python -m benchmarks.speed.settle_methods METHOD LINKS_PER_SECTION REFERENCES CACHE

METHOD is `chain` or `mjx`, Newton's method with the kinematics of that engine, or `stepping`, C MuJoCo under
the law until nothing moves. REFERENCES is an npz file with an array (n, n_chambers) [m] for each set of
references; `stepping` takes the first `N_STEPPED` of each. A round tells rates, and where the arms are.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.common import mesh_of_cores, n_cores, peak_memory
from benchmarks.harness.rounds import Facts, serve
from benchmarks.speed.mujoco_rollout import RolloutArms, sensed_model
from benchmarks.speed.throughput_arms import compile_twice, repeats_for
from benchmarks.speed.truth import settle_function
from mjx_softarm._support import xla
from mjx_softarm.spec import ArmSpec
from train.epoch.devices import split

N_STEPPED = 64
SET_S = 0.5  # of a round, for each set

References = dict[str, np.ndarray]


def newton(
    spec: ArmSpec, engine: str, references: References, cache: str
) -> tuple[Facts, Callable[[], Facts]]:
    """Newton's method: one compiled function for all sets, on all cores."""
    mesh = mesh_of_cores(len(next(iter(references.values()))))
    xla.enable_compilation_cache(cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    batches = {name: jnp.asarray(reference, jnp.float32) for name, reference in references.items()}
    if mesh is not None:
        batches = jax.device_put(batches, split(mesh))
    first = next(iter(batches.values()))
    function, facts = compile_twice(settle_function(spec, engine, mesh=mesh), first)
    repeats = repeats_for(lambda: function(first), SET_S)

    def work() -> Facts:
        rates, sets = {}, {}
        for name, batch in batches.items():
            start = time.perf_counter()
            for _ in range(repeats):
                found = function(batch)
            found = jax.block_until_ready(found)
            rates[name] = repeats * len(batch) / (time.perf_counter() - start)
            sets[name] = {
                "tip_mm": (1e3 * np.asarray(found.tip_position_m, float)).tolist(),
                "unsettled": int(np.sum(~np.asarray(found.settled))),
                "mean_iterations": round(float(np.mean(found.iterations)), 2),
                "most_iterations": int(np.max(found.iterations)),
            }
        return {"solves_per_s": rates, "sets": sets, **peak_memory()}

    return facts, work


def stepping(spec: ArmSpec, references: References) -> tuple[Facts, Callable[[], Facts]]:
    """Time stepping, from the straight arm as Newton's method, on all cores."""
    arms = RolloutArms(sensed_model(spec), spec, N_STEPPED, n_cores())
    everywhere = np.ones(N_STEPPED, bool)
    straight, empty = np.zeros((N_STEPPED, arms.model.nq)), np.zeros((N_STEPPED, spec.n_chambers))

    def work() -> Facts:
        rates, sets = {}, {}
        for name, reference in references.items():
            start = time.perf_counter()
            arms.place(everywhere, straight, empty)
            end = arms.move(reference[:N_STEPPED])
            rates[name] = N_STEPPED / (time.perf_counter() - start)
            sets[name] = {
                "tip_mm": end.pose[:, :3].tolist(),
                "mean_simulated_s": round(end.physics_steps * arms.model.opt.timestep / N_STEPPED, 2),
            }
        return {"solves_per_s": rates, "sets": sets, **peak_memory()}

    return {}, work


def prepare(method: str, links: int, file: str, cache: str) -> tuple[Facts, Callable[[], Facts]]:
    """What `serve` is to be given."""
    spec = ArmSpec.default().replace(structure={"links_per_section": links})
    with np.load(file) as stored:
        references = {name: stored[name] for name in stored.files}
    return stepping(spec, references) if method == "stepping" else newton(spec, method, references, cache)


if __name__ == "__main__":
    _method, _links, _file, _cache = sys.argv[1:]
    serve(lambda: prepare(_method, int(_links), _file, _cache))
