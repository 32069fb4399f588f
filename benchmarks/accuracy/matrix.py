"""Policies on the circle, in the simulation that they learned in, in others, and on their arm.

The first columns are simulations of the arm that a policy learned with, without the control loop: it goes to
each goal from a random pose of the workspace, and the tip is looked at after the last action. The last three
columns are the arm that the policy is calibrated to, driven by the loop: a twin in C MuJoCo, a rod, or
SoRoMoX's rod. A policy of motion cannot be used at rest, where there are no rates to observe.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.accuracy.arms import ARMS, accuracy_of
from benchmarks.harness.common import arms_and_files, grouped, target
from benchmarks.paper.kinds import POLICY_FILE
from mjx_softarm._support import xla
from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.mechanics.excitation import circle_poses
from train.agent.registry import World, learner_of
from train.runs.evaluate import follower, nominal, start_keys
from train.runs.folder import Run

# Settings of the environment
SIMULATIONS: dict[str, dict[str, Any]] = {
    "chain, at rest": {"mode": "quasistatic", "engine": "chain"},
    "MJX, at rest": {"mode": "quasistatic", "engine": "mjx"},
    "chain, in motion": {"mode": "dynamic", "engine": "chain", "simulation_step_s": 0.02},
    "mjx.step, in motion": {"mode": "dynamic", "engine": "mjx", "simulation_step_s": 0.002},
}
N_AT_REST, N_IN_MOTION = 4, 12  # actions of policies that were trained so, in all simulations
REST_S = 4.0  # duration of an action of policies trained at rest, in motion: the arm has nearly come to rest
ARM_KINDS = "C MuJoCo twin", "rod", "SoRoMoX"
SOROMOX = "soromox"  # arm of `benchmarks arms`
TWICE = 2.0  # target: error in any simulation and on any arm, over that in the simulation of the training
N_POSES = 256  # of the pool of starts
BESIDE = 0, 20  # seed of the rod, and number of random pressures, for `beside_soromox`


def measure(runs: tuple[str, ...], points: int = 8) -> dict[str, Any]:
    """How exact are policies in simulations that they did not learn in, and on their arms?

    Args:
        runs: ARM=RUN of each, a trained and exported run that is calibrated to the arm: a twin such as
            twin:0, or soromox, the arm of `benchmarks arms`
        points: of the circle

    Raises:
        InputError: there are no runs, one is not exported, or a goal on an arm was not measured.
        RunError: a folder holds no run.
        PeerError: SoRoMoX could not be installed.
    """
    xla.enable_compilation_cache()
    # What may fail comes first
    chosen = []
    for arm, folder in arms_and_files(runs, "--runs", "RUN"):
        run = opened(Path(folder))
        chosen.append((run, arm, kind_of(arm), trained_in(run.config.env)))
    beside, rows = beside_soromox(), []
    for run, arm, kind, trained in chosen:
        measured = in_simulations(run, points) | dict.fromkeys(ARM_KINDS) | {kind: on_arm(run, arm, points)}
        rows.append({"trained in": trained, "arm": arm, **measured})
        print(rows[-1], flush=True)
    found = {"points": points, "means": means(rows), "targets": targets(rows)}
    return found | {"rod beside SoRoMoX": beside, "runs": rows}


def opened(folder: Path) -> Run:
    """Open a run.

    Raises:
        InputError: it is not exported.
        RunError: the folder holds no run.
    """
    run = Run.open(folder)
    if not (folder / POLICY_FILE).exists():
        raise InputError(f"--runs: {folder}: got no {POLICY_FILE}, expected an exported run")
    return run


def trained_in(config: EnvConfig) -> str:
    """Return the name of a run's simulation, a key of `SIMULATIONS`; its time step may differ.

    Raises:
        InputError: there is none, as for MJX-Warp.
    """
    for name, own in SIMULATIONS.items():
        if (config.mode, config.engine) == (own["mode"], own["engine"]):
            return name
    raise InputError(f"--runs: got the engine {config.engine}, expected chain or mjx")


def in_simulations(run: Run, points: int) -> dict[str, float | None]:
    """Return the mean error [mm] on the circle in each simulation; None for one that a policy cannot see."""
    own, policy, found = run.config.env, run.policy(), dict[str, float | None]()
    n_actions = N_IN_MOTION if own.moves else N_AT_REST
    duration_s = own.dynamic_step_s if own.moves else REST_S
    for name, settings in SIMULATIONS.items():
        if own.observation == "motion" and settings["mode"] == "quasistatic":
            found[name] = None
            continue
        config = dataclasses.replace(own, n_poses=N_POSES, dynamic_step_s=duration_s, **settings)
        env = nominal(ReachEnv(run.spec, config, run.arm.s2r))
        learner = learner_of(run.config.learner, World(env, None, None))
        follow = xla.jit(jax.vmap(follower(env, learner, n_actions), in_axes=(None, 0, 0)))
        goals = np.asarray(circle_poses(env.spec, points))[:, None]
        reached = jax.device_get(follow(policy, goals, start_keys(points)))
        found[name] = float(reached.tip_error_mm.mean())
    return found


def kind_of(arm: str) -> str:
    """Return the kind of an arm, one of `ARM_KINDS`.

    Raises:
        InputError: it is of none.
    """
    twin, rod, soromox = ARM_KINDS
    if arm == SOROMOX:
        return soromox
    if arm.startswith("twin:"):
        return rod if arm.startswith("twin:rod:") else twin
    raise InputError(f"--runs: got the arm {arm}, expected twin:SEED, twin:rod:SEED or {SOROMOX}")


def on_arm(run: Run, arm: str, points: int) -> float:
    """Return the mean error [mm] on the circle of the exported policy, on its arm.

    Raises:
        InputError: a goal was not measured.
    """
    soromox = ARMS[SOROMOX]
    name, python = (soromox.driver, soromox.python) if arm == SOROMOX else (arm, sys.executable)
    with tempfile.TemporaryDirectory() as folder:
        out, asked = Path(folder, "circle"), ("--points", points)
        told = accuracy_of(run.path / POLICY_FILE, name, out, *asked, python=python)
    if told["measured"] < points:
        raise InputError(f"--runs: {arm}={run.path}: got {told['measured']} of {points} goals, expected all")
    return told["translation_mm"]


def beside_soromox() -> dict[str, float]:
    """Return how far tips of rods and of SoRoMoX's arm with the same parts are apart [mm].

    Raises:
        InputError: the worker failed.
    """
    asked = "benchmarks.accuracy.soromox_arm", *map(str, BESIDE)
    command = [str(ARMS[SOROMOX].python), "-m", *asked]
    told = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True)
    if told.returncode:
        raise InputError(f"python -m {' '.join(asked)}: got exit status {told.returncode}, expected 0")
    apart_mm = json.loads(told.stdout)["apart_mm"]
    return {"poses": len(apart_mm), "mean [mm]": float(np.mean(apart_mm)), "largest [mm]": max(apart_mm)}


def means(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the mean over the runs that have a figure, by the simulation of the training."""
    columns = [name for name in rows[0] if name not in ("trained in", "arm")]
    found = []
    for (trained,), group in grouped(rows, ("trained in",)).items():
        known = {name: [row[name] for row in group if row[name] is not None] for name in columns}
        mean = {name: float(np.mean(values)) if values else None for name, values in known.items()}
        found.append({"trained in": trained, "runs": len(group), **mean})
    return found


def targets(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return a target for each simulation and kind of arm: its mean error over that in the training's.

    Both means are over the runs that have both figures.
    """
    found = []
    for (trained,), group in grouped(rows, ("trained in",)).items():
        for name in [*SIMULATIONS, *ARM_KINDS]:
            both = np.array([(row[name], row[trained]) for row in group if row.get(name) is not None])
            if name == trained or not len(both):
                continue
            value, own = both.mean(axis=0)
            text = f"{trained}: in {name} at most {TWICE:g} times as far off"
            found.append(target(text, f"{value:.2f} and {own:.2f} mm", bool(value <= TWICE * own)))
    return found
