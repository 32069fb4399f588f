"""Steps of a calibration: each turns measurements and a specification into a better one and a section.

A step without data, or whose fit is worse on held-out data than its start, keeps the specification's values,
and warns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypedDict

import numpy as np

from calib.arm import CalibratedArm
from calib.changes import MIN_POSES as MIN_LATER
from calib.changes import fit_changes
from calib.fit.chambers import MIN_POSES, fit_chambers
from calib.fit.held_pressures import fit_held_pressures
from calib.fit.markers import MIN_MARKERS, marker_limits
from calib.fit.motion.actuators import fit_actuators
from calib.fit.motion.damping import PRIOR, find_stretches, fit_damping
from calib.fit.motion.shape import fit_shape
from calib.fit.motion.tracks import find_tracks
from calib.fit.payload import LEAST_WEIGHT, MIN_WEIGHED, held_at, payload_poses, told_widths, weighed
from calib.fit.s2r import fit_s2r, simulate_poses
from calib.fit.sensors import fit_springs
from calib.read.measurements import Measurements
from calib.read.static_poses import SAME_KG, StaticPoses
from calib.report import motion, sections
from calib.report.changes import CHANGES, PAYLOADS, changes_section, payloads_section
from calib.report.page import Section
from mjx_softarm.logs.pose_pairs import PosePairs
from mjx_softarm.logs.rest import MIN_HOLD_S
from mjx_softarm.sensing.held_pressures import HeldPressures
from mjx_softarm.sensing.load import KNOWN
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.sensing.s2r import S2R, correct, extrapolation
from mjx_softarm.spec import ArmSpec, Unmodelled

MIN_S2R_POSES = 60
NOT_FITTED = "Not fitted: the specification's values stay."


class Extras(TypedDict, total=False):
    """Results beside the specification. A step adds some; a later step may replace them."""

    s2r: S2R
    held: HeldPressures  # residual pressures of the unloaded arm
    pairs: Mapping[str, PosePairs]  # measured and simulated poses, without and with the network


class StepResult(NamedTuple):
    """Result of a step."""

    spec: ArmSpec  # arm with the numbers that the step fitted
    section: Section  # section of the report
    extras: Extras = Extras()


Step = Callable[[Measurements, ArmSpec, int], StepResult]


def springs(
    measurements: Measurements,
    spec: ArmSpec,
    seed: int,
    shared: bool = False,
    fit_compensation: bool = False,
) -> StepResult:
    """Fit beta and delta of the springs' sensors; options as in `calib.fit.sensors.fit_springs`."""
    pairs = [
        (readings, log.spring_m)
        for log in measurements.logs
        if (readings := log.readings_of(spec.sensor)) is not None and log.spring_m is not None
    ]
    if not pairs:
        needed = f"{NOT_FITTED} No log has both readings and measured spring lengths."
        remedy = "beta and delta are not this arm's: log readings beside spring lengths on a ruler"
        return StepResult(spec, Section("Springs", needed, warnings=(remedy,)))
    readings, length_m = (np.concatenate(x) for x in zip(*pairs, strict=True))
    fit = fit_springs(readings, length_m, spec.spring_sensor, fit_compensation, shared, seed=seed)
    # Put the fitted numbers into the specification, and show the residuals.
    sensor: dict[str, Any] = {"beta": tuple(map(float, fit.beta)), "delta_m": tuple(map(float, fit.delta_m))}
    if fit.compensation_h is not None:
        sensor["compensation_h"] = fit.compensation_h
    spec = spec.replace(sensor=sensor)
    calibrated = spec.spring_sensor.lengths(readings, np.nan)
    return StepResult(spec, sections.springs(fit, calibrated.length_m, length_m, spec.springs_per_section))


