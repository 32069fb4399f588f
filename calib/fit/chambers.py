"""Stiffness, area and length of each chamber, and the arm's mounting, fitted to poses of the arm at rest.

The simulated arm settles at the logged pressures; its chambers are changed until tip poses agree, and spring
lengths and markers at the sections' ends where they were measured. Robust least squares
(`calib.fit.leastsquares`) take the Jacobian from the implicit function theorem, see `calib.fit.equilibrium`.
Straight arms, if there are enough of them, have errors of their own scale: the model fits them better. A
first fit leaves out some poses, which judge it. The last fit begins where that one ended, and takes all.

Masses are known and set the scale of all forces. The bending stiffness of the backbone is fitted too, as area
and stiffness would otherwise absorb its error. Its axial stiffness and that of the springs cannot be fitted:
they act in parallel with the chambers and only the sum is seen, so the chambers absorb their error. A weak
prior keeps what the poses do not determine near the specification, and the warnings name it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.errors import FitError
from calib.fit.blocks import held_out_blocks
from calib.fit.equilibrium import N_KINDS, error_groups, simulate, tip_changes
from calib.fit.leastsquares import NOT_CONVERGED, Problem, Solution, fit, principal, refine
from calib.fit.markers import section_ends
from calib.fit.parameters import half_widths, names, priors, spec_at, tolerances
from calib.read.static_poses import StaticPoses, find_static_poses
from mjx_softarm.logs.rest import HOLD_KPA
from mjx_softarm.logs.schema import Log
from mjx_softarm.spec import ArmSpec

MIN_POSES = 20
ENOUGH_POSES = 100
MIN_STRAIGHT = 20  # poses of straight arms whose errors have scales of their own
HELD_OUT_SHARE = 0.2
HELD_OUT_BLOCK = 5  # poses
SCALE = (1e-3, 0.01, 1e-3, 1e-3)  # of tip [m], rotation [rad], springs [m] and markers [m]
MIN_SCALE = (1e-4, 1e-3, 1e-4, 1e-4)
MAX_RATIO = 2.0  # calibrated to specified value, and held-out to other errors
TOLD_TURN_DEG = 1.0
MAX_PRESSURE_GAP = 0.1  # share of the range that may be missing at either end


@dataclass(frozen=True)
class Errors:
    """Errors of simulated against measured tips over n poses."""

    n: int
    translation_mean_mm: float
    translation_95_mm: float
    rotation_mean_deg: float
    rotation_95_deg: float
    spring_rms_mm: float | None  # None where no spring was measured


@dataclass(frozen=True, eq=False)
class ChamberFit:
    """Calibrated chambers and whether to trust them.

    Attributes:
        spec: calibrated arm: chambers, bending stiffness of the backbone, mounting, and the range of spring
            lengths that may be commanded, which is the range measured at rest.
        half_width_95: half-width of the 95 % interval of each fitted field of `spec.chambers` (n_chambers,),
            of `spec.backbone` () and of `spec.mounting`.
        direction_widths: half-widths of the 95 % intervals along the principal directions of the fit, in
            units of the tolerances of `calib.fit.parameters`, largest first (p,).
        weak: unknown directions, whose width is above 1, in words.
        weak_tip_mm: how far each of these moves the simulated tip within its interval, at the pressures and
            with the payload where it does so the most (`calib.fit.equilibrium`).
        in_sample, held_out: errors of the first fit, in which the held-out poses took no part; `spec` is from
            the last fit, to all poses.
        in_sample_before, held_out_before: errors of the specification that the fit started from.
        scale: robust errors of arms that bend and of straight ones (2, 3): tip [m], rotation [rad] and
            springs [m], then (2, 4) markers [m] if there are any; a guess if too few arms are straight.
        rows: number of rows of the logs, by use.
        n_single: number of poses of one row, which cannot show whether the tip moved.
        poses: static poses of the logs, in their order.
        is_held_out: mask (n,) of the poses that judge.
        tip_error_mm: tip error (n,) of the fit without the held-out poses; NaN where it did not settle.
        chamber_m: chamber lengths (n, n_chambers) of the calibrated arm at each pose.
        warnings: reasons not to trust the fit, each with its remedy; none is good.
    """

    spec: ArmSpec
    half_width_95: Mapping[str, np.ndarray]
    direction_widths: np.ndarray
    weak: tuple[str, ...]
    weak_tip_mm: np.ndarray
    in_sample: Errors
    held_out: Errors
    in_sample_before: Errors
    held_out_before: Errors
    scale: np.ndarray
    rows: Mapping[str, int]
    n_single: int
    poses: StaticPoses
    is_held_out: np.ndarray
    tip_error_mm: np.ndarray
    chamber_m: np.ndarray
    warnings: tuple[str, ...]

    @property
    def has_markers(self) -> bool:
        """Whether markers at the sections' ends took part."""
        return self.scale.shape[1] == len(SCALE)

    @property
    def is_better(self) -> bool:
        """Whether the fit is closer to held-out poses than the specification that it started from."""
        return self.held_out.translation_mean_mm < self.held_out_before.translation_mean_mm

    @property
    def notes(self) -> tuple[str, ...]:
        """Say whether motion capture's axes of the tip are off those of the last plate."""
        turn_deg = np.linalg.norm(self.spec.mounting.tip_turn_deg)
        if turn_deg < TOLD_TURN_DEG:
            return ()
        return (
            f"the tip's measured quaternion is {turn_deg:.1f} deg off with the arm hanging straight. The "
            "calibration accounts for it. Zero it there, and calibrate anew, if angles are to be the plate's",
        )


