"""Regression guard: costs on one core of the CPU beside a stored baseline of the same kind of machine.

    python -m benchmarks guard            compare, for use before a release, in about four minutes
    python -m benchmarks guard --store    make this the baseline of this kind of machine
    python -m benchmarks.speed.guard      one process of a measurement

A cost is the least time of some work over the least time of matrix products in the same process, because a
disturbance only adds. A comparison takes the median of three processes. The baseline has five; its tolerance
is twice the largest distance of a median of three of them from the median of all, and at least a tenth. A
baseline with a tolerance above a quarter is refused. A loss of parallelism is not seen.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import jax
import numpy as np

from benchmarks.harness.common import RESULTS, cpu_kind, show
from benchmarks.harness.rounds import ROOT
from benchmarks.speed.truth import random_references, settle_function
from mjx_softarm._support import xla
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import provenance, write_json
from mjx_softarm.env import EnvConfig, ReachEnv
from train.agent.tqc import TQCConfig
from train.epoch.job import Job
from train.presets import PRESETS

FILE = RESULTS / "guard.json"
N_PROCESSES, N_STORED, N_ROUNDS = 3, 5, 12  # of a comparison, of a baseline; rounds of each
MARGIN, LEAST_TOLERANCE, MOST_TOLERANCE = 2.0, 0.1, 0.25
WORSE = 1  # exit status
SIZES = {"n_arms": 128, "n_settles": 20, "n_env_steps": 16, "n_updates": 16, "batch_size": 256}
SIZES |= {"n_rows": 1024, "n_products": 8, "n_compiles": 2}
MODULE = "benchmarks.speed.guard"
WORK = ("settle", "epoch", "compile")

Costs = Mapping[str, float]  # of one process, by the name of the work


def main(store: bool = False) -> int:
    """Is anything slower than the stored baseline of this kind of machine? Takes four minutes.

    Exit status: 1 if something is slower, 2 without a result.

    Args:
        store: make this the baseline of this kind of machine.
    """
    kind, kinds = cpu_kind(), json.loads(FILE.read_text("utf-8"))["kinds"] if FILE.exists() else {}
    stored = kinds.get(kind, {})
    if not store and stored.get("sizes") != SIZES:
        raise InputError(f"{FILE}: got no baseline of this work on {kind}, expected one: guard --store")
    samples = [process_costs() for _ in range(N_STORED if store else N_PROCESSES)]
    if not store:
        rows = compare(stored["costs"], samples)
        show({"costs": rows}, f"guard, {kind}, baseline of commit {stored['commit']}")
        return WORSE if any(row["verdict"] == "WORSE" for row in rows) else 0
    costs = baseline_of(samples)
    show({"costs": costs}, f"baseline of {kind}")
    if loose := [name for name, row in costs.items() if row["tolerance"] > MOST_TOLERANCE]:
        expected = f"at most {MOST_TOLERANCE}; try again while nothing else runs here"
        raise InputError(f"tolerance of {', '.join(loose)}: got more, expected {expected}")
    write_json(FILE, {"kinds": {**kinds, kind: {"costs": costs, "sizes": SIZES, **provenance("benchmarks")}}})
    print(f"written: {FILE}")
    return 0


def process_costs() -> dict[str, float]:
    """Return the costs that one process on one core measures, by the name of the work."""
    words = ["taskset", "--cpu-list", str(min(os.sched_getaffinity(0))), sys.executable, "-m", MODULE]
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, cwd=ROOT, check=False)
    if done.returncode:
        raise InputError(f"{' '.join(words)}: got status {done.returncode}, expected costs")
    return json.loads(done.stdout.splitlines()[-1])


def baseline_of(samples: Sequence[Costs]) -> dict[str, dict[str, Any]]:
    """Return the median, the tolerance and all costs of several processes, by the name of the work."""
    baseline = {}
    for name in WORK:
        costs = [sample[name] for sample in samples]
        cost = float(np.median(costs))
        medians = np.median([*itertools.combinations(costs, N_PROCESSES)], axis=1)
        tolerance = max(LEAST_TOLERANCE, MARGIN * float(np.max(np.abs(medians / cost - 1.0))))
        baseline[name] = {"cost": cost, "tolerance": tolerance, "processes": costs}
    return baseline


def compare(baseline: Mapping[str, Mapping[str, Any]], samples: Sequence[Costs]) -> list[dict[str, Any]]:
    """Return a row for each work: both costs, the change, the tolerance and the verdict."""
    rows = []
    for name, stored in baseline.items():
        now, tolerance = float(np.median([sample[name] for sample in samples])), stored["tolerance"]
        change = now / stored["cost"] - 1.0
        verdict = "WORSE" if change > tolerance else "better" if change < -tolerance else "same"
        shares = {"change": f"{change:+.1%}", "tolerance": f"{tolerance:.1%}"}
        rows.append({"work": name, "baseline": stored["cost"], "now": now, "verdict": verdict, **shares})
    return rows


def measure_costs() -> dict[str, float]:
    """Return the costs of compiling, settling and training in this process, by the name of the work."""
    # A training job in one process, without a cache of compiled programs.
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_compilation_cache", False)
    env, n_arms, n_steps = ReachEnv(config=EnvConfig(n_poses=1024)), SIZES["n_arms"], SIZES["n_env_steps"]
    settings: Any = {"n_arms": n_arms, "vector_steps_per_epoch": n_steps, "batch_size": SIZES["batch_size"]}
    settings |= {"updates_per_env_step": SIZES["n_updates"] / n_steps / n_arms, "warmup_env_steps": 0}
    config = dataclasses.replace(cast(TQCConfig, PRESETS["quick"].learner), **settings)
    job = Job(config.make_epoch(env))
    states = [job.init(jax.random.PRNGKey(0))]

    def compile_epoch() -> None:
        nonlocal job
        jax.clear_caches()
        job = Job(config.make_epoch(env))
        job.compile_epoch()

    # Compile its epoch, and prepare the other work, whose first calls do not count.
    compiling_s = [_seconds(compile_epoch) for _ in range(SIZES["n_compiles"])]
    matrix = np.random.default_rng(0).normal(size=(SIZES["n_rows"],) * 2).astype(np.float32)
    solve = xla.jit(settle_function(env.spec))
    references = random_references(env.spec, n_arms).astype(np.float32)
    work = {
        "product": lambda: [matrix @ matrix for _ in range(SIZES["n_products"])],
        "settle": lambda: [solve(references) for _ in range(SIZES["n_settles"])],
        "epoch": lambda: states.append(job.epoch(states.pop())[0]) or states,
    }
    for call in work.values():
        jax.block_until_ready(call())
    rounds = [{name: _seconds(call) for name, call in work.items()} for _ in range(N_ROUNDS)]
    least_s = {name: min(seconds[name] for seconds in rounds) for name in work}
    least_s["compile"] = min(compiling_s)
    return {name: least_s[name] / least_s["product"] for name in WORK}


def _seconds(call: Callable[[], Any]) -> float:
    """Return the processor time [s] of a call; waiting for other programs does not count."""
    start = time.process_time()
    jax.block_until_ready(call())
    return time.process_time() - start


if __name__ == "__main__":
    print(json.dumps(measure_costs()))
