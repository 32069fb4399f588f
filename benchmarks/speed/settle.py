"""Ways to an arm's rest: what they cost, and how far from the true equilibrium they end.

Newton's method with MJX kinematics, the same with the closed-form chain, and C MuJoCo stepped in time under
the law, over links per section and over shares of saturated chambers. Each way is a process of its own, and
they take turns round by round, on all cores; one that fails has a row that says why. The rates over a fixed
number of iterations are those of one device, which is one core of a CPU. MJX is left out where
it compiles for too long. Errors are those of the tip against the solution in double precision, which
`tests/mechanics/test_settle.py` holds against C MuJoCo stepped to rest.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.common import goal, n_cores
from benchmarks.harness.rounds import Facts, Worker, take_turns
from benchmarks.speed.mujoco_rollout import RolloutArms, sensed_model
from benchmarks.speed.settle_methods import N_STEPPED
from benchmarks.speed.throughput import LINKS, MOST_LINKS_MJX, N_LINKS, NO_MJX, over_rounds
from benchmarks.speed.truth import (
    Truth,
    error_figures,
    random_references,
    settle_function,
    told_error,
    true_rest,
)
from mjx_softarm.mechanics import settle as solver
from mjx_softarm.spec import ArmSpec

ITERATIONS = (2, 3, 4, 5, 6, 8, 12)
N_ARMS = 512
N_ROUNDS = 3
N_CALLS = 10  # of each number of iterations
METHODS = ("chain", "mjx", "stepping")
REACHES = (0.1, 0.3, 0.42, 0.65, 0.85, 1.0, 1.4)  # of `random_references`; shares from about 0 to 60 %
REST_M = (1e-3, 3e-4, 1e-4, 3e-5)  # within which a spring counts as at rest, in time steps
GOAL_RATE, GOAL_P95_MM, GOAL_CORES = 10_000, 0.5, 2
GOAL_ARMS = (128, 512, 1024)
GOAL = f"{GOAL_RATE:,} env steps/s on {GOAL_CORES} CPU cores, chain, tip within {GOAL_P95_MM} mm (95 %)"


def measure() -> dict[str, Any]:
    """Errors over iterations and over time, the three ways over links and saturation, and the goal."""
    spec = ArmSpec.default()
    reference = random_references(spec, N_ARMS)
    truth = true_rest(spec, reference)
    print("Newton iterations, one by one", flush=True)
    figures: dict[str, Any] = {
        "chambers_at_limit": round(truth.share_at_limit, 3),
        "fixed": _over_iterations(spec, reference, truth),
        "stepping_until_rest": _over_rest(spec, reference[:N_STEPPED], truth),
    }
    rows = [row for links in LINKS for row in _ways(links, REACHES if links == N_LINKS else (1.0,))]
    figures["over_links"] = [row for row in rows if row["reach"] == 1.0]
    at_start = ("tracing_s", "compiling_s", "both_from_cache_s", "peak_rss_mb", "peak_device_mb")
    figures["over_saturation"] = [
        {name: value for name, value in row.items() if name not in at_start}
        for row in rows
        if row["links_per_section"] == N_LINKS
    ]
    return {**figures, "goals": [_goal(spec)]}


def _over_iterations(spec: ArmSpec, reference: np.ndarray, truth: Truth) -> list[dict[str, Any]]:
    """Error after a fixed number of Newton iterations, and rates, by the chain, in turns."""
    batch = jnp.asarray(reference, jnp.float32)
    solvers, times = {}, {n: [] for n in ITERATIONS}
    for n in ITERATIONS:
        with mock.patch.multiple(solver, MAX_ITERATIONS=n, SMALL_STEP=0.0):
            solvers[n] = settle_function(spec).lower(batch).compile()
    found = {n: jax.device_get(solve(batch)) for n, solve in solvers.items()}
    for _ in range(N_CALLS):
        for n, solve in solvers.items():
            start = time.perf_counter()
            jax.block_until_ready(solve(batch))
            times[n].append(time.perf_counter() - start)
    return [
        {
            "iterations": n,
            **error_figures(1e3 * found[n].tip_position_m, truth),
            "solves_per_s": round(len(reference) / float(np.median(times[n]))),
        }
        for n in ITERATIONS
    ]


def _over_rest(spec: ArmSpec, reference: np.ndarray, truth: Truth) -> list[dict[str, Any]]:
    """Error and simulated time of C MuJoCo over what counts as at rest, from the straight arm."""
    n = len(reference)
    truth = truth._replace(tip_mm=truth.tip_mm[:n], settled=truth.settled[:n])
    arms = RolloutArms(sensed_model(spec), spec, n, n_cores())
    rows = []
    for rest_m in REST_M:
        arms.place(np.ones(n, bool), np.zeros((n, arms.model.nq)), np.zeros((n, spec.n_chambers)))
        end = arms.move(reference, rest_m)
        simulated_s = round(end.physics_steps * arms.model.opt.timestep / n, 2)
        rows.append(
            {
                "rest_mm": 1e3 * rest_m,
                "mean_simulated_s": simulated_s,
                **error_figures(end.pose[:, :3], truth),
            }
        )
    arms.close()
    return rows


def _ways(links: int, reaches: tuple[float, ...]) -> list[dict[str, Any]]:
    """A row for each way and each reach of the references, at a number of links per section."""
    spec = ArmSpec.default().replace(structure={"links_per_section": links})
    references: dict[str, Any] = {str(reach): random_references(spec, N_ARMS, reach) for reach in reaches}
    truths = {name: true_rest(spec, reference) for name, reference in references.items()}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "references.npz")
        np.savez(file, **references)
        workers = {}
        for method in METHODS:
            if method != "mjx" or links <= MOST_LINKS_MJX:
                program = [
                    "benchmarks.speed.settle_methods",
                    method,
                    str(links),
                    str(file),
                    f"{folder}/{method}",
                ]
                workers[method] = Worker(f"{method}, {links} links per section", program)
        rounds, failed = take_turns(list(workers.values()), N_ROUNDS)

    def figures(method: str, reach: str) -> dict[str, Any]:
        if method not in workers:
            return {"skipped": NO_MJX}
        worker = workers[method]
        if worker.name in failed:
            return {"failed": failed[worker.name]}
        return {**way(rounds[worker.name], reach, truths[reach]), **worker.facts}

    return [
        {
            "links_per_section": links,
            "reach": float(reach),
            "share_at_limit": round(truth.share_at_limit, 3),
            "method": method,
            **figures(method, reach),
        }
        for reach, truth in truths.items()
        for method in METHODS
    ]


def way(rounds: list[Facts], name: str, truth: Truth) -> dict[str, Any]:
    """One way's figures on one set of references, from the rounds that it told of."""
    found = dict(rounds[-1]["sets"][name])
    tip_mm = np.array(found.pop("tip_mm"))
    first = Truth(truth.tip_mm[: len(tip_mm)], truth.settled[: len(tip_mm)], truth.share_at_limit)
    rate = over_rounds([{"solves_per_s": told["solves_per_s"][name]} for told in rounds])
    memory = {key: value for key, value in rounds[-1].items() if key.startswith("peak")}
    return {**error_figures(tip_mm, first), **rate, **found, **memory}


