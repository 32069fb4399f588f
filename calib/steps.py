"""Steps of a calibration: each turns measurements and an arm into a better arm and a section of the report.

A step without data, or whose fit is worse on held-out data than its start, keeps the specification's values,
and warns.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from calib.arm import CalibratedArm
from calib.changes import MIN_POSES as MIN_LATER
from calib.changes import fit_changes
from calib.fit.chambers import MIN_POSES, fit_chambers
from calib.fit.held_pressures import fit_held_pressures
from calib.fit.motion.actuators import MEASURED, ArmLag, fit_actuators
from calib.fit.motion.damping import PRIOR, find_stretches, fit_damping
from calib.fit.motion.shape import fit_shape
from calib.fit.motion.tracks import find_tracks
from calib.fit.payload import (
    LEAST_WEIGHT,
    MIN_WEIGHED,
    fit_payload_scale,
    held_at,
    payload_intervals,
    payload_poses,
)
from calib.fit.s2r import fit_s2r, simulate_poses
from calib.fit.springs import fit_springs
from calib.read.measurements import Measurements
from calib.read.static_poses import SAME_KG, StaticPoses
from calib.report import sections
from calib.report.page import Section
from mjx_softarm.logs.rest import MIN_HOLD_S
from mjx_softarm.sensing.held_pressures import residual
from mjx_softarm.sensing.load import KNOWN
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.spec import ArmSpec, Unmodelled

# Least number of poses of a network. From 49 poses of a rod it brought held-out tips from 10.4 to 2.6 mm.
MIN_S2R_POSES = 40


class StepResult(NamedTuple):
    """Result of a step."""

    arm: CalibratedArm  # with the numbers and models that the step fitted
    section: Section  # section of the report


Step = Callable[[Measurements, CalibratedArm, int], StepResult]


def _not_fitted(
    arm: CalibratedArm, title: str, why: str, *warnings: str, notes: tuple[str, ...] = ()
) -> StepResult:
    """Return the result of a step without enough data."""
    text = f"Not fitted. {why}"
    return StepResult(arm, Section(title, text, warnings=warnings, notes=notes))


def _few(n_found: int, n: int, what: str, row_uses: Mapping[str, int]) -> str:
    """Say which poses are needed, and what became of the rows of the logs."""
    uses = ", ".join(f"{count} {use}" for use, count in row_uses.items() if count)
    return (
        f"Got {n_found} poses at rest with {what}, expected {n} or more; pressures must have been held for "
        f"{MIN_HOLD_S:g} s. Rows of the logs: {uses or 'none with all of these columns'}."
    )


def _unloaded(measurements: Measurements, spec: ArmSpec) -> StaticPoses:
    """Return the poses with spring lengths and no more than the specification's payload."""
    poses = measurements.poses.with_lengths(spec)
    unloaded = np.isclose(poses.payload_kg, spec.mass.payload_kg, rtol=0.0, atol=SAME_KG)
    return poses.take(np.isfinite(poses.spring_m).all(axis=1) & unloaded)


def springs(measurements: Measurements, arm: CalibratedArm, seed: int) -> StepResult:
    """Fit beta and delta of the springs' sensors."""
    spec = arm.spec
    pairs = [
        (log.readings, log.spring_m)
        for log in measurements.logs
        if log.readings is not None and log.spring_m is not None
    ]
    if not pairs:
        needed = "No log has both readings and measured spring lengths."
        remedy = "beta and delta are not this arm's: log readings beside spring lengths on a ruler"
        return _not_fitted(arm, "Springs", needed, remedy)
    readings, length_m = (np.concatenate(x) for x in zip(*pairs, strict=True))
    fit = fit_springs(readings, length_m, spec.spring_sensor, seed)
    # Put the fitted numbers into the specification, and show the residuals.
    spec = spec.replace(sensor={"beta": tuple(fit.slope.tolist()), "delta_m": tuple(fit.offset.tolist())})
    calibrated = spec.spring_sensor.lengths(readings, np.nan)
    section = sections.springs(fit, calibrated.length_m, length_m, spec.springs_per_section)
    return StepResult(arm._replace(spec=spec), section)


