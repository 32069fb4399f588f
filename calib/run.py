"""From logs to a calibrated arm: springs, then chambers, then damping, then the sim-to-real network.

Each step uses what the steps before it found, and says what it had to go by; a step without data leaves the
specification's values in force and says so. What comes out is a folder that training takes:

    arm.toml      the calibrated specification
    s2r.npz       the sim-to-real network, if there were poses to fit it to
    report.html   what was found, with pictures, and whether to trust it
    report.json   the same for programs
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib import parts
from calib.chambers import MIN_POSES, Poses, fit_chambers
from calib.logs import same_arm
from calib.report import Part, to_html, to_json
from calib.rest import rows_at_rest
from calib.s2r import fit_s2r, simulate_poses
from calib.sensors import fit_springs
from mjx_softarm.logs import Log
from mjx_softarm.pose import pose_from_frame, rotation_from_quaternion
from mjx_softarm.provenance import write_json
from mjx_softarm.s2r import S2R, save_s2r
from mjx_softarm.sensors import SensorParams, length_from_frequency
from mjx_softarm.spec import ArmSpec

ARM_FILE, S2R_FILE = "arm.toml", "s2r.npz"
NOT_FITTED = "Not fitted: the specification's values stay."


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A calibrated arm and the report on it."""

    spec: ArmSpec
    s2r: S2R | None
    parts: tuple[Part, ...]


def calibrate(
    logs: Sequence[Log], spec: ArmSpec, seed: int = 0, tell: Callable[[str], None] = lambda text: None
) -> Calibration:
    """Fit all that the logs allow.

    Args:
        logs: of one arm; see `calib.logs.read_log`.
        spec: what is believed of the arm so far.
        seed: of all that is drawn.
        tell: takes a line before each step.

    Raises:
        LogError: the logs are of different arms.
    """
    same_arm(logs)
    tell("springs ...")
    spec, springs = _springs(logs, spec, seed)
    poses = _poses(logs, spec)
    tell(f"chambers, {len(poses.tip_m)} poses at rest ...")
    spec, chambers = _chambers(poses, spec, seed)
    tell("sim-to-real network ...")
    s2r, network = _s2r(poses, spec, seed)
    return Calibration(spec, s2r, (springs, chambers, network))


def refuse_existing(folder: Path) -> None:
    """Nothing is overwritten.

    Raises:
        FileExistsError: the folder is there already and not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder}: is there already; choose another --out")


def write_calibration(
    folder: Path, calibration: Calibration, findings: Sequence[str], provenance: dict[str, Any]
) -> None:
    """Write the folder, whole or not at all.

    Raises:
        FileExistsError: the folder is there already and not empty.
        OSError: it cannot be written.
    """
    refuse_existing(folder)
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        calibration.spec.to_toml(part / ARM_FILE)
        if calibration.s2r is not None:
            save_s2r(part / S2R_FILE, calibration.s2r)
        report = (calibration.parts, findings, provenance)
        write_json(part / "report.json", to_json(*report))
        (part / "report.html").write_text(to_html(calibration.spec.name, *report), "utf-8")
        part.replace(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _springs(logs: Sequence[Log], spec: ArmSpec, seed: int) -> tuple[ArmSpec, Part]:
    pairs = [
        (log.frequency_hz, log.spring_m)
        for log in logs
        if log.frequency_hz is not None and log.spring_m is not None
    ]
    if not pairs:
        needed = f"{NOT_FITTED} No log has both frequencies and measured spring lengths."
        return spec, Part("Springs", needed, warnings=("beta and delta are not this arm's",))
    frequency_hz, length_m = (np.concatenate(x) for x in zip(*pairs, strict=True))
    fit = fit_springs(frequency_hz, length_m, SensorParams.from_spec(spec), seed=seed)
    sensor = {"beta": tuple(map(float, fit.beta)), "delta_m": tuple(map(float, fit.delta_m))}
    spec = spec.replace(sensor=sensor)
    calibrated = length_from_frequency(frequency_hz, SensorParams.from_spec(spec), np.nan)
    return spec, parts.springs(fit, calibrated.length_m, length_m)


def _poses(logs: Sequence[Log], spec: ArmSpec) -> Poses:
    """Poses at rest of all logs, in the order of the logs; what a log has not is NaN."""
    n, sensor = spec.n_chambers, SensorParams.from_spec(spec)
    found = [Poses(np.zeros((0, n)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, n)), np.zeros(0))]
    for log in logs:
        if log.tip_m is None or log.tip_quaternion is None:
            continue
        rest = log.take(rows_at_rest(log))
        none = np.full((len(rest), n), np.nan)
        spring_m = none
        if rest.frequency_hz is not None:
            spring_m = length_from_frequency(rest.frequency_hz, sensor, np.nan).length_m
        found.append(
            Poses(
                none if rest.pressure_kpa is None else rest.pressure_kpa,
                rest.tip_m,
                rotation_from_quaternion(rest.tip_quaternion),
                spring_m,
                np.full(len(rest), spec.mass.payload_kg) if rest.payload_kg is None else rest.payload_kg,
            )
        )
    return Poses(*(np.concatenate(x) for x in zip(*found, strict=True)))


def _chambers(poses: Poses, spec: ArmSpec, seed: int) -> tuple[ArmSpec, Part]:
    usable = poses.take(np.isfinite(poses.pressure_kpa).all(axis=1))
    if len(usable.tip_m) < MIN_POSES:
        needed = f"{NOT_FITTED} {_few(usable)} pressures and a tip."
        return spec, Part("Chambers", needed, warnings=("stiffness, area and length are not this arm's",))
    fit = fit_chambers(usable, spec, seed)
    return fit.spec, parts.chambers(fit)


def _s2r(poses: Poses, spec: ArmSpec, seed: int) -> tuple[S2R | None, Part]:
    """The network of the unloaded arm: with a payload, the simulation is another."""
    title = "Sim-to-real network"
    usable = poses.take(np.isfinite(poses.spring_m).all(axis=1) & (poses.payload_kg == spec.mass.payload_kg))
    if len(usable.tip_m) < MIN_POSES:
        needed = f"Not fitted: {_few(usable)} frequencies and a tip."
        return None, Part(title, needed, warnings=("policies will be trained on simulated poses",))
    simulated = simulate_poses(spec, usable.spring_m)
    real = pose_from_frame(usable.tip_m, usable.tip_rotation)
    valid = simulated.valid
    fit = fit_s2r(simulated.pose[valid], simulated.spring_m[valid], real[valid], seed)
    return fit.s2r, parts.s2r(fit, simulated.pose[valid], simulated.spring_m[valid], real[valid])


def _few(poses: Poses) -> str:
    return f"{MIN_POSES} poses at rest are needed, and {len(poses.tip_m)} have"
