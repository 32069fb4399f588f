"""Cost and error of ways to find an arm's equilibrium.

The ways are Newton's method with the closed-form chain, the same with MJX kinematics, and C MuJoCo stepped in
time under the control law, over links per section and over shares of saturated chambers. Each is a process of
its own, and they take turns round by round, on all cores; one that fails has a row that says why. Errors are
distances of the tip from the solution in double precision, which `tests/mechanics/test_settle.py` compares
with C MuJoCo stepped to rest.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np

from benchmarks.harness.common import n_cores, target
from benchmarks.harness.rounds import Facts, Worker, take_turns
from benchmarks.speed.throughput import LINKS, MOST_LINKS_MJX, N_LINKS, N_ROUNDS, NO_MJX, over_rounds, turns
from benchmarks.speed.truth import Truth, error_figures, random_references, settle_function, true_rest
from mjx_softarm.mechanics import settle as solver
from mjx_softarm.spec import ArmSpec

ITERATIONS = (2, 3, 4, 5, 6, 8, 12)
N_ARMS = 512
METHODS = ("chain", "mjx", "stepping")
SPREADS = (0.1, 0.3, 0.42, 0.65, 0.85, 1.0, 1.4)  # of `random_references`; saturate from about 0 to 60 %
TARGET_RATE, TARGET_P95_MM, TARGET_CORES = 10_000, 0.5, 2
TARGET_ARMS = (128, 512, 1024)
TARGET = (
    f"{TARGET_RATE:,} env steps/s on {TARGET_CORES} CPU cores, chain, tip within {TARGET_P95_MM} mm (95 %)"
)


def measure() -> dict[str, Any]:
    """Measure error, speed and compile time of Newton's method against time stepping."""
    spec = ArmSpec.default()
    reference = random_references(spec, N_ARMS)
    truth = true_rest(spec, reference)
    rows = [row for links in LINKS for row in _ways(links, SPREADS if links == N_LINKS else (1.0,))]
    return {
        "chambers_at_limit": round(truth.share_at_limit, 3),
        "fixed": over_iterations(spec, reference, truth),
        "over_links": [row for row in rows if row["spread"] == 1.0],
        "over_saturation": [row for row in rows if row["links_per_section"] == N_LINKS],
        "targets": [_target()],
    }


def over_iterations(spec: ArmSpec, reference: np.ndarray, truth: Truth) -> list[dict[str, Any]]:
    """Return errors of the chain after fixed numbers of Newton iterations."""
    rows = []
    for n in ITERATIONS:
        with mock.patch.multiple(solver, MAX_ITERATIONS=n, SMALL_STEP=0.0):
            found = settle_function(spec)(reference.astype(np.float32))
        rows.append({"iterations": n, **error_figures(1e3 * np.asarray(found.tip_position_m), truth)})
    return rows


def _ways(links: int, spreads: Sequence[float]) -> list[dict[str, Any]]:
    """Return a row for each way and each spread of the references, with a number of links per section."""
    spec = ArmSpec.default().replace(structure={"links_per_section": links})
    references: dict[str, Any] = {str(spread): random_references(spec, N_ARMS, spread) for spread in spreads}
    truths = {name: true_rest(spec, reference) for name, reference in references.items()}
    workers = {}
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder, "references.npz"))
        np.savez(file, **references)
        for method in METHODS if links <= MOST_LINKS_MJX else ("chain", "stepping"):
            program = ["benchmarks.speed.jax_worker", "settle", method, file, str(links)]
            if method == "stepping":
                program = ["benchmarks.speed.mujoco_worker", "settle", file, str(links)]
            workers[method] = Worker(f"{method}, {links} links per section", program)
        rounds, failed = take_turns(list(workers.values()), N_ROUNDS)
    rows = []
    for spread, truth in truths.items():
        share = round(truth.share_at_limit, 3)
        for method in METHODS:
            row = {"links_per_section": links, "spread": float(spread), "share_at_limit": share}
            if method not in workers:
                figures: dict[str, Any] = {"skipped": NO_MJX}
            elif (worker := workers[method]).name in failed:
                figures = {"failed": failed[worker.name]}
            else:
                told = [facts[spread] for facts in rounds[worker.name]]
                figures = way(told, truth) | worker.facts
            rows.append({**row, "method": method, **figures})
    return rows


def way(rounds: Sequence[Facts], truth: Truth) -> dict[str, Any]:
    """Return figures of rounds on one set of references, of which a way may have taken only the first."""
    tip_mm = np.array(rounds[-1]["tip_mm"])
    first = Truth(truth.tip_mm[: len(tip_mm)], truth.settled[: len(tip_mm)], truth.share_at_limit)
    return {**error_figures(tip_mm, first), **over_rounds(rounds)}


def _target() -> dict[str, str]:
    """Return the target for env steps a second on two cores, and for the error of the same programs."""
    if n_cores() < TARGET_CORES or jax.default_backend() != "cpu" or not hasattr(os, "sched_setaffinity"):
        return target(TARGET, f"got no CPU on Linux with {TARGET_CORES} cores or more", None)
    points = [("chain", "quasistatic", n, N_LINKS) for n in TARGET_ARMS]
    return speed_target(turns(points, TARGET_CORES))


def speed_target(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the target, judged at the fastest number of arms."""
    measured = [row for row in rows if "failed" not in row]
    why = "; ".join(row["failed"] for row in rows if "failed" in row)
    if not measured:
        return target(TARGET, why, False)
    best = max(measured, key=lambda row: row["env_steps_per_s"])
    rate, p95_mm = best["env_steps_per_s"], best["p95_mm"]
    text = f"{rate:,} with {best['arms']:,} arms, {p95_mm:g} mm"
    return target(
        TARGET, "; ".join(filter(None, [text, why])), rate >= TARGET_RATE and p95_mm <= TARGET_P95_MM
    )