def chambers(measurements: Measurements, arm: CalibratedArm, seed: int) -> StepResult:
    """Fit stiffness, area and length of the chambers, the backbone and the mounting to poses at rest."""
    n = measurements.poses.n
    if n < MIN_POSES:
        few = _few(n, MIN_POSES, "pressures and tip poses", measurements.row_uses)
        remedy = f"stiffness, area and length are not this arm's: log {MIN_POSES} poses at rest or more"
        return _not_fitted(arm, "Chambers", few, remedy)
    fit = fit_chambers(measurements, arm.spec, seed)
    return StepResult(arm._replace(spec=fit.spec) if fit.is_better else arm, sections.chambers(fit))


def actuators(measurements: Measurements, arm: CalibratedArm, seed: int) -> StepResult:
    """Fit pumps or regulators to commanded and measured pressures, or to commands and springs."""
    spec = arm.spec
    tracks, lag = find_tracks(measurements.logs, spec), MEASURED
    if not tracks and _unloaded(measurements, spec).n >= MIN_POSES:
        # No pressure was measured: the springs are the gauge, and the shape shows the arm's own lag
        tracks = find_tracks(measurements.logs, spec, functools.partial(pressures_by_springs, arm))
        shape = fit_shape(measurements.logs, arm) if tracks else None
        known = spec.shape_lag_s, PRIOR
        if shape is not None and shape.is_known:
            known = shape.lag_s, shape.log_std
        lag = ArmLag.of_shape(*known)
    if not tracks:
        needed = "No log has commands and pressures, or commands and springs, at the control rate."
        cost = (
            "how fast pumps or regulators follow is not known. With slow ones a goal that moves is missed by "
            "up to 10 mm: `deploy record` logs what shows it"
        )
        return _not_fitted(arm, "Actuators", needed, notes=(cost,))
    fit = fit_actuators(tracks, spec, seed, lag)
    return StepResult(arm._replace(spec=fit.spec), sections.actuators(fit))


def pressures_by_springs(arm: CalibratedArm, spring_m: np.ndarray) -> np.ndarray:
    """Return the pressures (n, c) [kPa] that hold an arm at rest at its spring lengths (n, n_springs) [m]."""
    kpa = np.asarray(simulate_poses(arm.spec, spring_m).pressure_kpa, float)
    return kpa if arm.held is None else kpa + residual(arm.held, spring_m, kpa).mean_kpa.reshape(kpa.shape)


def damping(measurements: Measurements, arm: CalibratedArm, seed: int) -> StepResult:
    """Fit the damping of chambers and backbone to the moving arm."""
    spec = arm.spec
    stretches = find_stretches(measurements.logs, spec)
    if not stretches:
        needed = "No log follows the moving arm; it decides how the arm swings, not where it rests."
        return _not_fitted(arm, "Damping", needed)
    # The lag of the shape shows the backbone's damping by itself, if it is known well
    shape, bending = fit_shape(measurements.logs, arm), None
    if shape is not None and shape.is_known:
        spec, bending = shape.spec, shape.half_width_s / shape.lag_s
    fit = fit_damping(stretches, spec, seed, bending)
    return StepResult(arm._replace(spec=fit.spec if fit.is_better else spec), sections.damping(fit, shape))


