"""Changes of an arm since its calibration: zeros of the springs' sensors, stiffness of the chambers.

The calibrated simulation settles at the lengths that the springs read at later poses of the unloaded arm, and
S2R corrects its tip. Where zeros have shifted, the measured tip lies elsewhere, and other pressures hold the
arm. Where chambers are softer, less pressure holds it. Robust least squares with a prior fit both to both
(`calib.fit.leastsquares`), beside offsets of the pressures, since a calibration does not know these exactly.
Poses of one circle are alike, so softer chambers differ from offsets to some per cent only. The fitted
pressures are those of the later poses in either case, and with them the estimate of payloads there.

Some poses take no part in a first fit and judge it. Changes that do not bring their tips closer, or their
pressures without motion capture, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arm import CalibratedArm
from calib.fit.blocks import held_out_blocks
from calib.fit.held_pressures import without_redundant_part
from calib.fit.leastsquares import Problem, Solution, fit, rms_of
from calib.fit.pose_errors import PoseErrors, change_errors
from calib.fit.s2r import simulate_poses
from calib.read.static_poses import StaticPoses
from mjx_softarm.control import chambers_of_springs
from mjx_softarm.sensing.held_pressures import held_kpa
from mjx_softarm.sensing.load import QUANTILE
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.sensing.s2r import correct, correction_between
from mjx_softarm.spec import ArmSpec

MIN_POSES = 8
HELD_OUT_BLOCK = 4  # poses; neighbours on a circle are alike
# Priors, by hand: shift of a zero; change of all stiffnesses, and of one beside the others; offsets of all
# pressures, and of one beside the others.
ZERO_M, STIFFNESS, OFFSET_KPA = 1e-3, (0.1, 0.02), (0.5, 0.5)
STEP_M = 5e-4  # of the finite differences
_TURN = np.array([1, 1, 1, 2, 2, 2])  # a small turn is twice its Gibbs vector
MIN_TIP_MM, MIN_TURN_RAD, MIN_KPA = 0.7, 0.015, 0.5  # least scales of the errors, which neighbours share


@dataclass(frozen=True, eq=False)
class Changes:
    """Arm as it is now, and what has changed."""

    spec: ArmSpec
    zero_m: np.ndarray  # (n_springs,) shifts of the zeros: true lengths minus lengths read
    zero_half_width_m: np.ndarray  # (n_springs,) half-widths of 95 % intervals
    stiffness: np.ndarray  # (n_chambers,) relative changes of the stiffness, negative where softer
    offset_kpa: np.ndarray  # (n_chambers,) pressures, measured less simulated, that neither explains
    mean_half_width: float  # half-width of the 95 % interval of their mean
    n: int  # poses
    before: PoseErrors  # held-out tips, as calibrated before
    after: PoseErrors  # held-out tips, by a fit without them
    before_kpa: float  # held-out pressures, RMS
    after_kpa: float

    @property
    def is_better(self) -> bool:
        """Whether the changes bring held-out tips closer; held-out pressures without motion capture."""
        if self.before.n:
            return self.after.translation_mean_mm < self.before.translation_mean_mm
        return self.after_kpa < self.before_kpa


def fit_changes(arm: CalibratedArm, poses: StaticPoses, seed: int = 0) -> Changes:
    """Fit what has changed since a calibration.

    Args:
        arm: the calibrated arm.
        poses: later poses of the unloaded arm, `MIN_POSES` or more, with spring lengths by the old zeros and
            pressures; tips are NaN without motion capture.
        seed: chooses the held-out poses.
    """
    # A fit without the held-out poses, which judge it, then to all poses
    held_out = held_out_blocks(poses.n, block=HELD_OUT_BLOCK, seed=seed)
    judged, fit = (_fit(arm, poses.take(rows)) for rows in (~held_out, held_out | True))
    before, after = (_model(arm, poses.take(held_out), x)[0] for x in (0.0 * judged.x, judged.x))

    # The arm as it is now
    spec, n, n_chambers = arm.spec, arm.spec.n_springs, arm.spec.n_chambers
    zero_m, (stiffness, offset_kpa) = fit.x[:n], fit.x[n:].reshape(2, -1) @ _all_and_each(n_chambers).T
    old = np.array(spec.per_chamber(spec.chambers.stiffness_n_per_m))
    mean = np.repeat([0.0, 1.0, 1.0 / n_chambers, 0.0], [n, 1, n_chambers, 1 + n_chambers])
    # On twins the loop's arrivals need 0.3 kPa less than recorded poses: all stiffnesses may be off by that
    shared = OFFSET_KPA[0] / rms_of(_elastic_kpa(spec, poses.spring_m + zero_m))
    unmodelled = spec.unmodelled_kpa + offset_kpa
    return Changes(
        spec=spec.replace(
            sensor={"delta_m": tuple(map(float, spec.spring_sensor.delta_m + zero_m))},
            chambers={"stiffness_n_per_m": tuple(map(float, old * (1.0 + stiffness)))},
            unmodelled={"pressure_kpa": tuple(map(float, unmodelled))},
        ),
        zero_m=zero_m,
        zero_half_width_m=fit.half_width[:n],
        stiffness=stiffness,
        offset_kpa=offset_kpa,
        mean_half_width=QUANTILE * float(np.sqrt(mean @ fit.covariance @ mean + shared**2)),
        n=poses.n,
        before=_pose_errors(before),
        after=_pose_errors(after),
        before_kpa=rms_of(before[:, 6:]),
        after_kpa=rms_of(after[:, 6:]),
    )


def _fit(arm: CalibratedArm, poses: StaticPoses) -> Solution:
    """Fit x: zeros [m]; stiffness of all chambers, and of each; offsets [kPa] of all, and of each."""
    spec, s2r, n_chambers = arm.spec, arm.s2r, arm.spec.n_chambers
    tip_mm = max(MIN_TIP_MM, 0.0 if s2r is None else float(s2r.error_mm))
    scale = np.array([tip_mm, MIN_TURN_RAD, MIN_KPA])
    sizes = spec.n_springs, *2 * (1, n_chambers)
    prior = np.repeat([ZERO_M, *STIFFNESS, *OFFSET_KPA], sizes)
    group = np.repeat([0, 1, 2], [3, 3, n_chambers])
    return fit(lambda x: _model(arm, poses, x), Problem(prior, group, scale, scale))


def _model(arm: CalibratedArm, poses: StaticPoses, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (m, 6 + n_chambers) [mm, rad, kPa] at x (p,), and derivatives (m, 6 + n_chambers, p).

    Errors are simulated less measured tips, and measured less simulated pressures; NaN where not measured,
    inf in the row of an arm that does not settle.
    """
    # Simulate the poses at their lengths, and with each spring a little longer.
    spec, s2r, held = arm
    n, m = spec.n_springs, poses.n
    shift_m = x[:n] + STEP_M * np.concatenate([np.zeros((1, n)), np.eye(n)])  # (1 + n, n)
    spring_m = (poses.spring_m + shift_m[:, None]).reshape(-1, n)
    simulated = simulate_poses(spec, spring_m)
    pose = simulated.pose if s2r is None else correct(s2r, simulated.pose, simulated.spring_m)

    # Errors of tips and pressures
    real = np.tile(pose_from_frame(poses.tip_m, poses.tip_rotation), (1 + n, 1))
    tip = correction_between(real, np.asarray(pose, float)) * _TURN
    measured_kpa = without_redundant_part(np.tile(poses.pressure_kpa, (1 + n, 1)), spring_m, spec)
    simulated_kpa = np.asarray(simulated.pressure_kpa, float)
    if held is not None:
        simulated_kpa = held_kpa(held, spring_m, simulated_kpa, np.zeros_like(simulated_kpa))
    left_kpa = measured_kpa - simulated_kpa - spec.unmodelled_kpa
    error = np.concatenate([tip, left_kpa], axis=1)
    error = np.where(simulated.valid[:, None], error, np.inf).reshape(1 + n, m, -1)

    # Their derivatives, and the parts of the stiffness and of the offsets
    elastic = _elastic_kpa(spec, spring_m[:m])[..., None]  # (m, n_chambers, 1)
    each, slope = _all_and_each(spec.n_chambers), np.zeros((m, error.shape[2], len(x)))
    slope[..., :n] = np.moveaxis((error[1:] - error[0]) / STEP_M, 0, -1)
    slope[:, 6:, n:] = -np.concatenate([elastic * each, np.tile(each, (m, 1, 1))], axis=-1)
    return error[0] + slope[..., n:] @ x[n:], np.where(np.isfinite(slope), slope, 0.0)


def _all_and_each(n: int) -> np.ndarray:
    """Return the matrix (n, 1 + n) from a number of all chambers, and of each beside that, to their sums."""
    return np.concatenate([np.ones((n, 1)), np.eye(n)], axis=1)


def _elastic_kpa(spec: ArmSpec, spring_m: np.ndarray) -> np.ndarray:
    """Return the pressures (m, n_chambers) that the chambers' stiffness takes at lengths (m, n_springs)."""
    chambers = spec.chambers
    beyond_m = spring_m @ chambers_of_springs(spec).T - spec.at_chambers(spec.geometry.section_length_m)
    values = chambers.area_m2, chambers.area_slope_m, chambers.stiffness_n_per_m, chambers.length_offset_m
    area, slope, stiffness, rest_m = (np.array(spec.per_chamber(value)) for value in values)
    return 1e-3 * stiffness * (beyond_m - rest_m) / (area + slope * beyond_m)


def _pose_errors(error: np.ndarray) -> PoseErrors:
    """Sum up the errors (m, 6) [mm, rad] of tips that were measured, of arms that settled."""
    return change_errors(error[np.isfinite(error[:, :6]).all(axis=1), :6] / _TURN)