def chambers(measurements: Measurements, spec: ArmSpec, seed: int) -> StepResult:
    """Fit stiffness, area and length of the chambers, the backbone and the mounting to poses at rest."""
    n = measurements.poses.n
    if n < MIN_POSES:
        needed = f"{NOT_FITTED} {_few(MIN_POSES, 'pressures and tip poses', n, measurements.row_uses)}"
        remedy = f"stiffness, area and length are not this arm's: log {MIN_POSES} poses at rest or more"
        return StepResult(spec, Section("Chambers", needed, warnings=(remedy,)))
    fit = fit_chambers(measurements, spec, seed)
    section = sections.chambers(fit)
    # Check the chambers' lengths by markers along the arm.
    if fit.has_markers and fit.poses.marker_m.shape[1] >= MIN_MARKERS:
        section = sections.with_markers(section, marker_limits(fit.poses, fit.chamber_m, fit.spec))
    return StepResult(fit.spec if fit.is_better else spec, section)


def actuators(measurements: Measurements, spec: ArmSpec, seed: int) -> StepResult:
    """Fit pumps or regulators to commanded and measured pressures."""
    tracks = find_tracks(measurements.logs, spec)
    if not tracks:
        needed = "No log has commanded and measured pressures at the control rate."
        return StepResult(spec, Section("Actuators", f"{NOT_FITTED} {needed}"))
    fit = fit_actuators(tracks, spec, seed)
    return StepResult(fit.spec, motion.actuators(fit))


def damping(measurements: Measurements, spec: ArmSpec, seed: int) -> StepResult:
    """Fit the damping of chambers and backbone to the moving arm."""
    stretches = find_stretches(measurements.logs, spec)
    if not stretches:
        needed = "No log follows the moving arm; it decides how the arm swings, not where it rests."
        return StepResult(spec, Section("Damping", f"{NOT_FITTED} {needed}"))
    # The lag of the shape shows the backbone's damping by itself
    shape, prior = fit_shape(measurements.logs, spec), PRIOR
    if shape is not None and shape.is_better:
        spec, prior = shape.spec, min(shape.log_std, PRIOR)
    fit = fit_damping(stretches, spec, seed, prior)
    return StepResult(fit.spec if fit.is_better else spec, motion.damping(fit, shape))


def s2r(measurements: Measurements, spec: ArmSpec, seed: int) -> StepResult:
    """Fit the sim-to-real network, and the pressures that hold the arm, to poses of the unloaded arm."""
    # Settle the simulated arm at the spring lengths of these poses; with a payload its poses would differ.
    poses = measurements.poses.with_lengths(spec)
    used = _unloaded(poses, spec)
    simulated = simulate_poses(spec, poses.spring_m[used]) if len(used) else None
    n_settled = 0 if simulated is None else int(np.count_nonzero(simulated.valid))
    n_unsettled = len(used) - n_settled
    if simulated is None or n_settled < MIN_S2R_POSES:
        what = f"pressures, spring lengths and tip poses, a payload of {spec.mass.payload_kg:g} kg"
        uses = {**measurements.row_uses, "poses at which the simulated arm finds no rest": n_unsettled}
        needed = f"Not fitted: {_few(MIN_S2R_POSES, what, n_settled, uses)}"
        remedy = f"policies will be trained on simulated poses: log {MIN_S2R_POSES} poses at rest or more"
        return StepResult(spec, Section("Sim-to-real network", needed, warnings=(remedy,)))
    used, settled = used[simulated.valid], simulated.take(simulated.valid)
    real = pose_from_frame(poses.tip_m[used], poses.tip_rotation[used])
    # Fit the network from simulated to measured tips.
    fit = fit_s2r(spec, settled, real, seed)
    section = sections.s2r(fit, settled.pose, settled.spring_m, real, n_unsettled)
    corrected, away = (f(fit.s2r, settled.pose, settled.spring_m) for f in (correct, extrapolation))
    pairs = {
        "simulated": PosePairs(real, settled.pose, np.zeros(len(real), bool)),
        "with the network": PosePairs(real, corrected, away > 1.0),
    }
    # Fit the pressures that hold the arm.
    held = fit_held_pressures(spec, settled.spring_m, poses.pressure_kpa[used], settled.pressure_kpa, seed)
    extras = Extras(pairs=pairs)
    if fit.is_better:
        extras["s2r"] = fit.s2r
    if not held.is_better:
        return StepResult(spec, section, extras)
    extras["held"] = held.held
    spec = dataclasses.replace(spec, unmodelled=Unmodelled())  # which the process replaces
    largest_kg = spec.mass.largest_payload_kg
    at = payload_poses(CalibratedArm(spec, extras.get("s2r")))
    widths_kg = told_widths(held.held, at, largest_kg)
    section = sections.with_pressures(section, held, widths_kg, KNOWN * largest_kg)
    return StepResult(spec, section, extras)