def s2r(measurements: Measurements, arm: CalibratedArm, seed: int, printed: bool = False) -> StepResult:
    """Fit the sim-to-real network, and the pressures that hold the arm, to poses of the unloaded arm.

    With `printed` the network is the paper's, and the section shows the process beside it.
    """
    spec = arm.spec
    # Settle the simulated arm at the lengths of the unloaded arm; a payload would move the tip
    poses = _unloaded(measurements, spec)
    n_unsettled = 0
    settled = simulate_poses(spec, poses.spring_m) if poses.n else None
    if settled is not None:
        n_unsettled = int(np.count_nonzero(~settled.valid))
        poses, settled = poses.take(settled.valid), settled.take(settled.valid)
    if settled is None or poses.n < MIN_S2R_POSES:
        what = f"pressures, spring lengths and tip poses, a payload of {spec.mass.payload_kg:g} kg"
        uses = {**measurements.row_uses, "poses at which the simulated arm finds no rest": n_unsettled}
        few = _few(poses.n, MIN_S2R_POSES, what, uses)
        remedy = f"policies will be trained on simulated poses: log {MIN_S2R_POSES} poses at rest or more"
        return _not_fitted(arm, "Sim-to-real network", few, remedy)
    real = pose_from_frame(poses.tip_m, poses.tip_rotation)
    # Fit the network from simulated to measured tips.
    fit = fit_s2r(spec, settled, real, seed)
    others = (fit,) if printed else ()
    fit = fit_s2r(spec, settled, real, seed, printed=True) if printed else fit
    section = sections.s2r(fit, settled.pose, settled.spring_m, real, n_unsettled, others)
    # Fit the pressures that hold the arm.
    held = fit_held_pressures(spec, settled.spring_m, poses.pressure_kpa, settled.pressure_kpa, seed)
    if fit.is_better:
        arm = arm._replace(s2r=fit.s2r)
    if not held.is_better:
        return StepResult(arm, section)
    spec = dataclasses.replace(spec, unmodelled=Unmodelled())  # which the process replaces
    arm = arm._replace(spec=spec, held=held.held)
    largest_kg = spec.mass.largest_payload_kg
    unloaded = payload_poses(arm._replace(held=None))
    widths_kg = payload_intervals(held.held, unloaded, largest_kg)
    section = sections.with_pressures(section, held, widths_kg, KNOWN * largest_kg)
    return StepResult(arm, section)


def changes(measurements: Measurements, arm: CalibratedArm, seed: int) -> StepResult:
    """Fit what has changed since an arm's calibration to later poses of the unloaded arm."""
    spec, s2r, _ = arm
    poses = _unloaded(measurements, spec)
    if poses.n < MIN_LATER:
        what = "pressures and spring lengths, without a payload"
        few = _few(poses.n, MIN_LATER, what, measurements.row_uses)
        remedy = f"what has changed is not known: measure {MIN_LATER} goals or more"
        return _not_fitted(arm, sections.CHANGES, few, remedy)
    fit = fit_changes(arm, poses, seed)
    section = sections.changes(fit, 0.0 if s2r is None else float(s2r.error_mm))
    return StepResult(arm._replace(spec=fit.spec) if fit.is_better else arm, section)


def payloads(measurements: Measurements, arm: CalibratedArm, seed: int) -> StepResult:
    """Fit how strongly an arm feels payloads to later poses with a known weight."""
    spec, held = arm.spec, arm.held
    if held is None:
        remedy = f"no residual pressures: record {MIN_S2R_POSES} poses at rest or more, and calibrate anew"
        return _not_fitted(arm, sections.PAYLOADS, "The calibration has no residual pressures.", remedy)
    # Take heavy poses that the simulated arm holds.
    poses = measurements.poses.with_lengths(spec)
    poses = poses.take(np.flatnonzero(np.isfinite(poses.spring_m).all(axis=1)))
    least_kg = LEAST_WEIGHT * spec.mass.largest_payload_kg
    rows = np.flatnonzero(poses.payload_kg > spec.mass.payload_kg + least_kg - SAME_KG)
    if len(rows):
        rows = rows[held_at(arm, poses.spring_m[rows])[1]]
    if len(rows) < MIN_WEIGHED:
        what = f"pressures and spring lengths, {1e3 * least_kg:.0f} g or more on top of the arm's own payload"
        few = _few(len(rows), MIN_WEIGHED, what, measurements.row_uses)
        got = f"got {len(rows)} poses with {1e3 * least_kg:.0f} g or more, expected {MIN_WEIGHED}"
        remedy = "measure more goals with a known weight (`deploy measure --payload`)"
        return _not_fitted(arm, sections.PAYLOADS, few, f"{got}: {remedy}")
    # Fit them; a ratio that no arm has is not believed.
    fit = fit_payload_scale(arm, poses, rows)
    section = sections.payloads(fit)
    if not fit.is_plausible:
        return StepResult(arm, section)
    return StepResult(arm._replace(held=held._replace(factor=fit.factor, factor_sd=fit.factor_sd)), section)
