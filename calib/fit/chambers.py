"""Stiffness, effective area and length of each chamber, fitted to poses of the arm at rest.

The simulated arm settles at the logged pressures; its chambers are changed until tip poses agree, and spring
lengths where they were measured. Robust least squares (`calib.fit.leastsquares`) take the Jacobian from the
implicit function theorem, see `calib.fit.equilibrium`.

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
from calib.fit.equilibrium import simulate
from calib.fit.leastsquares import NOT_CONVERGED, Problem, Solution, fit, principal
from calib.read.static_poses import StaticPoses, find_static_poses
from mjx_softarm.logs.rest import HOLD_KPA
from mjx_softarm.logs.schema import Log
from mjx_softarm.spec import ArmSpec

MIN_POSES = 20
ENOUGH_POSES = 100
HELD_OUT_SHARE = 0.2
HELD_OUT_BLOCK = 5  # poses
SCALE = (1e-3, 0.01, 1e-3)  # of tip [m], rotation [rad] and springs [m]
MIN_SCALE = (1e-4, 1e-3, 1e-4)
# The four parameters of a chamber, see `calib.fit.equilibrium.with_numbers`.
FIELDS = ("stiffness_n_per_m", "area_m2", "area_slope_m", "length_offset_m")
SHORT = dict(zip(FIELDS, ("stiffness", "area", "slope", "offset"), strict=True))
PRIOR = (1.0, 1.0, 1.0, 0.25)  # a factor of e; an area per section length; a quarter of a section
TOLERANCE = (0.05, 0.05, 0.05, 0.005)  # known to 5 %; 5 % of an area a section; 1 mm of 200 mm
BENDING = "bending_stiffness_nm_per_rad"  # of the backbone, the last of the parameters
BENDING_PRIOR, BENDING_TOLERANCE = 1.0, 0.05  # a factor of e; 5 %
MAX_RATIO = 2.0  # calibrated to specified value, and held-out to other errors
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
        spec: calibrated arm: chambers, bending stiffness of the backbone, and the range of spring lengths
            that may be commanded, which is the range measured at rest.
        half_width_95: half-width of the 95 % interval of each fitted field of `spec.chambers` (n_chambers,)
            and of `spec.backbone` ().
        direction_widths: half-widths of the 95 % intervals along the principal directions of the fit, in
            units of TOLERANCE, largest first (4 * n_chambers + 1,).
        weak: unknown directions, whose width is above 1, in words.
        in_sample, held_out: errors of the calibrated arm; held-out poses took no part in the fit.
        in_sample_before, held_out_before: errors of the specification that the fit started from.
        rows: number of rows of the logs, by use.
        n_single: number of poses of one row, which cannot show whether the tip moved.
        poses: static poses of the logs, in their order.
        is_held_out: mask (n,) of the poses that took no part.
        tip_error_mm: tip error (n,) of the calibrated arm at each pose; NaN where it did not settle.
        chamber_m: chamber lengths (n, n_chambers) of the calibrated arm at each pose.
        warnings: reasons not to trust the fit, each with its remedy; none is good.
    """

    spec: ArmSpec
    half_width_95: Mapping[str, np.ndarray]
    direction_widths: np.ndarray
    weak: tuple[str, ...]
    in_sample: Errors
    held_out: Errors
    in_sample_before: Errors
    held_out_before: Errors
    rows: Mapping[str, int]
    n_single: int
    poses: StaticPoses
    is_held_out: np.ndarray
    tip_error_mm: np.ndarray
    chamber_m: np.ndarray
    warnings: tuple[str, ...]


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
    fitted = poses.take(~held_out)
    prior = np.append(np.repeat(PRIOR, spec.n_chambers), BENDING_PRIOR)
    group = np.repeat([0, 1, 2], [3, 3, spec.n_chambers])
    problem = Problem(prior, group, np.array(SCALE), np.array(MIN_SCALE))
    solution = fit(lambda x: simulate(spec, fitted, x)[:2], problem)
    before, _, _ = simulate(spec, poses, np.zeros_like(solution.x))
    after, _, chamber_m = simulate(spec, poses, solution.x)
    calibrated = _calibrated(spec, solution.x, poses)
    tolerance = np.append(np.repeat(TOLERANCE, spec.n_chambers), BENDING_TOLERANCE)
    widths, directions = principal(solution, tolerance)
    weak = tuple(_describe(w, vector) for w, vector in zip(widths, directions.T, strict=True) if w > 1.0)
    found = ChamberFit(
        spec=calibrated,
        half_width_95=_half_widths(spec, solution),
        direction_widths=widths,
        weak=weak,
        in_sample=_errors(after[~held_out]),
        held_out=_errors(after[held_out]),
        in_sample_before=_errors(before[~held_out]),
        held_out_before=_errors(before[held_out]),
        rows=rows,
        n_single=int(np.count_nonzero(poses.single)),
        poses=poses,
        is_held_out=held_out,
        tip_error_mm=np.where(np.isinf(after[:, 0]), np.nan, 1e3 * np.linalg.norm(after[:, :3], axis=1)),
        chamber_m=chamber_m,
        warnings=(),
    )
    return dataclasses.replace(found, warnings=_warnings(found, spec, solution))


