"""How many environment steps a second, settling and resets included, ours and the peers', in one run.

Each program is a process of its own, and they take turns round by round; one that fails has a row that says
why. Random actions saturate about half of the chambers. What a settle costs against its error is told by
`settle`, the learner's speed by `learner`.

C MuJoCo's arm comes to rest in time steps, which takes it seconds of simulated time for each environment
step: it swings until its own damping has had its due, and the law's integral action fills or empties a
chamber no faster than its gains let it. How far it is from the true rest when it counts as resting stands
beside its rate. The paper's 0.03 s for a step is taken at its word.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.harness.common import n_cores
from benchmarks.harness.peers import PeerError, peer_python
from benchmarks.harness.rounds import Facts, Worker, take_turns
from benchmarks.speed import gpu
from benchmarks.speed.throughput_peers import write_arm
from benchmarks.speed.truth import ERROR, TOLD, told_error
from mjx_softarm.spec import ArmSpec

N_ROUNDS = 3
LINKS = (2, 4, 6, 8, 10)  # per section
MOST_LINKS_MJX = 6
NO_MJX = f"compiles for minutes and in gigabytes at {MOST_LINKS_MJX} links, and for longer at more"
N_LINKS = ArmSpec.default().structure.links_per_section
PAPER_WORKERS, PAPER_STEP_S = 14, 0.03  # the paper's cost of an environment step; the workers may share cores
SUBPROC = "SubprocVecEnv"
NOTES = {
    "simulated seconds per env step": "C MuJoCo's arm is stepped until it rests: it swings until its own "
    "damping has had its due, and the law's integral action fills or empties a chamber no faster than its "
    "gains let it",
    "median, 95 %, max mm": "how far the tip then is from the true equilibrium",
    "the paper": f"its {PAPER_STEP_S} s for an environment step is taken at its word; how far from rest its "
    "arms are then is not known",
}
LOCKSTEP = "in lockstep: a step is over when the slowest arm rests"

Point = tuple[str, str, int, int]  # engine, mode, arms, links per section


def points(on_gpu: bool) -> list[list[Point]]:
    """What is measured, in groups that take turns."""
    most = 32_768 if on_gpu else 1024
    chain = (1, 128, 1024, 8192, most) if on_gpu else (1, 8, 32, 128, 512, most)
    mjx = (1, 1024, 8192, most) if on_gpu else (1, 128, most)  # half a minute to compile, each
    fixed = 8192 if on_gpu else 128
    groups: list[list[Point]] = []
    for n in chain:
        groups.append([("chain", "quasistatic", n, N_LINKS)])
        if n in mjx:
            groups[-1] += [("mjx", "quasistatic", n, N_LINKS), ("mjx", "dynamic", n, N_LINKS)]
    for links in (links for links in LINKS if links != N_LINKS):
        groups.append([("chain", "quasistatic", fixed, links)])
        if links <= MOST_LINKS_MJX:
            groups[-1] += [("mjx", "quasistatic", fixed, links), ("mjx", "dynamic", fixed, links)]
    return groups


def measure() -> dict[str, Any]:
    """Rates over arms and over links per section; peers; start-up times of training; goals for a GPU."""
    on_gpu = jax.default_backend() == "gpu"
    rows = [row for group in points(on_gpu) for row in _group(group)]
    without_mjx = [
        {"engine": "mjx", "links_per_section": links, "skipped": NO_MJX}
        for links in LINKS
        if links > MOST_LINKS_MJX
    ]
    peers = _side_by_side(ArmSpec.default(), on_gpu)
    print("starting: a training process twice, cache empty and filled", flush=True)
    with tempfile.TemporaryDirectory() as cache:
        starts = [_start(cache) for _ in range(2)]
    return {
        "rounds": N_ROUNDS,
        "over_arms": [row for row in rows if row["links_per_section"] == N_LINKS],
        "over_links": sorted(
            (row for row in rows if row["arms"] == (8192 if on_gpu else 128)),
            key=lambda row: (row["engine"], row["mode"], row["links_per_section"]),
        )
        + without_mjx,
        "side_by_side": peers,
        "notes": NOTES,
        "start": {"cold": starts[0], "cached": starts[1]},
        "goals": gpu.rate_goals(rows, on_gpu) + [gpu.training_goal(on_gpu)],
    }


def _arms(point: Point, cache: str) -> Worker:
    engine, mode, n, links = point
    name = f"{engine}, {mode}, {n} arms, {links} links"
    return Worker(name, ["benchmarks.speed.throughput_arms", engine, mode, str(n), str(links), cache])


def _group(group: Sequence[Point]) -> list[dict[str, Any]]:
    """A row for each point, whose programs take turns.

    One that fails among others, for want of memory say, is tried once more alone; then its row tells why.
    """
    rows = _turns(group)
    if len(group) > 1:
        rows = [
            _turns([point])[0] if "failed" in row else row for point, row in zip(group, rows, strict=True)
        ]
    return rows


def _turns(group: Sequence[Point]) -> list[dict[str, Any]]:
    with contextlib.ExitStack() as stack:
        caches = [stack.enter_context(tempfile.TemporaryDirectory()) for _ in group]
        workers = [_arms(point, cache) for point, cache in zip(group, caches, strict=True)]
        rounds, failed = take_turns(workers, N_ROUNDS)
    rows = []
    for point, worker in zip(group, workers, strict=True):
        row: dict[str, Any] = dict(zip(("engine", "mode", "arms", "links_per_section"), point, strict=True))
        if worker.name in failed:
            row["failed"] = failed[worker.name]
        else:
            row |= over_rounds(rounds[worker.name])
            row |= {name: value for name, value in worker.facts.items() if name.endswith("_s")}
        rows.append(row)
    return rows


def over_rounds(rounds: Sequence[Facts]) -> dict[str, Any]:
    """Medians of the rates of some rounds, and the rest as the last round told it."""
    merged: dict[str, Any] = {}
    for name, value in rounds[-1].items():
        if name.endswith("_per_s"):
            merged[name] = _digits(np.median([facts[name] for facts in rounds]))
        elif name not in TOLD:
            merged[name] = value
    return merged


def _digits(rate: Any) -> float | int:
    """Three digits or more, no fractions beyond."""
    return round(float(rate)) if rate >= 100 else round(float(rate), 2)


def _side_by_side(spec: ArmSpec, on_gpu: bool) -> list[dict[str, Any]]:
    """Ours beside the peers: rates in turns, and how far from the true equilibrium each comes to rest."""
    n, n_arms = n_cores(), 8192 if on_gpu else 1024
    with contextlib.ExitStack() as stack:
        folder, *caches = (stack.enter_context(tempfile.TemporaryDirectory()) for _ in range(3))
        write_arm(Path(folder), spec)
        programs = [
            _arms(("chain", "quasistatic", n_arms, N_LINKS), caches[0]),
            _arms(("mjx", "quasistatic", n_arms if on_gpu else 128, N_LINKS), caches[1]),
            _subproc(folder, n),
            _rollout(folder, n),
            _warp(folder, n_arms, on_gpu),
        ]
        workers = [program for program in programs if isinstance(program, Worker)]
        rounds, failed = take_turns(workers, N_ROUNDS)
    rows = []
    for program in programs:
        if not isinstance(program, Worker):
            rows.append(program)
        elif program.name in failed:
            rows.append({"program": program.name, "failed": failed[program.name]})
        else:
            told = rounds[program.name]
            error = told_error(spec, [program.facts, *told])
            rows.append({"program": program.name, **over_rounds(told), **error})
    return side_by_side(rows)


def side_by_side(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The paper's figure added, and each rate as a multiple of it and of Stable-Baselines3's processes."""
    paper_rate = round(PAPER_WORKERS / PAPER_STEP_S)
    paper = {
        "program": f"the paper: {PAPER_WORKERS} workers, {PAPER_STEP_S} s a step",
        "env_steps_per_s": paper_rate,
        "note": "at most, and at its word",
    }
    base = next((row.get("env_steps_per_s") for row in rows if SUBPROC in row["program"]), None)
    names = (
        "program",
        "env_steps_per_s",
        "times_subproc",
        "times_paper",
        "physics_steps_per_s",
        "physics_steps_per_env_step",
        "simulated_s_per_env_step",
        "share_in_time_steps",
        *ERROR,
        "note",
        "skipped",
        "failed",
    )
    full = []
    for row in [*rows, paper]:
        rate = None if row is paper else row.get("env_steps_per_s")
        row = {
            "note": LOCKSTEP if "C MuJoCo" in row["program"] else None,
            "times_subproc": _digits(rate / base) if rate and base else None,
            "times_paper": _digits(rate / paper_rate) if rate else None,
            **row,
        }
        full.append({name: row.get(name) for name in names})
    return full


