"""Environment steps a second in motion, of this project's time step and of `mjx.step`, with their errors.

An environment step is half a second of one arm. The error is the tip's distance from C MuJoCo's at the start
of each control period, over four random actions from rest. Both engines take the same arms and actions.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from benchmarks.harness.rounds import Facts, Worker, take_turns
from benchmarks.speed.motion_worker import N_ARMS
from benchmarks.speed.truth import QUANTILES
from mjx_softarm import control
from mjx_softarm.mechanics.mjcf import build_model, chamber_lengths, spring_lengths
from mjx_softarm.spec import ArmSpec

N_ROUNDS = 3
TRUE_STEP_S = 2.5e-4
# Longest stable steps of both, and the step at which `mjx.step` is as accurate as this project's at 20 ms
ENGINES = (("chain", 20.0), ("mjx", 20.0), ("mjx", 2.0))
LINKS = (2, 4)


def measure() -> dict[str, Any]:
    """How fast and how exact are this project's time step and MJX's own?"""
    points = {f"{engine}, {ms:g} ms, {n} links": (engine, ms, n) for n in LINKS for engine, ms in ENGINES}
    workers = [
        Worker(name, ["benchmarks.speed.motion_worker", *map(str, point)]) for name, point in points.items()
    ]
    rounds, failed = take_turns(workers, N_ROUNDS)
    rows = []
    for worker in workers:
        engine, step_ms, links = points[worker.name]
        row = {"engine": engine, "step_ms": step_ms, "links_per_section": links}
        if worker.name in failed:
            rows.append({**row, "failed": failed[worker.name]})
            continue
        rate = float(np.median([facts["env_steps_per_s"] for facts in rounds[worker.name]]))
        row |= {name: worker.facts[name] for name in ("tracing_s", "compiling_s")}
        rows.append({**row, "env_steps_per_s": round(rate), **path_error(links, worker.facts)})
    return {"arms": N_ARMS, "rounds": N_ROUNDS, "true_step_ms": 1e3 * TRUE_STEP_S, "engines": rows}


def path_error(links: int, told: Facts) -> dict[str, float]:
    """Return median, 95 % and largest distance of told paths from C MuJoCo's, without their common start."""
    spec = ArmSpec.default().replace(structure={"links_per_section": links})
    starts = zip(*(np.array(told[name]) for name in ("q", "pressure_kpa", "reference_m")), strict=True)
    path_mm = np.array(told["path_mm"])  # (arms, periods, 3)
    n_periods = path_mm.shape[1] // len(told["reference_m"][0])
    true_mm = np.array(
        [true_path_mm(spec, q, kpa, np.repeat(asked, n_periods, axis=0)) for q, kpa, asked in starts]
    )
    error = np.linalg.norm(path_mm - true_mm, axis=-1)[:, 1:]
    return {name: float(f"{np.quantile(error, share):.3g}") for name, share in QUANTILES.items()}


def true_path_mm(
    spec: ArmSpec, q: np.ndarray, pressure_kpa: np.ndarray, reference_m: np.ndarray
) -> np.ndarray:
    """Return tips (t, 3) [mm] of C MuJoCo at the start of each control period.

    Args:
        spec: the arm.
        q (nv,) [m, rad, rad]: joint coordinates at the start, at rest.
        pressure_kpa (n_chambers,): pressures that hold the arm there.
        reference_m (t, n_springs): spring lengths that the law tracks in each control period.
    """
    # The arm at rest, its chambers filled
    model, gains, period_s = build_model(spec), control.Gains.from_spec(spec), 1.0 / spec.control.rate_hz
    model.opt.timestep, model.actuator_ctrllimited[:] = TRUE_STEP_S, 0
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_step1(model, data)
    n = spec.n_chambers
    air = spec.pneumatics(chamber_lengths(data, n), TRUE_STEP_S)
    air.hold(pressure_kpa, chamber_lengths(data, n))

    # The law at the control rate, MuJoCo's time steps between
    law, tips = control.LawState.at_rest(pressure_kpa, spring_lengths(data, n).copy()), []
    for reference in reference_m:
        tips.append(1e3 * data.site("tip").xpos)
        command, law = control.pressures(reference, spring_lengths(data, n).copy(), law, gains, period_s)
        air.command(command)
        for _ in range(round(period_s / TRUE_STEP_S)):
            data.ctrl[:] = air.step(chamber_lengths(data, n))
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
    return np.array(tips)
