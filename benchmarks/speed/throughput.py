"""Environment steps a second with settling and resets, of this project and of peers, in one run.

Each program is a process of its own, and they take turns round by round; one that fails has a row that says
why. Random actions saturate about half of the chambers. C MuJoCo's arms are stepped in time until they rest,
see `benchmarks.speed.mujoco_arms`; their distance from the true equilibrium stands beside their rate.

A table of its own compares programs that step in time, SoRoMoX among them, by simulated seconds of all arms
together. Arms that are solved at rest simulate no time, so they are not in it.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.harness.common import n_cores
from benchmarks.harness.peers import PeerError, peer_python
from benchmarks.harness.rounds import Facts, Worker, WorkerError, take_turns, working
from benchmarks.speed.mujoco_arms import write_arm
from benchmarks.speed.truth import ERROR, TOLD, told_error
from mjx_softarm.env import EnvConfig
from mjx_softarm.spec import ArmSpec

N_ROUNDS = 3
LINKS = (2, 4, 6, 8, 10)  # per section
MOST_LINKS_MJX = 6
NO_MJX = f"compiles for minutes and in gigabytes at {MOST_LINKS_MJX} links, and for longer at more"
N_LINKS = ArmSpec.default().structure.links_per_section
PAPER_WORKERS, PAPER_STEP_S = 14, 0.03  # the paper's cost of an environment step; the workers may share cores
SUBPROC = "SubprocVecEnv"
N_MOVING = 128  # arms in motion
SOROMOX = {"explicit": "SoRoMoX, explicit", "implicit": "SoRoMoX, this project's implicit step"}
MOVING_COLUMNS = ("program", "step_ms", "arms", "simulated_s_per_s")
COLUMNS = ("program", "env_steps_per_s", "times_subproc", "simulated_s_per_env_step", *ERROR)

Point = tuple[str, str, int, int]  # engine, mode, arms, links per section


def points(on_gpu: bool) -> list[list[Point]]:
    """Return what is measured, in groups that take turns."""
    most, fixed = (32_768, 8192) if on_gpu else (1024, 128)
    chain = (1, 128, 1024, 8192, most) if on_gpu else (1, 8, 32, 128, 512, most)
    mjx = (1, 1024, 8192, most) if on_gpu else (1, 128, most)  # half a minute to compile, each
    pairs = [(n, N_LINKS) for n in chain] + [(fixed, links) for links in LINKS if links != N_LINKS]
    groups: list[list[Point]] = []
    for n, links in pairs:
        groups.append([("chain", "quasistatic", n, links)])
        if links <= MOST_LINKS_MJX and (n in mjx or links != N_LINKS):
            groups[-1] += [("mjx", mode, n, links) for mode in ("quasistatic", "dynamic")]
    return groups


def measure() -> dict[str, Any]:
    """Measure env steps/s over arms and links, beside C MuJoCo in time steps, and start-up times."""
    on_gpu = jax.default_backend() == "gpu"
    rows = [row for group in points(on_gpu) for row in turns(group)]
    over_links = [row for row in rows if row["arms"] == (8192 if on_gpu else 128)]
    over_links.sort(key=lambda row: (row["engine"], row["mode"], row["links_per_section"]))
    no_mjx = {"engine": "mjx", "skipped": NO_MJX}
    return {
        "rounds": N_ROUNDS,
        "over_arms": [row for row in rows if row["links_per_section"] == N_LINKS],
        "over_links": over_links
        + [{**no_mjx, "links_per_section": links} for links in LINKS if links > MOST_LINKS_MJX],
        "side_by_side": _side_by_side(ArmSpec.default(), on_gpu),
        "simulated_time": simulated_time(),
        "start": _starts(),
    }


def turns(group: Sequence[Point], n_used: int | None = None) -> list[dict[str, Any]]:
    """Return a row for each point; the programs take turns on all cores, or on the first n."""
    workers = [_worker(point, n_used) for point in group]
    rounds, failed = take_turns(workers, N_ROUNDS)
    rows = []
    for point, worker in zip(group, workers, strict=True):
        row: dict[str, Any] = dict(zip(("engine", "mode", "arms", "links_per_section"), point, strict=True))
        if worker.name in failed:
            row["failed"] = failed[worker.name]
        else:
            row |= over_rounds([worker.facts | facts for facts in rounds[worker.name]])
            spec = ArmSpec.default().replace(structure={"links_per_section": point[3]})
            row |= told_error(spec, [worker.facts])
        rows.append(row)
    return rows


def _worker(point: Point, n_used: int | None = None) -> Worker:
    engine, mode, n, links = point
    name = f"{engine}, {mode}, {n} arms, {links} links"
    program = ["benchmarks.speed.jax_worker", "steps", engine, mode, str(n), str(links)]
    return Worker(name, program, n_cores=n_used)


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


def _side_by_side(spec: ArmSpec, on_gpu: bool) -> list[dict[str, Any]]:
    """Return rates of this project and of C MuJoCo in turns, and each one's distance from the equilibrium."""
    n, n_arms, skipped = str(n_cores()), 8192 if on_gpu else 1024, []
    module, subproc = "benchmarks.speed.mujoco_worker", f"C MuJoCo, {SUBPROC}, {n_cores()} processes"
    with tempfile.TemporaryDirectory() as folder:
        write_arm(Path(folder), spec)
        workers = [
            _worker(("chain", "quasistatic", n_arms, N_LINKS)),
            _worker(("mjx", "quasistatic", n_arms if on_gpu else 128, N_LINKS)),
            Worker(f"C MuJoCo, rollout, {n} threads", [module, "rollout", folder, n]),
        ]
        try:
            workers.append(Worker(subproc, [module, "subproc", folder, n], peer_python("sb3-contrib")))
        except PeerError as error:
            skipped.append({"program": subproc, "skipped": str(error)})
        rounds, failed = take_turns(workers, N_ROUNDS)
    rows = []
    for worker in workers:
        figures: dict[str, Any] = {"failed": failed.get(worker.name)}
        if told := rounds.get(worker.name):
            figures = over_rounds(told) | told_error(spec, [worker.facts, *told])
        rows.append({"program": worker.name, **figures})
    return side_by_side([*rows, *skipped])