def calibrate_chambers(logs: Log | Sequence[Log], spec: ArmSpec, seed: int = 0) -> ChamberFit:
    """Fit the chambers of an arm to its logs.

    Args:
        logs: logs with pressures and tip poses; readings or spring lengths help. `calib.read.static_poses`
            tells which rows count.
        spec: arm as believed so far, its sensors already calibrated.
        seed: seed that chooses the held-out poses, in contiguous blocks.

    Raises:
        FitError: a log without pressures or tip poses, or too few poses at rest.
        SpecError: the calibrated values are not those of an arm.
    """
    poses, rows = find_static_poses([logs] if isinstance(logs, Log) else logs, spec)
    if poses.n < MIN_POSES:
        row_uses = ", ".join(f"{count} {use}" for use, count in rows.items())
        raise FitError(
            f"chambers: got {poses.n} poses at rest, expected {MIN_POSES} or more; "
            f"rows of the logs: {row_uses}"
        )
    held = np.ptp(poses.pressure_kpa, axis=0) < HOLD_KPA  # their noise would pass for changes
    poses = poses._replace(pressure_kpa=np.where(held, poses.pressure_kpa.mean(axis=0), poses.pressure_kpa))
    held_out = held_out_blocks(poses.n, HELD_OUT_SHARE, HELD_OUT_BLOCK, seed)
    end_m, complaints = _section_ends(poses, spec)
    judged, solution = _solutions(spec, poses, end_m, held_out)
    before, _, _ = simulate(spec, poses, end_m, np.zeros_like(solution.x))
    after, _, _ = simulate(spec, poses, end_m, judged.x)
    _, _, chamber_m = simulate(spec, poses, end_m, solution.x)
    calibrated = _calibrated(spec, solution.x, poses)
    bent, straight = solution.scale.reshape(2, -1)
    widths, directions = principal(solution, tolerances(spec))
    unknown = widths > 1.0
    change = (tolerances(spec)[:, None] * widths * directions)[:, unknown]
    weak_tip_mm = 1e3 * tip_changes(spec, solution.x, change)
    each = zip(widths[unknown], weak_tip_mm, directions.T[unknown], strict=True)
    weak = tuple(_describe(*numbers, names(spec)) for numbers in each)
    found = ChamberFit(
        spec=calibrated,
        half_width_95=half_widths(calibrated, solution.half_width),
        direction_widths=widths,
        weak=weak,
        weak_tip_mm=weak_tip_mm,
        in_sample=_errors(after[~held_out], spec),
        held_out=_errors(after[held_out], spec),
        in_sample_before=_errors(before[~held_out], spec),
        held_out_before=_errors(before[held_out], spec),
        scale=np.stack([bent, np.minimum(bent, straight)])[:, : 4 if np.isfinite(end_m).any() else 3],
        rows=rows,
        n_single=int(np.count_nonzero(poses.single)),
        poses=poses,
        is_held_out=held_out,
        tip_error_mm=np.where(np.isinf(after[:, 0]), np.nan, 1e3 * np.linalg.norm(after[:, :3], axis=1)),
        chamber_m=chamber_m,
        warnings=(),
    )
    return dataclasses.replace(found, warnings=complaints + _warnings(found, spec, solution))


def _solutions(
    spec: ArmSpec, poses: StaticPoses, end_m: np.ndarray, held_out: np.ndarray
) -> tuple[Solution, Solution]:
    """Return the fit without the held-out poses, which judge it, and the fit to all poses, begun from it."""
    group = error_groups(spec, poses.pressure_kpa)
    if np.count_nonzero(group[~held_out, 0] >= N_KINDS) < MIN_STRAIGHT:
        group %= N_KINDS
    all_of_them = Problem(priors(spec), group, np.tile(SCALE, 2), np.tile(MIN_SCALE, 2))
    part = dataclasses.replace(all_of_them, group=group[~held_out])
    some, some_end_m = poses.take(~held_out), end_m[~held_out]
    judged = fit(lambda x: simulate(spec, some, some_end_m, x)[:2], part)
    return judged, refine(lambda x: simulate(spec, poses, end_m, x)[:2], judged.x, all_of_them)


