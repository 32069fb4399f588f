"""Calibrations of a rod, an arm of other physics, by random poses and by planned ones.

Both calibrations of an arm share their first poses, which are random. The others are random, or chosen by
`calib.plan` from the calibration by the first ones. S2R is judged on random poses that neither has seen.
Rods are logged at rest, without the motion from pose to pose.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.fit.pose_errors import pose_errors
from calib.fit.s2r import simulate_poses
from calib.plan import plan
from calib.read.static_poses import find_static_poses
from calib.run import Calibration, calibrate
from mjx_softarm._support import cli, xla
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.sensing.s2r import correct
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin.instruments import S2R_SESSION
from mjx_softarm.twin.rod_twin import RodTwin

N_FRAMES = 50  # averaged frames: a second
TEST_SEED = 77


def measure(
    rods: cli.Integers = (0, 1), poses: int = 500, first: int = 100, tests: int = 300
) -> dict[str, Any]:
    """Do planned poses calibrate an arm better than random ones?

    Args:
        rods: seeds of the rod twins
        poses: number of poses of each calibration
        first: number of random poses that both begin with
        tests: number of random poses that judge
    """
    xla.enable_compilation_cache()
    return {f"rod {seed}": _compare(seed, poses, first, tests) for seed in rods}


def _compare(seed: int, poses: int, first: int, tests: int) -> dict[str, Any]:
    # The rod, and random poses that judge.
    spec = ArmSpec.default()
    arm = RodTwin(seed, spec, session=S2R_SESSION)
    judge = log_at_rest(arm, random_pressures(spec, tests, TEST_SEED))
    # By random poses.
    pressure_kpa = random_pressures(spec, poses, seed)
    random = _figures(calibrate([log_at_rest(arm, pressure_kpa)], spec), judge)
    print(f"rod {seed}: random {random}", flush=True)
    # By the first of them, and planned ones.
    logs = [log_at_rest(arm, pressure_kpa[:first])]
    known = calibrate(logs, spec)
    assert known.recorded is not None  # as there are poses
    logs.append(
        log_at_rest(arm, plan(known.spec, known.recorded, poses - first, seed, known.held).pressure_kpa)
    )
    return {"random": random, "planned": _figures(calibrate(logs, spec), judge)}


def log_at_rest(arm: RodTwin, pressure_kpa: np.ndarray) -> Log:
    """Return a log of an arm at rest at pressures (n, n_chambers), each row the mean of a second."""
    rows: list[dict[str, np.ndarray]] = []
    for pressure in pressure_kpa:
        arm.settle(pressure)
        frames = [arm.motion_capture() for _ in range(N_FRAMES)]
        quaternion = np.array([frame.tip_quaternion for frame in frames])
        quaternion = (quaternion * np.sign(quaternion @ quaternion[0])[:, None]).mean(axis=0)
        rows.append(
            {
                "readings": np.mean([arm.read_sensors() for _ in frames], axis=0),
                "pressure_kpa": np.mean([arm.pressures() for _ in frames], axis=0),
                "tip_m": np.mean([frame.tip_m for frame in frames], axis=0),
                "tip_quaternion": quaternion / np.linalg.norm(quaternion),
                "spring_m": np.mean(np.array([frame.spring_m for frame in frames], float), axis=0),
                "marker_m": np.mean(np.array([frame.marker_m for frame in frames], float), axis=0),
            }
        )
    n = len(pressure_kpa)
    columns: Any = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    kg = np.zeros(n)
    return Log(source="rod", row=np.arange(n) + 2, time_s=5.0 * np.arange(n), payload_kg=kg, **columns)


def _figures(calibration: Calibration, judge: Log) -> dict[str, Any]:
    """Return figures of a calibration's report, and the errors of S2R at poses that it has not seen."""
    # Simulate the poses that judge, and correct them by the network.
    spec = calibration.spec
    parts = {section.title: section for section in calibration.sections}
    chambers, network = parts["Chambers"].data, parts["Sim-to-real network"].data
    poses = find_static_poses([judge], spec)[0].with_lengths(spec)
    simulated = simulate_poses(spec, poses.spring_m)
    real = pose_from_frame(poses.tip_m, poses.tip_rotation)
    pose, spring_m, real = (x[simulated.valid] for x in (simulated.pose, simulated.spring_m, real))
    corrected = pose if calibration.s2r is None else correct(calibration.s2r, pose, spring_m)
    # Compare both with the measured poses.
    before, after = pose_errors(pose, real), pose_errors(corrected, real)
    return {
        "unknown directions": len(chambers["weak"]),
        "least known direction [tolerances]": float(np.max(chambers["direction_widths"])),
        "S2R, its training [mm]": network["in_sample"]["translation_mean_mm"],
        "S2R, its held-out poses [mm]": network["test"]["translation_mean_mm"],
        "without S2R, random poses [mm]": before.translation_mean_mm,
        "S2R, random poses [mm]": after.translation_mean_mm,
        "warnings": sum(len(section.warnings) for section in calibration.sections),
    }
