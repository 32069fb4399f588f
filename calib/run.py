"""Calibration of an arm from its logs: springs, then chambers, then damping, then the sim-to-real network.

Each step uses the results of those before it. A step without data, or whose fit is worse on held-out data
than its start, keeps the specification's values, and warns. The result is a folder that training takes:

    arm.toml      the calibrated specification
    s2r.npz       the sim-to-real network, if there were poses to fit it to
    recorded.npz  the poses, for `python -m calib plan`
    report.html   results with pictures, and whether to trust them
    report.json   the same for programs
    poses.npz     measured and simulated poses that the network was fitted to, for the view
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from calib.fit.chambers import MIN_POSES, ChamberFit, calibrate_chambers
from calib.fit.held_pressures import HeldPressures, fit_held_pressures
from calib.fit.markers import MIN_MARKERS, marker_limits
from calib.fit.s2r import fit_s2r, simulate_poses
from calib.fit.sensors import fit_springs
from calib.fit.transients import calibrate_damping, find_stretches
from calib.plan import RECORDED_FILE, Recorded, save_recorded
from calib.read.logs import same_arm
from calib.read.static_poses import find_static_poses
from calib.report import sections
from calib.report.page import Section, to_html, to_json
from mjx_softarm._support.provenance import write_json
from mjx_softarm.logs.pose_pairs import PosePairs, write_pose_pairs
from mjx_softarm.logs.rest import MIN_HOLD_S
from mjx_softarm.logs.schema import Log
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.sensing.s2r import S2R, S2R_FILE, correct, extrapolation, save_s2r
from mjx_softarm.spec import ARM_FILE, ArmSpec

POSE_COLUMNS = ("pressure_kpa", "tip_m", "tip_quaternion")  # needed in a log of poses
MIN_S2R_POSES = 60
NOT_FITTED = "Not fitted: the specification's values stay."


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Calibrated arm, the poses that it was fitted to, and the sections of its report."""

    spec: ArmSpec
    s2r: S2R | None
    recorded: Recorded | None
    sections: tuple[Section, ...]
    poses: Mapping[str, PosePairs]  # measured and simulated, without and with the network


