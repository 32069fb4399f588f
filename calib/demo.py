"""Logs of a simulated arm with known parameters, to try the calibration without hardware.

The planted arm differs from the specification in numbers that the calibration fits: beta and delta of the
springs; stiffness, area and length of the chambers; bending stiffness; damping. It also differs in the sites
of chambers and springs, and has finer links: this is left to the sim-to-real network.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjx_softarm._support.fields import scaled
from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.mjcf import build_model, spring_lengths, steps_per_period
from mjx_softarm.mechanics.workspace import settle_many
from mjx_softarm.sensing.pose import rotation_from_quaternion
from mjx_softarm.spec import ArmSpec

N_LENGTHS = 60  # lengths of each spring on the ruler
N_POSES = 1200
POSE_S = 5.0  # time from pose to pose
N_STEPS = 12  # steps of the pressures
STEP_S = 4.0
RULER_NOISE_M = 3e-4
READING_NOISE_M = 1e-4  # noise of a reading, as a length of its spring
TIP_NOISE_M = 3e-4
TURN_NOISE_RAD = 2e-3
PRESSURE_NOISE_KPA = 0.05
MARKERS_PER_SECTION = 3


def planted_arm(spec: ArmSpec, seed: int) -> ArmSpec:
    """Return the arm of the logs."""
    rng = np.random.default_rng(seed)

    def each(values: tuple[float, ...] | np.ndarray, spread: float) -> tuple[float, ...]:
        return tuple(np.array(values) * (1.0 + rng.uniform(-spread, spread, len(values))))

    # Draw numbers that the calibration fits; turn and shift sites, which it does not fit.
    chambers, geometry, backbone = spec.chambers, spec.geometry, spec.backbone
    sensor, first_deg = spec.spring_sensor, np.add(geometry.first_chamber_deg, 1.5)
    offset_m = spec.per_chamber(chambers.length_offset_m) + rng.uniform(-4e-3, 4e-3, spec.n_chambers)
    delta_m = sensor.delta_m + rng.uniform(-5e-3, 5e-3, spec.n_springs)
    return spec.replace(
        name=f"{spec.name} planted {seed}",
        structure={"links_per_section": spec.structure.links_per_section + 2},
        geometry={
            "chamber_radius_m": scaled(geometry.chamber_radius_m, 1.02),
            "spring_radius_m": scaled(geometry.spring_radius_m, 0.99),
            "first_chamber_deg": first_deg.tolist(),
        },
        backbone={"bending_stiffness_nm_per_rad": scaled(backbone.bending_stiffness_nm_per_rad, 1.1)},
        chambers={
            "area_m2": each(spec.per_chamber(chambers.area_m2), 0.08),
            "stiffness_n_per_m": each(spec.per_chamber(chambers.stiffness_n_per_m), 0.2),
            "length_offset_m": tuple(offset_m),
            "damping_ns_per_m": scaled(chambers.damping_ns_per_m, 1.5),
        },
        sensor={"beta": each(np.asarray(sensor.beta), 0.05), "delta_m": tuple(delta_m)},
    )


def write_demo(folder: Path, spec: ArmSpec, seed: int) -> list[Path]:
    """Write a complete set of logs, and return their files.

    `springs.csv`: each spring on a ruler. `poses.csv`: the arm at rest at random pressures.
    `steps.csv`: the arm after steps of the pressures, at the control rate.

    Args:
        folder: folder to write, created if it does not exist.
        spec: arm as the user believes it to be.
        seed: seed of the planted arm, the pressures and the noise.
    """
    folder.mkdir(parents=True, exist_ok=True)
    planted, rng = planted_arm(spec, seed), np.random.default_rng([seed, 1])
    makers = {"springs.csv": _springs, "poses.csv": _poses, "steps.csv": _steps}
    logs = {name: make(planted, rng) for name, make in makers.items()}
    for name, log in logs.items():
        write_log(folder / name, log)
    return [folder / name for name in logs]


def _springs(arm: ArmSpec, rng: np.random.Generator) -> Log:
    low, high = map(arm.at_springs, (arm.springs.length_min_m, arm.springs.length_max_m))
    length_m = np.linspace(low, high, N_LENGTHS)
    return Log(
        **_rows(2.0 * np.arange(N_LENGTHS)),
        readings=_readings(arm, length_m, rng),
        spring_m=length_m + RULER_NOISE_M * rng.normal(size=length_m.shape),
    )


def _poses(arm: ArmSpec, rng: np.random.Generator) -> Log:
    pressure_kpa = random_pressures(arm, N_POSES, rng)
    model = build_model(arm)
    data, settled = mujoco.MjData(model), settle_many(arm, pressure_kpa)
    seen = [_look(arm, model, data, q) for q in settled.q[settled.settled]]
    pressure_kpa = np.asarray(settled.pressure_kpa)[settled.settled]
    return _measured(arm, POSE_S * np.arange(len(seen)), pressure_kpa, seen, rng)


def _steps(arm: ArmSpec, rng: np.random.Generator) -> Log:
    """Simulate steps of the pressures with C MuJoCo."""
    low, high = arm.chambers.pressure_min_kpa, arm.chambers.pressure_max_kpa
    model, period_s = build_model(arm), 1.0 / arm.control.rate_hz
    data = mujoco.MjData(model)
    targets = rng.uniform(0.8 * low, 0.8 * high, (N_STEPS, arm.n_chambers))
    pressure_kpa, seen = np.repeat(targets, round(STEP_S / period_s), axis=0), []
    data.qpos[:] = settle_many(arm, targets[-1:]).q[0]
    for row in pressure_kpa:
        seen.append(_look(arm, model, data, data.qpos))
        data.ctrl[:] = row
        mujoco.mj_step(model, data, steps_per_period(period_s))
    return _measured(arm, period_s * np.arange(len(seen)), pressure_kpa, seen, rng)


def _look(
    arm: ArmSpec, model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return spring lengths (n,), tip (3,), its rotation (3, 3) and markers (n_markers, 3), without noise."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_tendon(model, data)
    tip = data.site("tip")
    # A marker at the first spring of each section, at its thirds, from base to tip
    n_links = arm.structure.links_per_section
    marker_m = []
    for section in range(arm.structure.n_sections):
        for third in range(1, MARKERS_PER_SECTION + 1):
            plate = section * n_links + round(third * n_links / MARKERS_PER_SECTION)
            marker_m.append(data.site(f"spring{arm.springs_per_section * section}_plate{plate}").xpos)
    spring_m = spring_lengths(data, arm.n_chambers, arm.n_springs).copy()
    return spring_m, tip.xpos.copy(), tip.xmat.reshape(3, 3).copy(), np.stack(marker_m)


def _measured(
    arm: ArmSpec, time_s: np.ndarray, pressure_kpa: np.ndarray, seen: list, rng: np.random.Generator
) -> Log:
    """Return a log of the measured quantities, with noise."""
    spring_m, tip_m, rotation, marker_m = map(np.stack, zip(*seen, strict=True))
    turn = rng.normal(scale=0.5 * TURN_NOISE_RAD, size=(len(seen), 3))
    small = np.column_stack([np.ones(len(seen)), turn])  # quaternion of a small turn
    quaternion = np.empty((len(seen), 4))
    for k, matrix in enumerate(rotation_from_quaternion(small) @ rotation):
        mujoco.mju_mat2Quat(quaternion[k], matrix.ravel())
    return Log(
        **_rows(time_s),
        readings=_readings(arm, spring_m, rng),
        pressure_kpa=pressure_kpa + rng.normal(scale=PRESSURE_NOISE_KPA, size=pressure_kpa.shape),
        tip_m=tip_m + rng.normal(scale=TIP_NOISE_M, size=tip_m.shape),
        tip_quaternion=quaternion,
        marker_m=marker_m + rng.normal(scale=TIP_NOISE_M, size=marker_m.shape),
        payload_kg=np.zeros(len(seen)),
    )


def _rows(time_s: np.ndarray) -> dict[str, Any]:
    return {"source": "demo", "row": np.arange(len(time_s)) + 2, "time_s": time_s}


def _readings(arm: ArmSpec, length_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy_m = length_m + rng.normal(scale=READING_NOISE_M, size=length_m.shape)
    return arm.spring_sensor.readings(noisy_m)
