"""Payloads of rods, arms of other physics, told from springs and pressures after a calibration.

A rod is recorded at random poses and calibrated. Then it is held at springs around the circle, with payloads
that nobody tells. The springs are those that the shipped policy asks the specified arm for. With a kilogram
some are out of reach, and the rod stays where its pressures end. The payload is told by generalised least
squares with the calibration's own covariances, as the deployed network learns to tell it. The residual
pressures are a line in the spring lengths, or the process of each section; the effect of a payload is the
simulated one, or is corrected by S2R.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.calibration.planning import log_at_rest
from benchmarks.harness.common import target
from calib.arm import CalibratedArm
from calib.fit.leastsquares import ridge
from calib.fit.payload import told_payload
from calib.fit.s2r import simulate_poses
from calib.read.logs import read_log
from calib.read.measurements import measure as measurements_of
from calib.run import calibrate
from mjx_softarm._support import cli, xla
from mjx_softarm.logs.schema import write_log
from mjx_softarm.mechanics.excitation import circle_poses, random_pressures
from mjx_softarm.policy.file import SHIPPED, load_policy
from mjx_softarm.policy.runtime import PolicyRunner, tip_pose
from mjx_softarm.sensing.load import QUANTILE
from mjx_softarm.spec import ARM_FILE, ArmSpec
from mjx_softarm.twin.instruments import S2R_SESSION
from mjx_softarm.twin.rod_twin import RodTwin

PAYLOADS_G = (0, 500, 1000)
N_ACTIONS = 5  # of the shipped policy towards each point
N_READINGS = 25  # averaged: half a second
CLOSE_M, MOST_KPA, N_STEPS = 2e-4, 15.0, 25  # of the search for pressures that hold springs


def measure(
    rods: cli.Integers = (0, 1, 2), poses: int = 500, points: int = 40, keep: cli.MaybePath = None
) -> dict[str, Any]:
    """How well is the payload of an arm of other physics told, and does its interval hold it?

    Args:
        rods: seeds of the rod twins
        poses: number of random poses of each calibration
        points: of the circle
        keep: folder for logs and calibrated arms, to go on with later; without one they are deleted
    """
    xla.enable_compilation_cache()
    springs_m = circle_springs(points)
    with tempfile.TemporaryDirectory() as folder:
        home = keep or Path(folder)
        rows = [row for seed in rods for row in _figures(seed, poses, springs_m, home)]
    return {"targets": targets(rows), "rods": rows}


def targets(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the targets of each way to tell payloads, over the rods."""
    found = []
    for way in dict.fromkeys(row["told by"] for row in rows):
        own = [row for row in rows if row["told by"] == way]
        held = np.mean([row["within the interval"] for row in own])
        found.append(target(f"{way}: 95 % of the intervals hold it", f"{held:.0%}", bool(held >= 0.95)))
        off_g = max(abs(row["told [g]"] - row["payload [g]"]) for row in own)
        found.append(target(f"{way}: within 60 g in the mean of a circle", f"{off_g:.0f} g", off_g <= 60.0))
    return found


def circle_springs(n: int) -> np.ndarray:
    """Return the springs (n, n_springs) [m] that the shipped policy asks for around the circle."""
    policy = load_policy(SHIPPED)
    goals, found = circle_poses(policy.spec, n).astype(float), []
    pose, runner = goals[-1], PolicyRunner(policy)
    for goal in goals:
        for _ in range(N_ACTIONS):
            spring_m = runner.act(pose, goal).length_m
            pose = np.asarray(tip_pose(policy, spring_m, policy.spec.mass.payload_kg)[0], float)
        found.append(spring_m)
    return np.array(found)


