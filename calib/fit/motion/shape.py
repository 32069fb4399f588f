"""Lag of an arm's shape behind its spring lengths, fitted to springs and tip of the moving arm.

At rest a section does not bend evenly: weight bends its upper part more. Springs do not show how a section
shares its bend. In motion the shares lag by a time constant T, which the damping of the bend gives
(`ArmSpec.shape_lag_s`). So the tip is at

    even(l) + U,    T U' = rest(l) - even(l) - U,

with the tip's place rest(l) at rest with spring lengths l, and even(l) with sections that bend evenly.
Neither pressures nor the chambers' damping take part. The sim-to-real network's correction is added to
even(l), as in the loop: it does not lag. What it leaves is taken for linear in l. A row
without a tip has no error, and U goes on there. Rows without lengths cut a log into parts.

The interval of log T follows from the curvature of the cost, from the spread of its slope between blocks of
`BLOCK_S`, and from the step between the T that are tried. Errors of rest(l) last as long as a pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm import CalibratedArm
from calib.fit.motion.tracks import dense_parts
from calib.fit.s2r import simulate_poses
from mjx_softarm._support.fields import scaled
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.sensing.estimator import Frame, even_pose
from mjx_softarm.sensing.load import QUANTILE
from mjx_softarm.sensing.s2r import correct
from mjx_softarm.spec import ArmSpec

MIN_S = 10.0  # length of a part of a log
MAX_TOTAL_S = 300.0  # length of all parts together
SKIPPED_S = 3.0  # start of a part, before which the arm's motion is unknown
EVERY_S = 0.1  # time between rows that are simulated
# Rows this soon after a step [kPa] of the pressures have no error: the arm's inertia shows. With the steps of
# `deploy record` among the rows, a planted lag of 0.150 s came back as 0.216 s, without as 0.148 s.
STEP_KPA, STEP_S = 1.5, 1.0
LAGS_S = np.geomspace(0.02, 3.0, 41)
LOG_STEP = float(np.log(LAGS_S[1] / LAGS_S[0]))
BLOCK_S = 10.0  # errors within this time are not independent
KNOWN = 0.5  # relative half-width of the interval up to which a lag counts as known; by hand


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """Fitted lag. Errors are RMS distances of the tip, of the rows of the fit."""

    spec: ArmSpec  # arm whose backbone has the lag
    lag_s: float
    before_s: float  # lag of the specification of the start
    rms_mm: float
    before_rms_mm: float
    time_s: float
    log_std: float  # standard deviation of the lag's logarithm; inf where the errors do not show it

    @property
    def at_end(self) -> bool:
        """Whether the best lag is the first or the last one that was tried, so that others may be better."""
        return self.lag_s in (LAGS_S[0], LAGS_S[-1])

    @property
    def is_known(self) -> bool:
        """Whether the fitted lag is known well enough to stand for the backbone's damping."""
        return self.half_width_s <= KNOWN * self.lag_s

    @property
    def half_width_s(self) -> float:
        """Half-width of the lag's 95 % interval."""
        return QUANTILE * self.log_std * self.lag_s


def fit_shape(logs: Sequence[Log], arm: CalibratedArm) -> ShapeFit | None:
    """Fit the bending damping to the lag of the shape; None where no log follows springs and tip in motion.

    Args:
        logs: of the arm; those without springs, tip or dense rows are left out.
        arm: its sensors, chambers and sim-to-real network already calibrated.
    """
    spec, parts, left = arm.spec, [], round(MAX_TOTAL_S / EVERY_S)
    for log in logs:
        for part in _parts(log, arm, left):
            parts.append(part)
            left -= len(part[0])
    if not parts or not spec.shape_lag_s:
        return None

    # Errors of each lag, of all parts
    square_mm2 = np.array([_squares_mm2(parts, lag_s) for lag_s in LAGS_S])  # (lags, rows)
    rms, before_s = np.sqrt(square_mm2.mean(axis=1)), spec.shape_lag_s
    lag_s, blocks = float(LAGS_S[np.argmin(rms)]), _blocks(parts)
    bending = scaled(spec.backbone.bending_damping_nms_per_rad, lag_s / before_s)
    return ShapeFit(
        spec=spec.replace(backbone={"bending_damping_nms_per_rad": bending}),
        lag_s=lag_s,
        before_s=before_s,
        rms_mm=float(rms.min()),
        before_rms_mm=float(np.sqrt(_squares_mm2(parts, before_s).mean())),
        time_s=EVERY_S * sum(len(part[0]) for part in parts),
        log_std=_log_std(np.stack([np.bincount(blocks, row) for row in square_mm2])),
    )