def _section_ends(poses: StaticPoses, spec: ArmSpec) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the markers at the sections' ends, NaN where they are not to be used, and why not."""
    try:
        return section_ends(poses, spec), ()
    except FitError as error:  # the fit goes without them
        return np.full((poses.n, spec.structure.n_sections, 3), np.nan), (str(error),)


def _calibrated(spec: ArmSpec, x: np.ndarray, poses: StaticPoses) -> ArmSpec:
    """Return the specification with fitted chambers and the range of the measured spring lengths."""
    springs = {}
    if np.isfinite(poses.spring_m).any():
        low, high = float(np.nanmin(poses.spring_m)), float(np.nanmax(poses.spring_m))
        springs = {"length_min_m": low, "length_max_m": high}
    return spec_at(spec, x).replace(springs=springs)


def _describe(width: float, tip_mm: float, vector: np.ndarray, names: Sequence[str]) -> str:
    """Describe a principal direction by its largest components, in units of their tolerances."""
    largest = np.argsort(-np.abs(vector))[:4]
    sign = np.sign(vector[largest[0]])
    components = (f"{sign * vector[k]:+.2f} {names[k]}" for k in largest)
    return f"known to {width:.2f} times the tolerance, the tip to {tip_mm:.1f} mm: {' '.join(components)}"


def _errors(error: np.ndarray, spec: ArmSpec) -> Errors:
    settled = error[~np.isinf(error[:, 0])].reshape(-1, error.shape[1])
    if len(settled) == 0:
        return Errors(0, np.nan, np.nan, np.nan, np.nan, None)
    tip_mm = 1e3 * np.linalg.norm(settled[:, :3], axis=1)
    turn_deg = np.degrees(np.arcsin(np.minimum(np.linalg.norm(settled[:, 3:6], axis=1), 1.0)))
    spring = settled[:, 6 : 6 + spec.n_chambers]
    measured = np.isfinite(spring).any()
    tip_95_mm, turn_95_deg = float(np.percentile(tip_mm, 95)), float(np.percentile(turn_deg, 95))
    spring_rms_mm = 1e3 * float(np.sqrt(np.nanmean(spring**2))) if measured else None
    tip, turn = (float(tip_mm.mean()), tip_95_mm), (float(turn_deg.mean()), turn_95_deg)
    return Errors(len(settled), *tip, *turn, spring_rms_mm)


def _warnings(found: ChamberFit, spec: ArmSpec, solution: Solution) -> tuple[str, ...]:
    said = [] if solution.converged else [NOT_CONVERGED]
    if found.poses.n < ENOUGH_POSES:
        said.append(f"got {found.poses.n} poses at rest, expected {ENOUGH_POSES} or more: log more poses")
    if n_unsettled := np.count_nonzero(np.isnan(found.tip_error_mm)):
        said.append(
            f"the simulated arm finds no rest at {n_unsettled} of {found.poses.n} poses: check payload and "
            "pressures of these rows"
        )
    if found.held_out.translation_mean_mm > MAX_RATIO * found.in_sample.translation_mean_mm:
        said.append(
            f"held-out tip error {found.held_out.translation_mean_mm:.2f} mm is more than {MAX_RATIO:g} "
            f"times that of the other poses, {found.in_sample.translation_mean_mm:.2f} mm: log more poses"
        )
    if not found.is_better:
        said.append("the specification itself is better on held-out poses, so it stays: log more poses")
    stiffness, area = np.exp(np.abs(solution.x[: 2 * spec.n_chambers])).reshape(2, -1)
    for name, ratio in (("stiffness", stiffness), ("area", area)):
        if (far := np.flatnonzero(ratio > MAX_RATIO)).size:
            said.append(
                f"{name} of chambers {_list(far)} is {MAX_RATIO:g} times off the specification or more: "
                "check the unit of pressure, the order of the columns, and the payload"
            )
    if found.weak:
        n_weak = len(found.weak)
        springs = ", with spring lengths" if np.isnan(found.poses.spring_m).any() else ""
        remedy = f"record those of `python -m calib plan`{springs}"
        said.append("\n  ".join([f"{n_weak} unknown directions: {remedy}", *found.weak]))
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    gap = MAX_PRESSURE_GAP * (high - low)
    lowest, highest = found.poses.pressure_kpa.min(0), found.poses.pressure_kpa.max(0)
    if (short := np.flatnonzero((lowest > low + gap) | (highest < high - gap))).size:
        said.append(
            f"pressures of chambers {_list(short)} stay away from {low:g} or {high:g} kPa: log poses there"
        )
    return tuple(said)


def _list(chambers: np.ndarray) -> str:
    return ", ".join(map(str, chambers))
