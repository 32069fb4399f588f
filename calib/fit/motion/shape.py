"""Lag of an arm's shape behind its spring lengths, fitted to springs and tip of the moving arm.

At rest a section does not bend evenly: weight bends its upper part more. Springs do not show how a section
shares its bend. In motion the shares lag by a time constant T, which the backbone's damping gives
(`Backbone.shape_lag_s`). So the tip is at

    even(l) + U,    T U' = rest(l) - even(l) - U,

with the tip's place rest(l) at rest with spring lengths l, and even(l) with sections that bend evenly.
Neither pressures nor the chambers' damping take part. Errors of rest(l) are taken for linear in l.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.fit.s2r import simulate_poses
from mjx_softarm._support.fields import scaled
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.sensing.estimator import Frame, even_pose
from mjx_softarm.spec import ArmSpec

MAX_STEP_S = 0.05  # largest time between rows of a moving arm
MIN_S = 10.0  # length of a part of a log
SKIPPED_S = 3.0  # start of a part, before which the arm's motion is unknown
EVERY_S = 0.1  # time between rows that are simulated
LAGS_S = np.geomspace(0.02, 3.0, 41)
MARGIN = 0.98  # ratio of errors below which the fitted lag counts as better than the specification's


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """Fitted lag. Errors are RMS distances of the tip, of the rows of the fit."""

    spec: ArmSpec  # arm whose backbone has the lag
    lag_s: float
    before_s: float  # lag of the specification of the start
    rms_mm: float
    before_rms_mm: float
    time_s: float

    @property
    def is_better(self) -> bool:
        """Whether the fitted lag explains the tip better than the specification's."""
        return self.rms_mm < MARGIN * self.before_rms_mm


def fit_shape(logs: Sequence[Log], spec: ArmSpec) -> ShapeFit | None:
    """Fit the bending damping to the lag of the shape; None where no log follows springs and tip in motion.

    Args:
        logs: of the arm; those without springs, tip or dense rows are left out.
        spec: arm, its sensors and chambers already calibrated.
    """
    parts = [part for log in logs for part in _parts(log, spec)]
    if not parts or not spec.backbone.shape_lag_s:
        return None

    # Errors of each lag, of all parts
    rms = np.array([_rms_mm(parts, lag_s) for lag_s in LAGS_S])
    lag_s, before_s = float(LAGS_S[np.argmin(rms)]), spec.backbone.shape_lag_s
    bending = scaled(spec.backbone.bending_damping_nms_per_rad, lag_s / before_s)
    return ShapeFit(
        spec=spec.replace(backbone={"bending_damping_nms_per_rad": bending}),
        lag_s=lag_s,
        before_s=before_s,
        rms_mm=float(rms.min()),
        before_rms_mm=_rms_mm(parts, before_s),
        time_s=EVERY_S * sum(len(part[0]) for part in parts),
    )


Part = tuple[np.ndarray, np.ndarray, np.ndarray]  # l [m]; tip less even(l), rest(l) less even(l) [mm]


def _parts(log: Log, spec: ArmSpec) -> list[Part]:
    """Return the parts of a log without gaps, one row each `EVERY_S`."""
    # Spring lengths, and the mounting
    readings, spring_m, tip_m = log.readings_of(spec.sensor), log.spring_m, log.tip_m
    if readings is not None:
        spring_m = spec.spring_sensor.lengths(readings, np.nan).length_m
    if tip_m is None or spring_m is None:
        return []
    params = ArmParams.from_spec(spec)
    base = Frame(np.asarray(params.mount.base_position_m), np.asarray(params.mount.base_rotation))

    # Rows at regular times of each part, simulated at rest
    found, time_s = [], log.time_s
    cuts = np.flatnonzero(np.diff(time_s) > MAX_STEP_S) + 1
    for part in np.split(np.arange(len(log)), cuts):
        grid = np.arange(float(time_s[part[0]]), float(time_s[part[-1]]), EVERY_S)
        rows = part[np.searchsorted(time_s[part], grid + 1e-6, side="right") - 1]
        rows = rows[np.isfinite(spring_m[rows]).all(axis=1) & np.isfinite(tip_m[rows]).all(axis=1)]
        if len(rows) * EVERY_S < MIN_S:
            continue
        length_m, at_rest = spring_m[rows], simulate_poses(spec, spring_m[rows])
        if at_rest.valid.all():
            even_mm = even_pose(base, np.asarray(params.spring_site_m), length_m)[:, :3]
            found.append((length_m, 1e3 * tip_m[rows] - even_mm, at_rest.pose[:, :3] - even_mm))
    return found


def _rms_mm(parts: Sequence[Part], lag_s: float) -> float:
    """Return the RMS distance of the tip [mm] with a lag, but for what is linear in the spring lengths."""
    left, skipped = [], round(SKIPPED_S / EVERY_S)
    for spring_m, measured_mm, rest_mm in parts:
        uneven_mm, now_mm = np.empty_like(rest_mm), rest_mm[0]
        for k, target_mm in enumerate(rest_mm):
            now_mm = now_mm - np.expm1(-EVERY_S / lag_s) * (target_mm - now_mm)
            uneven_mm[k] = now_mm
        error_mm = (measured_mm - uneven_mm)[skipped:]
        linear = np.column_stack([np.ones(len(spring_m)), spring_m - spring_m.mean(axis=0)])[skipped:]
        left.append(error_mm - linear @ np.linalg.lstsq(linear, error_mm, rcond=None)[0])
    return float(np.sqrt(np.mean(np.sum(np.concatenate(left) ** 2, axis=1))))