def _figures(seed: int, n_poses: int, springs_m: np.ndarray, home: Path) -> list[dict[str, Any]]:
    # Record and calibrate the rod.
    spec = ArmSpec.default()
    arm, folder = RodTwin(seed, spec, session=S2R_SESSION), home / f"rod{seed}-{n_poses}"
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "log.npz"
    if not log.exists():
        write_log(log, log_at_rest(arm, random_pressures(spec, n_poses, seed)))
    logs = [read_log(log, spec)[0]]
    if not (folder / ARM_FILE).exists():
        found = calibrate(logs, spec).arm
        found.write_models(folder)
        found.spec.to_toml(folder / ARM_FILE)
    calibrated = CalibratedArm.read(folder)
    spec = calibrated.spec
    poses = measurements_of(logs, spec).poses.with_lengths(spec)
    found = simulate_poses(spec, poses.spring_m)
    columns = found.spring_m, poses.pressure_kpa, found.pressure_kpa
    rows = tuple(np.asarray(values[found.valid], float) for values in columns)
    # Hold it around the circle with payloads, and tell them.
    figures = []
    for payload_g in PAYLOADS_G:
        arm = RodTwin(seed, payload_kg=1e-3 * payload_g)
        read_m, kpa = (
            np.array(x) for x in zip(*(hold(arm, spec, own_m) for own_m in springs_m), strict=True)
        )
        ways = {
            "line": told_by_line(spec, rows, read_m, kpa),
            "process": told_payload(calibrated._replace(s2r=None), read_m, kpa),
            "process and S2R": told_payload(calibrated, read_m, kpa),
        }
        for way, (told_kg, half_width_kg) in ways.items():
            off_g = 1e3 * told_kg - payload_g
            row = {
                "rod": seed,
                "told by": way,
                "payload [g]": payload_g,
                "told [g]": 1e3 * float(told_kg.mean()),
                "RMS error [g]": float(np.sqrt(np.mean(off_g**2))),
                "half-width [g]": 1e3 * float(half_width_kg.mean()),
                "within the interval": float(np.mean(np.abs(off_g) <= 1e3 * half_width_kg)),
            }
            print(row, flush=True)
            figures.append(row)
    return figures


def hold(arm: RodTwin, spec: ArmSpec, spring_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bring a rod to springs (n,) [m] as far as its pressures reach; return read springs and pressures.

    Quasi-Newton steps with Broyden's update.
    """
    low, high, n = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa, spec.n_chambers

    def at(kpa: np.ndarray) -> np.ndarray:
        arm.settle(np.clip(kpa, low, high))
        return spec.spring_sensor.lengths(arm.read_sensors()).length_m

    kpa = np.zeros(n)
    now_m = at(kpa)
    inverse = np.linalg.inv(np.stack([at(row) - now_m for row in np.eye(n)], axis=1))
    for _ in range(N_STEPS):
        off_m = spring_m - now_m
        change = np.clip(inverse @ off_m, -MOST_KPA, MOST_KPA)
        change = np.clip(kpa + change, low, high) - kpa
        if np.abs(off_m).max() < CLOSE_M or not change.any():
            break
        moved_m, kpa = at(kpa + change) - now_m, kpa + change
        now_m = now_m + moved_m
        scale = change @ inverse @ moved_m
        if scale != 0.0:
            inverse = inverse + np.outer(change - inverse @ moved_m, change @ inverse) / scale
    readings, pressures = zip(
        *((arm.read_sensors(), arm.pressures()) for _ in range(N_READINGS)), strict=True
    )
    return spec.spring_sensor.lengths(np.mean(readings, axis=0)).length_m, np.mean(pressures, axis=0)


def told_by_line(
    spec: ArmSpec, rows: tuple[np.ndarray, ...], spring_m: np.ndarray, kpa: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return payloads (m,) [kg] and half-widths, by residuals that are a line in the springs."""
    lengths_m, measured_kpa, simulated_kpa = rows
    slope, offset_kpa = ridge(lengths_m, measured_kpa - simulated_kpa, 1e-9)
    left = measured_kpa - simulated_kpa - lengths_m @ slope - offset_kpa
    largest_kg = spec.mass.largest_payload_kg
    arms = (spec.replace(mass={"payload_kg": kg}) for kg in (0.0, largest_kg))
    light, heavy = (simulate_poses(arm, spring_m).pressure_kpa for arm in arms)
    effect = (heavy - light) / largest_kg
    size = np.sum(effect**2, axis=1)
    told_kg = np.sum(effect * (kpa - light - spring_m @ slope - offset_kpa), axis=1) / size
    return told_kg, QUANTILE * float(np.sqrt(np.mean(left**2))) / np.sqrt(size)
