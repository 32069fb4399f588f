"""Environment steps and gradient steps a second of this machine; on request beside other simulators.

Random actions saturate about half of the chambers. Other simulators' programs take turns with ours, on the
same cores; beside each rate stands the distance from the true equilibrium.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import jax
import numpy as np

from benchmarks.harness.common import machine_kind, show
from benchmarks.harness.peers import peer_python
from benchmarks.harness.rounds import Worker, n_cores, take_turns
from benchmarks.speed.jax_worker import N_POSES, digits, mesh_of, rates, resized, rollout, split_cpu, training
from benchmarks.speed.truth import REPORTED, reported_error
from mjx_softarm._support import cli, xla
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import provenance, write_json
from mjx_softarm.env.config import ENGINES, Engine
from mjx_softarm.spec import ArmSpec

DEFAULT = [("chain", "quasistatic"), ("mjx", "quasistatic"), ("mjx", "dynamic")]
PRESET = {"quasistatic": "quick", "dynamic": "motion"}  # by mode, of a training
HEAD = f"{'engine':9}{'mode':13}{'arms':>7}{'compile [s]':>13}{'env steps/s':>13}{'updates/s':>11}"
# Beside other simulators
N_ROUNDS = 3
N_RESTING, N_MOVING = 1024, 128  # arms of this project's programs
SOROMOX = {"explicit": "SoRoMoX, explicit", "implicit": "SoRoMoX, this project's implicit step"}

Mode = Literal["quasistatic", "dynamic"]
Program = tuple[list[str], str | None]  # module and arguments, key of `PINS`; None: this environment


def measure(
    arms: tuple[int, ...] = (),
    engine: tuple[Engine, ...] = (),
    mode: tuple[Mode, ...] = (),
    seconds: float = 1.0,
    train: bool = False,
    devices: int = 1,
    peers: bool = False,
    json: cli.MaybePath = None,
) -> int:
    """How many environment steps and updates does this machine make in a second?

    Args:
        arms: numbers of arms; none: 64, 1024 and 8192, and 65536 on a GPU
        engine: which engines; none: mjx and chain
        mode: quasistatic (at rest), dynamic (in motion); none: both
        seconds: time to measure each row
        train: rollouts with updates on one device, as the presets quick and motion have them
        devices: how many JAX devices share the arms evenly; 1: one, or all cores of a CPU
        peers: instead, beside C MuJoCo, SubprocVecEnv and SoRoMoX; takes half an hour
        json: file for the figures; None: none is written
    """
    if json and not json.parent.is_dir():
        raise InputError(f"--json: got {json}, expected a file in a folder that exists")
    if any(n < 1 for n in arms):
        raise InputError(f"--arms: got {' '.join(map(str, arms))}, expected numbers from 1")
    if train and devices != 1:
        raise InputError(f"--devices: got {devices}, expected 1 with --train")
    if peers:
        if arms or engine or mode or train or devices != 1:
            raise InputError("--peers: got other options too, expected --json at most")
        figures = beside_peers()
        show(figures, "throughput beside other simulators")
    else:
        asked = [(one, way) for way in mode or ENGINES for one in engine if one in ENGINES[way]]
        pairs = asked if engine else [pair for pair in DEFAULT if pair[1] in (mode or ENGINES)]
        if not pairs:
            raise InputError(f"--engine: got {' '.join(engine)}, expected one with --mode {' '.join(mode)}")
        xla.enable_compilation_cache()
        if not train and devices == 1:
            split_cpu()
        if not 1 <= devices <= jax.device_count():
            raise InputError(f"--devices: got {devices}, expected 1 to {jax.device_count()}")
        sizes = arms or (64, 1024, 8192, *((65_536,) if jax.default_backend() == "gpu" else ()))
        if odd := [n for n in sizes if n % devices]:
            raise InputError(f"--arms: got {odd[0]}, expected a multiple of {devices} devices")
        rows = rows_of([(*pair, n) for n in sizes for pair in pairs], seconds, train, devices)
        setting = {"machine": machine_kind(), "seconds": seconds, "train": train, "devices": devices}
        figures = {**setting, "rows": rows}
    if json:
        write_json(json, {**figures, **provenance("benchmarks")})
        print(f"written: {json}")
    return 0


def rows_of(
    points: Sequence[tuple[Any, Any, int]], seconds: float, train: bool = False, devices: int = 1
) -> list[dict[str, Any]]:
    """Measure this project's programs of engine, mode and arms; print a row of each once it is measured."""
    print(f"{machine_kind()}\n{HEAD}", flush=True)
    rows = []
    for point in points:
        rows.append(row_of(*point, seconds, train, devices))
        print(line_of(rows[-1]), flush=True)
    return rows


