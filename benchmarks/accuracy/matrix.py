"""Every simulation against every other: policies on the circle, in simulations that they did not learn in.

The first columns are simulations of the arm that a policy learned with, without the control loop: it goes to
each goal from a random pose of the workspace, and the tip is looked at after the last action. The other
columns are arms that no policy has seen, with the loop: that to which it is calibrated, of one of three
kinds. A policy of motion cannot be used at rest, where there are no rates to observe.
"""

from __future__ import annotations

import dataclasses
import itertools
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
from mjx_softarm._support import xla
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
# In motion, a policy trained at rest acts on an arm that has nearly come to rest, as in the loop
ACTIONS = {"pose": (4, 4.0), "payload": (4, 4.0), "motion": (12, 0.5)}  # number, and duration [s] in motion
ARM_KINDS = "C MuJoCo twin", "rod", "SoRoMoX"
SOROMOX = "soromox"  # arm of `benchmarks arms`
TWICE = 2.0  # target: error in any simulation, over that in the simulation of the training
N_POSES = 256  # of the pool of starts
BESIDE = 0, 20  # seed of the rod, and number of random pressures, for `beside_soromox`


def measure(runs: tuple[str, ...], points: int = 8) -> dict[str, Any]:
    """How exact are policies in the simulations, and on the arms, that they did not learn in?

    Args:
        runs: ARM=RUN of each, a trained and exported run that is calibrated to the arm: a twin such as
            twin:0, or soromox, the arm of `benchmarks arms`
        points: of the circle

    Raises:
        InputError: there are no runs, or a goal on an arm was not measured.
        RunError: a folder holds no finished run.
        PeerError: SoRoMoX could not be installed.
    """
    xla.enable_compilation_cache()
    rows = []
    for arm, folder in arms_and_files(runs):
        run = Run.open(Path(folder))
        row = {"trained in": trained_in(run.config.env), "arm": arm, **in_simulations(run, points)}
        rows.append(row | on_arm(run, arm, points))
        print(rows[-1], flush=True)
    return {
        "points": points,
        "means": means(rows),
        "targets": targets(rows),
        "rod beside SoRoMoX": beside_soromox(),
        "runs": rows,
    }


def trained_in(config: EnvConfig) -> str:
    """Return the name of a run's simulation, a key of `SIMULATIONS`.

    Its time step may differ.
    """
    alike = ((config.mode, config.engine) == (own["mode"], own["engine"]) for own in SIMULATIONS.values())
    return next(itertools.compress(SIMULATIONS, alike))


def in_simulations(run: Run, points: int) -> dict[str, float | None]:
    """Return the mean error [mm] on the circle in each simulation; None for one that a policy cannot see."""
    policy, found = run.policy(), dict[str, float | None]()
    n_actions, duration_s = ACTIONS[run.config.env.observation]
    for name, settings in SIMULATIONS.items():
        if run.config.env.observation == "motion" and settings["mode"] == "quasistatic":
            found[name] = None
            continue
        config = dataclasses.replace(run.config.env, n_poses=N_POSES, dynamic_step_s=duration_s, **settings)
        env = nominal(ReachEnv(run.spec, config, run.arm.s2r))
        learner = learner_of(run.config.learner, World(env, None, None))
        follow = xla.jit(jax.vmap(follower(env, learner, n_actions), in_axes=(None, 0, 0)))
        goals = np.asarray(circle_poses(env.spec, points))[:, None]
        reached = jax.device_get(follow(policy, goals, start_keys(points)))
        found[name] = float(reached.tip_error_mm.mean())
    return found


def on_arm(run: Run, arm: str, points: int) -> dict[str, float | None]:
    """Return the mean error [mm] on the circle of the exported policy, for the kind of its arm."""
    soromox = ARMS[SOROMOX]
    kind = ARM_KINDS[2 if arm == SOROMOX else 1 if ":rod:" in arm else 0]
    name, python = (soromox.driver, soromox.python) if arm == SOROMOX else (arm, sys.executable)
    with tempfile.TemporaryDirectory() as folder:
        told = accuracy_of(
            run.path / "policy.npz", name, Path(folder, "circle"), "--points", points, python=python
        )
    return dict.fromkeys(ARM_KINDS) | {kind: told["translation_mm"]}


def beside_soromox() -> dict[str, float]:
    """Return how far tips of rods and of SoRoMoX's arm with the same parts are apart [mm]."""
    asked = "benchmarks.accuracy.soromox_arm", *map(str, BESIDE)
    command = [str(ARMS[SOROMOX].python), "-m", *asked]
    told = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    apart_mm = json.loads(told.stdout)
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
    """Return the target of each simulation, beside the one that policies learned in."""
    found = []
    for mean in means(rows):
        own = mean[mean["trained in"]]
        for name, value in mean.items():
            if name in ("trained in", "runs", mean["trained in"]) or value is None:
                continue
            text = f"{mean['trained in']}: in {name} at most {TWICE:g} times as far off"
            found.append(target(text, f"{value:.2f} and {own:.2f} mm", value <= TWICE * own))
    return found