def _goal(spec: ArmSpec) -> dict[str, str]:
    """Env steps/s of the chain on two cores, and the error of the very same programs."""
    if reason := no_goal(n_cores(), jax.default_backend()):
        return goal(GOAL, reason, None)
    with contextlib.ExitStack() as stack:
        workers = {}
        for n in GOAL_ARMS:
            cache = stack.enter_context(tempfile.TemporaryDirectory())
            program = [
                "benchmarks.speed.throughput_arms",
                "chain",
                "quasistatic",
                str(n),
                str(N_LINKS),
                cache,
            ]
            workers[n] = Worker(f"chain, {n} arms, {GOAL_CORES} cores", program, n_cores=GOAL_CORES)
        rounds, failed = take_turns(list(workers.values()), N_ROUNDS)
    measured = {}
    for n, worker in workers.items():
        if worker.name in rounds:
            rate = over_rounds(rounds[worker.name])["env_steps_per_s"]
            measured[n] = (rate, told_error(spec, [worker.facts])["p95_mm"])
    return speed_goal(measured, failed)


def no_goal(n: int, backend: str) -> str:
    """Why the goal cannot be measured on n cores with a backend of JAX; empty where it can."""
    if n < GOAL_CORES:
        return f"{n} core here"
    if not hasattr(os, "sched_setaffinity"):
        return f"programs cannot be kept to {GOAL_CORES} cores on {sys.platform}"
    return "" if backend == "cpu" else "jax does not run on the CPU here"


def speed_goal(measured: Mapping[int, tuple[float, float]], failed: Mapping[str, str]) -> dict[str, str]:
    """The goal, by the number of arms that is fastest.

    Args:
        measured: arms -> env steps/s and 95 % of the tip's error [mm].
        failed: the other programs, and why.
    """
    why = "; ".join(failed.values())
    if not measured:
        return goal(GOAL, why, False)
    n, (rate, p95_mm) = max(measured.items(), key=lambda item: item[1][0])
    met = rate >= GOAL_RATE and p95_mm <= GOAL_P95_MM
    return goal(GOAL, f"{rate:,} with {n:,} arms, {p95_mm:g} mm{why and f'; {why}'}", met)