def row_of(
    engine: Engine, mode: Mode, n_arms: int, seconds: float, train: bool, devices: int
) -> dict[str, Any]:
    """Compile and measure a program; return its figures, or why it failed."""
    row: dict[str, Any] = {"engine": engine, "mode": mode, "arms": n_arms}
    try:
        if train:
            config = resized(PRESET[mode], n_arms, vector_steps_per_epoch=1)
            env = dataclasses.replace(config.env, engine=engine, n_poses=N_POSES)
            program = training(dataclasses.replace(config, env=env))
        else:
            program = rollout(engine, mode, n_arms, mesh_of(n_arms, devices))
        figures = {name: digits(rate) for name, rate in rates(program, seconds).items()}
    except jax.errors.JaxRuntimeError as error:  # such as too little memory
        return row | {"failed": str(error).splitlines()[0]}
    return row | {"compile_s": round(program.compile_s, 1), **figures}


def line_of(row: Mapping[str, Any]) -> str:
    """Return a row of the table as text."""
    begin = f"{row['engine']:9}{row['mode']:13}{row['arms']:>7,}"
    if "failed" in row:
        return f"{begin}  failed: {row['failed']}"
    updates = f"{row['updates_per_s']:>11,}" if "updates_per_s" in row else ""
    return f"{begin}{row['compile_s']:>13}{row['env_steps_per_s']:>13,}{updates}"


def beside_peers() -> dict[str, Any]:
    """Measure programs that take turns, on the same cores: at rest, then in motion."""
    n, worker = str(n_cores()), "benchmarks.speed.mujoco_worker"
    stepped: dict[str, Program] = {"C MuJoCo, rollout": ([worker, "rollout", n], None)}
    subproc: dict[str, Program] = {"C MuJoCo, SubprocVecEnv": ([worker, "subproc", n], "sb3-contrib")}
    soromox: dict[str, Program] = {
        name: (["benchmarks.speed.soromox_worker", method, str(N_MOVING)], "soromox")
        for method, name in SOROMOX.items()
    }
    at_rest = {engine: _ours(engine, "quasistatic", N_RESTING) for engine in ENGINES["quasistatic"]}
    moving = {"mjx": _ours("mjx", "dynamic", N_MOVING), **stepped, **soromox}
    return {"at_rest": programs_rows({**at_rest, **stepped, **subproc}), "in_motion": programs_rows(moving)}


def _ours(engine: str, mode: str, n_arms: int) -> Program:
    return ["benchmarks.speed.jax_worker", engine, mode, str(n_arms)], None


def programs_rows(programs: Mapping[str, Program]) -> list[dict[str, Any]]:
    """Return a row for each program: medians of its rates over the rounds, or why it has none."""
    workers, reasons = [], {}
    for name, (program, library) in programs.items():
        try:
            workers.append(Worker(name, program, peer_python(library) if library else None))
        except InputError as error:
            reasons[name] = str(error)
    rounds, failed = take_turns(workers, N_ROUNDS)
    rows = [{"program": name, "failed": reason} for name, reason in {**reasons, **failed}.items()]
    for worker in workers:
        if answers := rounds.get(worker.name):
            rates = {
                name: digits(float(np.median([facts[name] for facts in answers])))
                for name in answers[0]
                if name not in REPORTED
            }
            facts = {name: value for name, value in worker.facts.items() if name not in REPORTED}
            errors = reported_error(ArmSpec.default(), [worker.facts, *answers])
            rows.append({"program": worker.name, **facts, **rates, **errors})
    return rows
