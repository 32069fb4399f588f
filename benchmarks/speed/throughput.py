"""Environment steps and gradient steps a second of this machine; on request beside other simulators.

Random actions saturate about half of the chambers. With `--peers`, each program is a process of its own, and
they take turns round by round; one that fails has a row that says why. All programs of a table have the same
cores. C MuJoCo's arms are stepped in time until they rest (`benchmarks.speed.mujoco_arms`); the distance from
the true equilibrium stands beside each rate. `times_rollout` is what solving gains over stepping on the same
cores; `times_subproc` adds what one process gains over many. In motion, programs are compared by simulated
seconds of all arms together.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console

from benchmarks.harness.common import machine_kind, n_cores, show
from benchmarks.harness.peers import PeerError, peer_python
from benchmarks.harness.rounds import Facts, Worker, take_turns
from benchmarks.speed.jax_worker import N_POSES, gradient_steps, rates, resized, rollout, training
from benchmarks.speed.mujoco_arms import write_arm
from benchmarks.speed.truth import REPORTED, reported_error
from mjx_softarm._support import cli, xla
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import provenance, write_json
from mjx_softarm.env import EnvConfig
from mjx_softarm.env.config import ENGINES
from mjx_softarm.spec import ArmSpec
from train.epoch.devices import mesh_of

DEFAULT = [("chain", "quasistatic"), ("mjx", "quasistatic"), ("mjx", "dynamic")]
PRESET = {"quasistatic": "quick", "dynamic": "motion"}  # by mode, of a training
HEAD = f"{'engine':9}{'mode':13}{'arms':>7}{'compile [s]':>13}{'env steps/s':>13}{'updates/s':>11}"
# Beside other simulators
N_ROUNDS = 3
PAPER_WORKERS, PAPER_STEP_S = 14, 0.03  # the paper's cost of an environment step
SUBPROC, ROLLOUT = "SubprocVecEnv", "C MuJoCo, rollout"
N_RESTING, N_MOVING = 1024, 128  # arms of this project's programs
SOROMOX = {"explicit": "SoRoMoX, explicit", "implicit": "SoRoMoX, this project's implicit step"}

Peer = tuple[str, list[str], str]  # name, program, key of `PINS`


class Point(NamedTuple):
    """A program of this project."""

    engine: Any
    mode: Any
    arms: int


def measure(
    arms: tuple[int, ...] = (),
    engine: tuple[str, ...] = (),
    mode: tuple[str, ...] = (),
    devices: int | None = None,
    seconds: float = 1.0,
    train: bool = False,
    peers: bool = False,
    json: cli.MaybePath = None,
) -> int:
    """How many environment steps and updates does this machine make in a second?

    Args:
        arms: numbers of arms; none: 64, 1024 and 8192, and 65536 on a GPU
        engine: engines, of mjx, chain, mjx-step, warp; none: mjx and chain
        mode: quasistatic (at rest), dynamic (in motion); none: both
        devices: devices that share the arms; None: all cores of a CPU, one with --train; one GPU
        seconds: time to measure each row
        train: rollouts with updates, as the presets quick and motion have them
        peers: instead, beside C MuJoCo, SubprocVecEnv and SoRoMoX; takes half an hour
        json: file for the figures; None: none is written

    Raises:
        InputError: an option is out of range, or the options do not go together.
    """
    if json and not json.parent.is_dir():
        raise InputError(f"--json: got {json}, expected a file in a folder that exists")
    if peers:
        if arms or engine or mode or devices or train:
            raise InputError("--peers: got other options too, expected --json at most")
        figures = beside_peers()
        show(figures, "throughput beside other simulators")
    else:
        pairs = pairs_of(engine, mode)
        if not 0.0 < seconds < math.inf:
            raise InputError(f"--seconds: got {seconds:g}, expected a finite number > 0")
        figures = of_this_machine(pairs, arms, devices, seconds, train)
    if json:
        write_json(json, {**figures, **provenance("benchmarks")})
        print(f"written: {json}")
    return 0


def pairs_of(engines: Sequence[str], modes: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of engine and mode that options ask for.

    Raises:
        InputError: an engine or a mode is unknown, or an engine has none of the modes.
    """
    known = tuple(dict.fromkeys(name for names in ENGINES.values() for name in names))
    for option, given, choices in (("--engine", engines, known), ("--mode", modes, tuple(ENGINES))):
        if unknown := [name for name in given if name not in choices]:
            raise InputError(f"{option}: got {', '.join(unknown)}, expected some of {', '.join(choices)}")
    chosen = modes or tuple(ENGINES)
    for engine in engines:
        if not any(engine in ENGINES[mode] for mode in chosen):
            possible = ", ".join(name for mode in chosen for name in ENGINES[mode])
            raise InputError(f"--engine: got {engine} with --mode {' '.join(chosen)}, expected {possible}")
    if not engines:
        return [(engine, mode) for engine, mode in DEFAULT if mode in chosen]
    return [(engine, mode) for mode in chosen for engine in engines if engine in ENGINES[mode]]