def calibrate(
    logs: Sequence[Log],
    spec: ArmSpec,
    seed: int = 0,
    spring_options: Mapping[str, bool] = MappingProxyType({}),
    progress: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Fit everything that the logs allow.

    Args:
        logs: logs of one arm, see `calib.read.logs.read_log`.
        spec: arm as believed so far.
        seed: seed of all random draws.
        spring_options: `shared` and `fit_compensation` of `calib.fit.sensors.fit_springs`.
        progress: called with a line of text before each step.

    Raises:
        LogError: the logs are of different arms.
        FitError: the logs do not allow a fit.
    """
    same_arm(logs)
    progress("springs ...")
    spec, springs = _springs(logs, spec, seed, spring_options)
    seen = [log for log in logs if not any(getattr(log, name) is None for name in POSE_COLUMNS)]
    progress("chambers ...")
    spec, chambers, recorded = _chambers(seen, spec, seed)
    progress("damping ...")
    spec, damping = _damping(seen, spec, seed)
    progress("sim-to-real network ...")
    last = _s2r(seen, spec, seed)
    if last.held is not None and last.held.is_better:
        spec = spec.replace(unmodelled=dataclasses.asdict(last.held.unmodelled))
    if recorded is not None and last.error_mm is not None:
        recorded = recorded._replace(error_mm=last.error_mm)
    return Calibration(spec, last.s2r, recorded, (springs, chambers, damping, last.section), last.pairs)


def refuse_existing(folder: Path) -> None:
    """Refuse to overwrite a folder.

    Raises:
        FileExistsError: the folder exists and is not empty, or is the current one.
    """
    if not folder.name or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise FileExistsError(f"--out: got {folder}, which is there already, expected a new folder")


def write_calibration(
    folder: Path, calibration: Calibration, findings: Sequence[str], provenance: dict[str, Any]
) -> None:
    """Write the folder, whole or not at all.

    Raises:
        FileExistsError: the folder exists and is not empty.
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
        if calibration.recorded is not None:
            save_recorded(part / RECORDED_FILE, calibration.recorded)
        if calibration.poses:
            write_pose_pairs(part, calibration.poses)
        report = (calibration.sections, findings, provenance)
        write_json(part / "report.json", to_json(*report))
        (part / "report.html").write_text(to_html(calibration.spec.name, *report), "utf-8")
        part.replace(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _springs(
    logs: Sequence[Log], spec: ArmSpec, seed: int, how: Mapping[str, bool]
) -> tuple[ArmSpec, Section]:
    pairs = [
        (readings, log.spring_m)
        for log in logs
        if (readings := log.readings_of(spec.sensor)) is not None and log.spring_m is not None
    ]
    if not pairs:
        needed = f"{NOT_FITTED} No log has both readings and measured spring lengths."
        remedy = "beta and delta are not this arm's: log readings beside spring lengths on a ruler"
        return spec, Section("Springs", needed, warnings=(remedy,))
    readings, length_m = (np.concatenate(x) for x in zip(*pairs, strict=True))
    fit = fit_springs(readings, length_m, spec.spring_sensor, seed=seed, **how)
    sensor: dict[str, Any] = {"beta": tuple(map(float, fit.beta)), "delta_m": tuple(map(float, fit.delta_m))}
    if fit.compensation_h is not None:
        sensor["compensation_h"] = fit.compensation_h
    spec = spec.replace(sensor=sensor)
    calibrated = spec.spring_sensor.lengths(readings, np.nan)
    return spec, sections.springs(fit, calibrated.length_m, length_m)


def _chambers(logs: Sequence[Log], spec: ArmSpec, seed: int) -> tuple[ArmSpec, Section, Recorded | None]:
    poses, rows = find_static_poses(logs, spec)
    if poses.n < MIN_POSES:
        needed = f"{NOT_FITTED} {_few(MIN_POSES, 'pressures and tip poses', poses.n, rows)}"
        remedy = f"stiffness, area and length are not this arm's: log {MIN_POSES} poses at rest or more"
        return spec, Section("Chambers", needed, warnings=(remedy,)), None
    fit = calibrate_chambers(logs, spec, seed)
    section = sections.chambers(fit)
    if fit.has_markers and fit.poses.marker_m.shape[1] >= MIN_MARKERS:
        section = sections.with_markers(section, marker_limits(fit.poses, fit.chamber_m, fit.spec))
    return fit.spec if fit.is_better else spec, section, _recorded(fit)


def _recorded(fit: ChamberFit) -> Recorded:
    known = np.isfinite(fit.tip_error_mm)
    error_mm = np.where(known, fit.tip_error_mm, np.mean(fit.tip_error_mm[known]))
    return Recorded(fit.poses.pressure_kpa, fit.poses.payload_kg, error_mm, fit.scale)


def _damping(logs: Sequence[Log], spec: ArmSpec, seed: int) -> tuple[ArmSpec, Section]:
    if not find_stretches(logs, spec):
        needed = "No log follows the moving arm; it decides how the arm swings, not where it rests."
        return spec, Section("Damping", f"{NOT_FITTED} {needed}")
    fit = calibrate_damping(logs, spec, seed)
    return fit.spec if fit.is_better else spec, sections.damping(fit)


class _Unloaded(NamedTuple):
    """Fits to the poses of the unloaded arm."""

    s2r: S2R | None
    section: Section
    error_mm: np.ndarray | None = None  # of the network at each pose of the logs; not held out: the mean
    pairs: Mapping[str, PosePairs] = MappingProxyType(
        {}
    )  # measured poses beside simulated ones, without and with the network
    held: HeldPressures | None = None


def _s2r(logs: Sequence[Log], spec: ArmSpec, seed: int) -> _Unloaded:
    """Fit the network, and the pressures, of the unloaded arm: with a payload, the simulation differs."""
    poses, rows = find_static_poses(logs, spec)
    unloaded = np.isclose(poses.payload_kg, spec.mass.payload_kg, rtol=0.0, atol=1e-6)
    used = np.flatnonzero(np.isfinite(poses.spring_m).all(axis=1) & unloaded)
    n_poses, poses = poses.n, poses.take(used)
    simulated = simulate_poses(spec, poses.spring_m) if poses.n else None
    n_settled = 0 if simulated is None else int(np.count_nonzero(simulated.valid))
    if simulated is None or n_settled < MIN_S2R_POSES:
        what = f"pressures, spring lengths and tip poses, a payload of {spec.mass.payload_kg:g} kg"
        rows |= {"poses at which the simulated arm finds no rest": poses.n - n_settled}
        needed = f"Not fitted: {_few(MIN_S2R_POSES, what, n_settled, rows)}"
        remedy = f"policies will be trained on simulated poses: log {MIN_S2R_POSES} poses at rest or more"
        return _Unloaded(None, Section("Sim-to-real network", needed, warnings=(remedy,)))
    real = pose_from_frame(poses.tip_m, poses.tip_rotation)
    settled, real = simulated.take(simulated.valid), real[simulated.valid]
    pose, spring_m = settled.pose, settled.spring_m
    fit = fit_s2r(spec, settled, real, seed)
    away, never = extrapolation(fit.s2r, pose, spring_m), np.zeros(len(pose), bool)
    corrected = PosePairs(real, correct(fit.s2r, pose, spring_m), away > 1.0)
    pairs = {"simulated": PosePairs(real, pose, never), "with the network": corrected}
    error_mm = np.full(n_poses, fit.test.translation_mean_mm)
    error_mm[used[simulated.valid][fit.held_out]] = corrected.error_mm[fit.held_out]
    held = fit_held_pressures(spec, spring_m, poses.pressure_kpa[simulated.valid], settled.pressure_kpa, seed)
    section = sections.with_pressures(sections.s2r(fit, pose, spring_m, real, poses.n - n_settled), held)
    return _Unloaded(fit.s2r if fit.is_better else None, section, error_mm, pairs, held)


def _few(n: int, what: str, n_found: int, rows: Mapping[str, int]) -> str:
    """Say which poses are needed, and what became of the rows of the logs."""
    row_uses = ", ".join(f"{count} {use}" for use, count in rows.items() if count)
    return (
        f"Got {n_found} poses at rest with {what}, expected {n} or more; pressures must have been held for "
        f"{MIN_HOLD_S:g} s. Rows of the logs: {row_uses or 'none with all of these columns'}."
    )