def _log_std(cost: np.ndarray) -> float:
    """Return the standard deviation of the best lag's logarithm from the costs (lags, blocks) of `LAGS_S`."""
    k = int(np.argmin(cost.sum(axis=1)))
    if not 0 < k < len(cost) - 1:
        return np.inf
    before, best, after = cost[k - 1 : k + 2]
    slope, curvature = (after - before) / (2 * LOG_STEP), (before - 2 * best + after).sum() / LOG_STEP**2
    if curvature <= 0.0 or len(slope) < 2:
        return np.inf
    return float(np.sqrt(len(slope) * np.var(slope, ddof=1) / curvature**2 + LOG_STEP**2 / 12.0))


# l [m]; tip less even(l) [mm], corrected, NaN where the tip was not seen; rest(l) less even(l) [mm]
Part = tuple[np.ndarray, np.ndarray, np.ndarray]


def _parts(log: Log, arm: CalibratedArm, left: int) -> list[Part]:
    """Return the parts of a log without gaps of time or lengths, a row each `EVERY_S`: the last `left`."""
    # Spring lengths, and the mounting
    spec = arm.spec
    spring_m, tip_m = log.lengths_m(spec.spring_sensor), log.tip_m
    if tip_m is None or spring_m is None:
        return []
    params = ArmParams.from_spec(spec)
    base = Frame(np.asarray(params.mount.base_position_m), np.asarray(params.mount.base_rotation))

    # Rows at regular times of each part without a gap of times or lengths: a row less would shorten the lag
    parts, known = [], np.asarray(np.isfinite(spring_m).all(axis=1))
    stepped = _after_steps(log)
    for part, _, newest in dense_parts(log, EVERY_S, known[1:] != known[:-1]):
        rows = newest[-left:]
        if left <= 0:
            break
        seen = np.asarray(np.isfinite(tip_m[rows]).all(axis=1)) & ~stepped[rows]
        if not known[part[0]] or np.count_nonzero(seen) * EVERY_S < MIN_S:
            continue
        length_m, at_rest = spring_m[rows], simulate_poses(spec, spring_m[rows])
        even_mm = even_pose(base, np.asarray(params.spring_site_m), length_m)[:, :3]
        uneven_mm = at_rest.pose[:, :3] - even_mm
        if arm.s2r is not None:
            even_mm = np.asarray(correct(arm.s2r, at_rest.pose, length_m))[:, :3] - uneven_mm
        # A row at which the simulated arm finds no rest has no error, and the rest of the row before it
        tip_mm = np.where((seen & at_rest.valid)[:, None], 1e3 * tip_m[rows], np.nan)
        newest_valid = np.maximum.accumulate(np.where(at_rest.valid, np.arange(len(rows)), 0))
        parts.append((length_m, tip_mm - even_mm, uneven_mm[newest_valid]))
        left -= len(rows)
    return parts


def _after_steps(log: Log) -> np.ndarray:
    """Return which rows (n,) of a log come soon after a step of the commands, or of measured pressures."""
    kpa = log.pressure_kpa if log.commanded_kpa is None else log.commanded_kpa
    if kpa is None:
        return np.zeros(len(log), bool)
    change = np.abs(np.diff(kpa, axis=0, prepend=kpa[:1])).max(axis=1)
    step_s = np.where(change > STEP_KPA, log.time_s, -np.inf)
    return log.time_s - np.maximum.accumulate(step_s) < STEP_S


def _counted(part: Part) -> np.ndarray:
    """Return which rows (n,) of a part count: those with a tip, after the first seconds."""
    seen = np.asarray(np.isfinite(part[1]).all(axis=1))
    return seen & (np.arange(len(seen)) >= round(SKIPPED_S / EVERY_S))


def _blocks(parts: Sequence[Part]) -> np.ndarray:
    """Return the block of each row that counts, of all parts one after the other."""
    blocks, n = [], 0
    for part in parts:
        block = np.arange(len(part[0])) // round(BLOCK_S / EVERY_S)
        blocks.append(n + block[_counted(part)])
        n = blocks[-1].max() + 1
    return np.unique(np.concatenate(blocks), return_inverse=True)[1]


def _squares_mm2(parts: Sequence[Part], lag_s: float) -> np.ndarray:
    """Return the squared distance of the tip with a lag in each row that counts.

    The part of the distance that is linear in the spring lengths is left out.
    """
    left = []
    for part in parts:
        (spring_m, measured_mm, rest_mm), counted = part, _counted(part)
        uneven_mm, now_mm = np.empty_like(rest_mm), rest_mm[0]
        for k, target_mm in enumerate(rest_mm):
            now_mm = now_mm - np.expm1(-EVERY_S / lag_s) * (target_mm - now_mm)
            uneven_mm[k] = now_mm
        error_mm = (measured_mm - uneven_mm)[counted]
        linear = np.column_stack([np.ones(len(spring_m)), spring_m - spring_m.mean(axis=0)])[counted]
        left.append(error_mm - linear @ np.linalg.lstsq(linear, error_mm, rcond=None)[0])
    return np.sum(np.concatenate(left) ** 2, axis=1)