def of_this_machine(
    pairs: Sequence[tuple[str, str]], arms: Sequence[int], devices: int | None, seconds: float, train: bool
) -> dict[str, Any]:
    """Measure this project's programs, and print a row of each as soon as it is measured."""
    if devices is not None and devices < 1:
        raise InputError(f"--devices: got {devices}, expected a number from 1")
    for n in arms:
        if n < 1 or n % (devices or 1):
            expected = f"multiples of the {devices} devices" if devices else "numbers from 1"
            raise InputError(f"--arms: got {n}, expected {expected}")
    # Devices, which JAX makes of a CPU as it starts
    n_devices = devices or (1 if train else n_cores())
    jax.config.update("jax_num_cpu_devices", n_devices)
    on_cpu = jax.default_backend() == "cpu"
    n_devices = n_devices if devices or on_cpu else 1
    sizes = arms or (64, 1024, 8192, *(() if on_cpu else (65_536,)))
    xla.enable_compilation_cache()
    console, rows = Console(highlight=False, markup=False), list[dict[str, Any]]()
    name = machine_kind()
    console.print(f"{name}; {n_devices} device{'s' * (n_devices > 1)}\n{HEAD}", soft_wrap=True)
    for point in (Point(*pair, n) for n in sizes for pair in pairs):
        with console.status(f"compiling and measuring {point.engine}, {point.mode}, {point.arms:,} arms"):
            row = row_of(point, n_devices if point.arms % n_devices == 0 else 1, seconds, train)
        rows.append(row)
        console.print(line_of(row), soft_wrap=True)
    figures = {"machine": name, "seconds": seconds, "train": train, "rows": rows}
    if not train:
        with console.status("compiling and measuring gradient steps"):
            program = gradient_steps("quick")
            figures["updates_per_s"] = digits(rates(program, seconds)["updates_per_s"])
        updates, compile_s = f"{figures['updates_per_s']:,}", program.compile_s
        console.print(f"gradient steps of `quick` alone: {updates} a second, compiled in {compile_s:.1f} s")
    return figures


def row_of(point: Point, n_devices: int, seconds: float, train: bool) -> dict[str, Any]:
    """Compile and measure a program; return its figures, or why it failed."""
    row: dict[str, Any] = {**point._asdict(), "devices": n_devices}
    mesh = mesh_of(str(n_devices))
    try:
        if train:
            config = resized(PRESET[point.mode], point.arms, vector_steps_per_epoch=1)
            env = dataclasses.replace(config.env, engine=point.engine, n_poses=N_POSES)
            program = training(dataclasses.replace(config, env=env), mesh)
        else:
            program = rollout(*point, mesh)
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
    with tempfile.TemporaryDirectory() as folder:
        write_arm(Path(folder), ArmSpec.default())
        return {
            "rounds": N_ROUNDS,
            "side_by_side": side_by_side(_at_rest(folder)),
            "simulated_time": [moving_row(row) for row in _in_motion(folder)],
        }


def _at_rest(folder: str) -> list[dict[str, Any]]:
    """Return a row for each program whose environment step ends at rest."""
    n = str(n_cores())
    subproc = f"C MuJoCo, {SUBPROC}, {n} processes"
    program = ["benchmarks.speed.mujoco_worker", "subproc", folder, n]
    ours = [_ours(engine, "quasistatic", N_RESTING) for engine in ENGINES["quasistatic"]]
    return programs_rows([*ours, _stepped(folder, n)], [(subproc, program, "sb3-contrib")])


def _in_motion(folder: str) -> list[dict[str, Any]]:
    """Return a row for each program that steps in time."""
    peers = [
        (name, ["benchmarks.speed.soromox_worker", method, str(N_MOVING)], "soromox")
        for method, name in SOROMOX.items()
    ]
    return programs_rows([_ours("mjx", "dynamic", N_MOVING), _stepped(folder, str(n_cores()))], peers)


def _ours(engine: str, mode: str, n_arms: int) -> Worker:
    program = ["benchmarks.speed.jax_worker", "steps", engine, mode, str(n_arms)]
    return Worker(f"{engine}, {mode}, {n_arms} arms", program)


def _stepped(folder: str, n_threads: str) -> Worker:
    program = ["benchmarks.speed.mujoco_worker", "rollout", folder, n_threads]
    return Worker(f"{ROLLOUT}, {n_threads} threads", program)


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
    answers = rounds.get(worker.name)
    if not answers:
        return {"failed": failed[worker.name]}
    figures = over_rounds([worker.facts | facts for facts in answers])
    return figures | reported_error(ArmSpec.default(), [worker.facts, *answers])


def over_rounds(rounds: Sequence[Facts]) -> dict[str, Any]:
    """Return the medians of rates over rounds, and the last round's other figures; tips are left out."""
    merged: dict[str, Any] = {}
    for name, value in rounds[-1].items():
        if name.endswith("_per_s"):
            merged[name] = digits(float(np.median([facts[name] for facts in rounds])))
        elif name not in REPORTED:
            merged[name] = value
    return merged


def digits(rate: float) -> float | int:
    """Round a rate to two decimals below 100, else to an integer."""
    return round(rate) if rate >= 100 else round(rate, 2)


def side_by_side(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows with the paper's added, and rates as multiples of C MuJoCo's in threads and processes."""
    full = [dict(row) for row in rows]
    for key, name in (("times_rollout", ROLLOUT), ("times_subproc", SUBPROC)):
        base = next((row.get("env_steps_per_s") for row in rows if name in row["program"]), None)
        for row in full:
            rate = row.get("env_steps_per_s")
            row[key] = digits(rate / base) if rate and base else None
    program = f"the paper: {PAPER_WORKERS} workers, {PAPER_STEP_S} s a step, at most"
    return [*full, {"program": program, "env_steps_per_s": round(PAPER_WORKERS / PAPER_STEP_S)}]


def moving_row(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of `simulated_time`: this project's rate is one of environment steps of known duration."""
    if "env_steps_per_s" not in row or "simulated_s_per_s" in row:
        return row
    config = EnvConfig()
    rate = digits(row["env_steps_per_s"] * config.dynamic_step_s)
    return {**row, "arms": N_MOVING, "step_ms": 1e3 * config.simulation_step_s, "simulated_s_per_s": rate}