def changes(measurements: Measurements, arm: CalibratedArm, seed: int) -> StepResult:
    """Fit what has changed since an arm's calibration to later poses of the unloaded arm."""
    spec, s2r, _ = arm
    poses = measurements.poses.with_lengths(spec)
    poses = poses.take(_unloaded(poses, spec))
    if poses.n < MIN_LATER:
        what = "pressures and spring lengths, without a payload"
        needed = f"{NOT_FITTED} {_few(MIN_LATER, what, poses.n, measurements.row_uses)}"
        remedy = f"what has changed is not known: measure {MIN_LATER} goals or more"
        return StepResult(spec, Section(CHANGES, needed, warnings=(remedy,)))
    found = fit_changes(arm, poses, seed)
    section = changes_section(found, 0.0 if s2r is None else float(s2r.error_mm))
    return StepResult(found.spec if found.is_better else spec, section)


def payloads(measurements: Measurements, arm: CalibratedArm, seed: int) -> StepResult:
    """Fit how strongly an arm feels payloads to later poses with a known weight."""
    spec, held = arm.spec, arm.held
    if held is None:
        remedy = f"no residual pressures: record {MIN_S2R_POSES} poses at rest or more, and calibrate anew"
        return StepResult(spec, Section(PAYLOADS, NOT_FITTED, warnings=(remedy,)))
    # Take heavy poses that the simulated arm holds.
    poses = measurements.poses.with_lengths(spec)
    poses = poses.take(np.flatnonzero(np.isfinite(poses.spring_m).all(axis=1)))
    least_kg = LEAST_WEIGHT * spec.mass.largest_payload_kg
    rows = np.flatnonzero(poses.payload_kg > spec.mass.payload_kg + least_kg - SAME_KG)
    if len(rows):
        rows = rows[held_at(arm, poses.spring_m[rows])[1]]
    if len(rows) < MIN_WEIGHED:
        what = f"pressures and spring lengths, {1e3 * least_kg:.0f} g or more on top of the arm's own payload"
        needed = f"{NOT_FITTED} {_few(MIN_WEIGHED, what, len(rows), measurements.row_uses)}"
        got = f"got {len(rows)} poses with {1e3 * least_kg:.0f} g or more, expected {MIN_WEIGHED}"
        remedy = "measure more goals with a known weight (`deploy measure --payload`)"
        return StepResult(spec, Section(PAYLOADS, needed, warnings=(f"{got}: {remedy}",)))
    # Fit them; a ratio that no arm has is not believed.
    found = weighed(arm, poses, rows)
    section = payloads_section(found)
    if not found.is_plausible:
        return StepResult(spec, section)
    known = held._replace(factor=found.factor, factor_sd=found.factor_sd)
    return StepResult(spec, section, Extras(held=known))


STEPS: Mapping[str, Step] = MappingProxyType(
    {
        "springs": springs,
        "chambers": chambers,
        "actuators": actuators,
        "damping": damping,
        "sim-to-real network": s2r,
    }
)


def _unloaded(poses: StaticPoses, spec: ArmSpec) -> np.ndarray:
    """Return the indices of the poses with spring lengths and no more than the specification's payload."""
    unloaded = np.isclose(poses.payload_kg, spec.mass.payload_kg, rtol=0.0, atol=SAME_KG)
    return np.flatnonzero(np.isfinite(poses.spring_m).all(axis=1) & unloaded)


def _few(n: int, what: str, n_found: int, row_uses: Mapping[str, int]) -> str:
    """Say which poses are needed, and what became of the rows of the logs."""
    uses = ", ".join(f"{count} {use}" for use, count in row_uses.items() if count)
    return (
        f"Got {n_found} poses at rest with {what}, expected {n} or more; pressures must have been held for "
        f"{MIN_HOLD_S:g} s. Rows of the logs: {uses or 'none with all of these columns'}."
    )
