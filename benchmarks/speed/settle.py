"""Speed and error of methods that find an arm's equilibrium, over links per section.

They are Newton's method with the closed-form chain, the same with MJX's pass at its solution, and C MuJoCo
stepped in time. They take turns, on all cores; errors are distances of the tip from `truth.true_rest`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from benchmarks.harness.rounds import n_cores
from benchmarks.speed.jax_worker import Program, digits, mesh_of, of_shares, rates, split_cpu, spread
from benchmarks.speed.mujoco_arms import SteppedArms
from benchmarks.speed.truth import error_figures, random_references, settle_function, true_rest
from mjx_softarm._support import xla
from mjx_softarm.spec import ArmSpec

LINKS = (2, 4, 10)  # per section
MOST_LINKS_MJX = 6
NO_MJX = f"compiles for minutes and in gigabytes at {MOST_LINKS_MJX} links, and for longer at more"
N_ARMS, N_STEPPED = 512, 64  # references of a solver, and of C MuJoCo, which takes the first
N_ROUNDS, ROUND_S = 3, 1.0


def measure() -> dict[str, Any]:
    """How fast and how exactly is an arm's equilibrium found?"""
    split_cpu()
    mesh = mesh_of(N_ARMS)
    return {"over_links": [row for links in LINKS for row in methods_rows(links, mesh)]}


def methods_rows(links: int, mesh: Mesh) -> list[dict[str, Any]]:
    """Return a row for each method, with a number of links per section."""
    # Functions that return tips [m]; the first call of each compiles.
    spec = ArmSpec.default().replace(structure={"links_per_section": links})
    reference_m = random_references(spec, N_ARMS)
    truth = true_rest(spec, reference_m)
    methods = {
        "chain": _solver(spec, "chain", reference_m, mesh),
        "mjx": _solver(spec, "mjx", reference_m, mesh) if links <= MOST_LINKS_MJX else None,
        "stepping": lambda: SteppedArms(spec, N_STEPPED, n_cores()).settle(reference_m[:N_STEPPED]).tip_m,
    }
    tips_mm = {name: 1e3 * np.asarray(solve(), float) for name, solve in methods.items() if solve}
    programs = {name: Program(0.0, methods[name], len(tips_mm[name])) for name in tips_mm}
    # The methods take turns.
    rounds = [
        {name: rates(program, ROUND_S)["env_steps_per_s"] for name, program in programs.items()}
        for _ in range(N_ROUNDS)
    ]
    rows = []
    for name in methods:
        row = {"links_per_section": links, "share_at_limit": round(truth.share_at_limit, 3), "method": name}
        if name not in tips_mm:
            rows.append({**row, "skipped": NO_MJX})
            continue
        rate = digits(float(np.median([rates[name] for rates in rounds])))
        rows.append({**row, **error_figures(tips_mm[name], truth), "solves_per_s": rate})
    return rows


def _solver(spec: ArmSpec, engine: str, reference_m: np.ndarray, mesh: Mesh) -> Callable[[], Any]:
    """Return a function that settles references (n, n_springs) [m] and returns tips (n, 3) [m]."""
    solve = xla.jit(of_shares(settle_function(spec, engine), mesh))
    placed = jax.device_put(reference_m.astype(np.float32), spread(mesh))
    return lambda: solve(placed).tip_position_m