def _calibrated(spec: ArmSpec, x: np.ndarray, poses: StaticPoses) -> ArmSpec:
    """Return the specification with fitted chambers and the range of the measured spring lengths."""
    values = _of_x(spec, x)
    springs = {}
    if np.isfinite(poses.spring_m).any():
        low, high = float(np.nanmin(poses.spring_m)), float(np.nanmax(poses.spring_m))
        springs = {"length_min_m": low, "length_max_m": high}
    chambers = {name: tuple(map(float, values[name])) for name in FIELDS}
    return spec.replace(chambers=chambers, backbone={BENDING: float(values[BENDING])}, springs=springs)


def _of_x(spec: ArmSpec, x: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of the specification at x (4 * n_chambers + 1,), see `with_numbers`."""
    stiffness, area, slope, offset = x[:-1].reshape(len(FIELDS), -1)
    old = {name: np.array(spec.per_chamber(getattr(spec.chambers, name))) for name in FIELDS}
    length_m = spec.geometry.section_length_m
    return {
        "stiffness_n_per_m": old["stiffness_n_per_m"] * np.exp(stiffness),
        "area_m2": old["area_m2"] * np.exp(area),
        "area_slope_m": old["area_slope_m"] + slope * old["area_m2"] / length_m,
        "length_offset_m": old["length_offset_m"] + offset * length_m,
        BENDING: spec.backbone.bending_stiffness_nm_per_rad * np.exp(x[-1]),
    }


def _half_widths(spec: ArmSpec, solution: Solution) -> dict[str, np.ndarray]:
    *chambers, bending = solution.half_width
    stiffness, area, slope, offset = np.reshape(chambers, (len(FIELDS), -1))
    found = _of_x(spec, solution.x)
    length_m = spec.geometry.section_length_m
    return {
        "stiffness_n_per_m": found["stiffness_n_per_m"] * stiffness,
        "area_m2": found["area_m2"] * area,
        "area_slope_m": np.array(spec.per_chamber(spec.chambers.area_m2)) / length_m * slope,
        "length_offset_m": length_m * offset,
        BENDING: found[BENDING] * bending,
    }


def _describe(width: float, vector: np.ndarray) -> str:
    """Describe a principal direction by its largest components, in units of TOLERANCE."""
    n_chambers = len(vector) // len(FIELDS)
    names = [f"{SHORT[name]}{k}" for name in FIELDS for k in range(n_chambers)] + [BENDING]
    largest = np.argsort(-np.abs(vector))[:4]
    sign = np.sign(vector[largest[0]])
    components = (f"{sign * vector[k]:+.2f} {names[k]}" for k in largest)
    return f"known to {width:.1f} times the tolerance: {' '.join(components)}"


def _errors(error: np.ndarray) -> Errors:
    settled = error[~np.isinf(error[:, 0])].reshape(-1, error.shape[1])
    if len(settled) == 0:
        return Errors(0, np.nan, np.nan, np.nan, np.nan, None)
    tip_mm = 1e3 * np.linalg.norm(settled[:, :3], axis=1)
    turn_deg = np.degrees(np.arcsin(np.minimum(np.linalg.norm(settled[:, 3:6], axis=1), 1.0)))
    spring = settled[:, 6:]
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
    if not found.held_out.translation_mean_mm < found.held_out_before.translation_mean_mm:
        said.append("the specification itself is better on held-out poses: keep it, or log more poses")
    stiffness, area = (np.exp(np.abs(solution.x[:-1].reshape(len(FIELDS), -1)[k])) for k in (0, 1))
    for name, ratio in (("stiffness", stiffness), ("area", area)):
        if (far := np.flatnonzero(ratio > MAX_RATIO)).size:
            said.append(
                f"{name} of chambers {_list(far)} is {MAX_RATIO:g} times off the specification or more: "
                "check the unit of pressure, the order of the columns, and the payload"
            )
    if found.weak:
        n_weak = len(found.weak)
        springs = ", with spring lengths" if np.isnan(found.poses.spring_m).any() else ""
        said.append(f"{n_weak} unknown directions, the first {found.weak[0]}: log more poses{springs}")
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
