"""Environment steps a second with settling and resets, of this project and of other simulators, in one run.

Each program is a process of its own, and they take turns round by round; one that fails has a row that says
why. Random actions saturate about half of the chambers. C MuJoCo's arms are stepped in time until they rest,
see `benchmarks.speed.mujoco_arms`; their distance from the true equilibrium stands beside their rate.

Programs that step in time, SoRoMoX among them, are compared by simulated seconds of all arms together. Arms
that are solved at rest simulate no time, so they are not in that table.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.harness.common import n_cores
from benchmarks.harness.peers import PeerError, peer_python
from benchmarks.harness.rounds import Facts, Worker, take_turns
from benchmarks.speed.mujoco_arms import write_arm
from benchmarks.speed.truth import TOLD, told_error
from mjx_softarm.env import EnvConfig
from mjx_softarm.spec import ArmSpec

N_ROUNDS = 3
PAPER_WORKERS, PAPER_STEP_S = 14, 0.03  # the paper's cost of an environment step
SUBPROC = "SubprocVecEnv"
MODES = ("quasistatic", "dynamic")
N_MOVING = 128  # arms in motion
SOROMOX = {"explicit": "SoRoMoX, explicit", "implicit": "SoRoMoX, this project's implicit step"}

Point = tuple[str, str, int]  # engine, mode, arms
Peer = tuple[str, list[str], str]  # name, program, key of `PINS`


def points(on_gpu: bool) -> list[list[Point]]:
    """Return the points of `over_arms`, in groups that take turns: one for each number of arms."""
    arms = (1, 1024, 8192, 32_768) if on_gpu else (1, 128, 1024)
    return [[(engine, mode, n) for mode in MODES for engine in ("chain", "mjx")] for n in arms]


def measure() -> dict[str, Any]:
    """How many environment steps does it make in a second, beside other simulators?"""
    on_gpu = jax.default_backend() == "gpu"
    with tempfile.TemporaryDirectory() as folder:
        write_arm(Path(folder), ArmSpec.default())
        return {
            "rounds": N_ROUNDS,
            "over_arms": [row for group in points(on_gpu) for row in _over_arms(group)],
            "side_by_side": side_by_side(_at_rest(folder, on_gpu)),
            "simulated_time": [moving_row(row) for row in _in_motion(folder)],
        }


def _over_arms(group: Sequence[Point]) -> list[dict[str, Any]]:
    """Return a row for each point of a group."""
    rows = programs_rows([_ours(*point) for point in group])
    keys = ("engine", "mode", "arms")
    return [dict(zip(keys, point, strict=True)) | row for point, row in zip(group, rows, strict=True)]


def _at_rest(folder: str, on_gpu: bool) -> list[dict[str, Any]]:
    """Return a row for each program whose environment step ends at rest."""
    n = str(n_cores())
    ours = [("chain", 8192 if on_gpu else 1024), ("mjx", 8192 if on_gpu else 128)]
    subproc = f"C MuJoCo, {SUBPROC}, {n} processes"
    program = ["benchmarks.speed.mujoco_worker", "subproc", folder, n]
    workers = [*(_ours(engine, "quasistatic", n_arms) for engine, n_arms in ours), _rollout(folder, n)]
    return programs_rows(workers, [(subproc, program, "sb3-contrib")])


def _in_motion(folder: str) -> list[dict[str, Any]]:
    """Return a row for each program that steps in time."""
    peers = [
        (name, ["benchmarks.speed.soromox_worker", method, str(N_MOVING)], "soromox")
        for method, name in SOROMOX.items()
    ]
    ours = [_ours(engine, "dynamic", N_MOVING) for engine in ("chain", "mjx")]
    return programs_rows([*ours, _rollout(folder, str(n_cores()))], peers)


def _ours(engine: str, mode: str, n_arms: int) -> Worker:
    program = ["benchmarks.speed.jax_worker", "steps", engine, mode, str(n_arms)]
    return Worker(f"{engine}, {mode}, {n_arms} arms", program)


def _rollout(folder: str, n_threads: str) -> Worker:
    program = ["benchmarks.speed.mujoco_worker", "rollout", folder, n_threads]
    return Worker(f"C MuJoCo, rollout, {n_threads} threads", program)


def programs_rows(workers: Iterable[Worker], peers: Sequence[Peer] = ()) -> list[dict[str, Any]]:
    """Return a row for each program: its figures, or why it failed or was skipped."""
    # Peers run in virtual environments of their own.
    workers, skipped = list(workers), []
    for name, program, library in peers:
        try:
            workers.append(Worker(name, program, peer_python(library)))
        except PeerError as error:
            skipped.append({"program": name, "skipped": str(error)})
    # All take turns.
    rounds, failed = take_turns(workers, N_ROUNDS)
    return [{"program": worker.name, **figures_of(worker, rounds, failed)} for worker in workers] + skipped


def figures_of(
    worker: Worker, rounds: Mapping[str, Sequence[Facts]], failed: Mapping[str, str]
) -> dict[str, Any]:
    """Return the figures of a program over its rounds, or why it failed; arguments as of `take_turns`."""
    told = rounds.get(worker.name)
    if not told:
        return {"failed": failed[worker.name]}
    figures = over_rounds([worker.facts | facts for facts in told])
    return figures | told_error(ArmSpec.default(), [worker.facts, *told])


def over_rounds(rounds: Sequence[Facts]) -> dict[str, Any]:
    """Return the medians of rates over rounds, and the last round's other figures; tips are left out."""
    merged: dict[str, Any] = {}
    for name, value in rounds[-1].items():
        if name.endswith("_per_s"):
            merged[name] = _digits(float(np.median([facts[name] for facts in rounds])))
        elif name not in TOLD:
            merged[name] = value
    return merged


def _digits(rate: float) -> float | int:
    """Round a rate to two decimals below 100, else to an integer."""
    return round(rate) if rate >= 100 else round(rate, 2)


def side_by_side(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows with the paper's added, and each rate as a multiple of SubprocVecEnv's."""
    base = next((row.get("env_steps_per_s") for row in rows if SUBPROC in row["program"]), None)
    full = []
    for row in rows:
        rate = row.get("env_steps_per_s")
        full.append({**row, "times_subproc": _digits(rate / base) if rate and base else None})
    program = f"the paper: {PAPER_WORKERS} workers, {PAPER_STEP_S} s a step, at most"
    return [*full, {"program": program, "env_steps_per_s": round(PAPER_WORKERS / PAPER_STEP_S)}]


def moving_row(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of `simulated_time`: this project's rate is one of environment steps of known duration."""
    if "env_steps_per_s" not in row or "simulated_s_per_s" in row:
        return row
    config = EnvConfig()
    rate = _digits(row["env_steps_per_s"] * config.dynamic_step_s)
    return {**row, "arms": N_MOVING, "step_ms": 1e3 * config.simulation_step_s, "simulated_s_per_s": rate}
