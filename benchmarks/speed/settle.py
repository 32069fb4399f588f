"""Speed and error of methods that find an arm's equilibrium, over links per section.

The methods are Newton's method with the closed-form chain, the same with MJX kinematics, and C MuJoCo stepped
in time under the control law. Each is a process of its own, and they take turns round by round, on all cores;
one that fails has a row that says why. Errors are distances of the tip from the solution in double precision,
which `tests/mechanics/test_settle.py` compares with C MuJoCo stepped to rest. A second table has arms that
hang, lie and stand.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness.rounds import Facts, Worker, take_turns
from benchmarks.speed import postures
from benchmarks.speed.throughput import N_ROUNDS, over_rounds
from benchmarks.speed.truth import Truth, error_figures, random_references, true_rest
from mjx_softarm.spec import ArmSpec

LINKS = (2, 4, 10)  # per section
MOST_LINKS_MJX = 6
NO_MJX = f"compiles for minutes and in gigabytes at {MOST_LINKS_MJX} links, and for longer at more"
N_ARMS = 512
METHODS = ("chain", "mjx", "stepping")


def measure() -> dict[str, Any]:
    """How fast and how exactly is an arm's equilibrium found?"""
    over_links = [row for links in LINKS for row in _methods_rows(links)]
    return {"over_links": over_links, "postures": postures.rows()}


def _methods_rows(links: int) -> list[dict[str, Any]]:
    """Return a row for each method, with a number of links per section."""
    # References, and their equilibria in double precision.
    spec = ArmSpec.default().replace(structure={"links_per_section": links})
    reference_m = random_references(spec, N_ARMS)
    truth, workers = true_rest(spec, reference_m), {}
    # The methods take turns.
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder, "references.npy"))
        np.save(file, reference_m)
        for method in METHODS if links <= MOST_LINKS_MJX else ("chain", "stepping"):
            program = ["benchmarks.speed.jax_worker", "settle", method, file, str(links)]
            if method == "stepping":
                program = ["benchmarks.speed.mujoco_worker", "settle", file, str(links)]
            workers[method] = Worker(f"{method}, {links} links per section", program)
        rounds, failed = take_turns(list(workers.values()), N_ROUNDS)
    # A row for each, whether it was measured or not.
    rows = []
    for method in METHODS:
        row = {"links_per_section": links, "share_at_limit": round(truth.share_at_limit, 3), "method": method}
        if method not in workers:
            figures: dict[str, Any] = {"skipped": NO_MJX}
        elif (worker := workers[method]).name in failed:
            figures = {"failed": failed[worker.name]}
        else:
            figures = method_figures(rounds[worker.name], truth) | worker.facts
        rows.append(row | figures)
    return rows


def method_figures(rounds: Sequence[Facts], truth: Truth) -> dict[str, Any]:
    """Return figures of a method's rounds; it may have taken the first n of the references alone."""
    tip_mm, n = np.array(rounds[-1]["tip_mm"]), len(rounds[-1]["tip_mm"])
    first = Truth(truth.tip_mm[:n], truth.settled[:n], truth.share_at_limit)
    return {**error_figures(tip_mm, first), **over_rounds(rounds)}