def _subproc(folder: str, n: int) -> Worker | dict[str, Any]:
    """SB3's processes; or a row that says why there are none."""
    name = f"C MuJoCo, {SUBPROC}, {n} processes"
    try:
        python = peer_python("sb3-contrib")
    except PeerError as error:
        return {"program": name, "skipped": str(error)}
    return Worker(name, ["benchmarks.speed.throughput_peers", "subproc", folder, str(n)], python)


def _rollout(folder: str, n: int) -> Worker:
    return Worker(
        f"C MuJoCo, rollout, {n} threads", ["benchmarks.speed.throughput_peers", "rollout", folder, str(n)]
    )


def _warp(folder: str, n: int, on_gpu: bool) -> Worker | dict[str, Any]:
    name = f"MJX-Warp, {n} arms, time steps alone"
    if not on_gpu:
        return {"program": name, "skipped": gpu.NO_DEVICE}
    if importlib.util.find_spec("warp") is None:
        return {"program": name, "skipped": "warp is not installed; pip install 'mujoco-mjx[warp]'"}
    return Worker(name, ["benchmarks.speed.throughput_peers", "warp", folder, str(n)])


_START = """
import json, time
start = time.perf_counter()
import jax
from mjx_softarm._support import xla
xla.enable_compilation_cache({cache!r})
from mjx_softarm.env import ReachEnv
from train.agent.hindsight_tqc import HindsightTQC
from train.presets import PRESETS
from train.epoch.job import Job
imported = time.perf_counter()
config, env = PRESETS["quick"], ReachEnv()
job = Job(config, env, HindsightTQC(config, env))
pool = time.perf_counter()
job.start(lambda: job.init(jax.random.PRNGKey(0)))
print(json.dumps({{"import_s": imported - start, "workspace_s": pool - imported,
                   "compile_epoch_s": time.perf_counter() - pool, "total_s": time.perf_counter() - start}}))
"""


def _start(cache: str) -> dict[str, Any]:
    """A new process up to a compiled training epoch; or why it failed."""
    done = subprocess.run(
        [sys.executable, "-c", _START.format(cache=cache)],
        env={**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        print(f"failed: the start of a training: {done.stderr}", flush=True)
        return {"failed": " ".join([f"status {done.returncode}:", *done.stderr.splitlines()[-1:]])}
    return {name: round(value, 1) for name, value in json.loads(done.stdout.splitlines()[-1]).items()}