def side_by_side(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows with the paper's added, and each rate as a multiple of SubprocVecEnv's."""
    program = f"the paper: {PAPER_WORKERS} workers, {PAPER_STEP_S} s a step, at most"
    paper = {"program": program, "env_steps_per_s": round(PAPER_WORKERS / PAPER_STEP_S)}
    base = next((row.get("env_steps_per_s") for row in rows if SUBPROC in row["program"]), None)
    full = []
    for row in rows:
        rate = row.get("env_steps_per_s")
        full.append({**row, "times_subproc": _digits(rate / base) if rate and base else None})
    return [{name: row.get(name) for name in (*COLUMNS, "skipped", "failed")} for row in [*full, paper]]


def simulated_time() -> list[dict[str, Any]]:
    """Return the simulated seconds of an arm a second, of programs that step in time and take turns."""
    n, skipped = str(n_cores()), []
    with tempfile.TemporaryDirectory() as folder:
        write_arm(Path(folder), ArmSpec.default())
        workers = [
            _worker(("mjx", "dynamic", N_MOVING, N_LINKS)),
            Worker(
                f"C MuJoCo, rollout, {n} threads", ["benchmarks.speed.mujoco_worker", "rollout", folder, n]
            ),
        ]
        try:
            python = peer_python("soromox")
            for method, name in SOROMOX.items():
                program = ["benchmarks.speed.soromox_worker", method, str(N_MOVING)]
                workers.append(Worker(name, program, python))
        except PeerError as error:
            skipped += [{"program": name, "skipped": str(error)} for name in SOROMOX.values()]
        rounds, failed = take_turns(workers, N_ROUNDS)
    rows = []
    for worker in workers:
        row: dict[str, Any] = {"program": worker.name, "failed": failed.get(worker.name)}
        if told := rounds.get(worker.name):
            row |= worker.facts | over_rounds(told)
        rows.append(row)
    return [moving_row(row) for row in [*rows, *skipped]]


def moving_row(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of `simulated_time`; of environment steps a second, the duration of one is known."""
    config = EnvConfig()
    if "env_steps_per_s" in row and "simulated_s_per_s" not in row:
        rate = _digits(row["env_steps_per_s"] * config.dynamic_step_s)
        row = {"arms": N_MOVING, "step_ms": 1e3 * config.simulation_step_s, **row, "simulated_s_per_s": rate}
    return {name: row.get(name) for name in (*MOVING_COLUMNS, "skipped", "failed")}


def _starts() -> dict[str, Any]:
    """Return seconds until a new process is ready to train, with an empty and with a filled cache."""
    starts: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as cache:
        for state in ("empty_cache", "filled_cache"):
            worker = Worker(f"training, {state}", ["benchmarks.speed.jax_worker", "start", cache])
            begun = time.perf_counter()
            try:
                with working(worker):
                    starts[state] = {"total_s": round(time.perf_counter() - begun, 1)}
            except WorkerError as error:
                starts[state] = {"failed": error.reason}
    return starts
