"""Stiffness, effective area and length of each chamber, fitted to poses of the arm at rest.

The simulated arm settles at the logged pressures; its chambers are changed until tip poses agree, and spring
lengths where they were measured. Robust least squares (`calib.fit.leastsquares`) take the Jacobian from the
implicit function theorem, see `calib.fit.equilibrium`.

Masses are known and set the scale of all forces. The backbone's bending stiffness is fitted along: with a
wrong one, area and stiffness make up for it together. Its axial stiffness and that of the springs cannot be:
they stand side by side with the chambers and only the sum is seen, so what they have too little the chambers
get. What the poses do not tell stays near the specification, by a weak prior, and is named.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import numpy as np

from calib.errors import FitError
from calib.fit.blocks import held_out_blocks
from calib.fit.equilibrium import Measured, residuals
from calib.fit.leastsquares import Problem, Solution, fit, principal
from calib.read.static_poses import HOLD_KPA, StaticPoses, find_static_poses
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.settle import RESIDUAL_TOLERANCE
from mjx_softarm.mechanics.statics import ArmParams
from mjx_softarm.spec import ArmSpec

BATCH = 128
MIN_POSES = 20
ENOUGH_POSES = 100
HELD_OUT_SHARE = 0.2
HELD_OUT_BLOCK = 5  # poses
SCALE = (1e-3, 0.01, 1e-3)  # of tip [m], rotation [rad] and springs [m]
MIN_SCALE = (1e-4, 1e-3, 1e-4)
# Of the four numbers of a chamber, see `calib.fit.equilibrium.with_numbers`.
FIELDS = ("stiffness_n_per_m", "area_m2", "area_slope_m", "length_offset_m")
SHORT = dict(zip(FIELDS, ("stiffness", "area", "slope", "offset"), strict=True))
PRIOR = (1.0, 1.0, 1.0, 0.25)  # a factor of e; an area per section length; a quarter of a section
TOLERANCE = (
    0.05,
    0.05,
    0.05,
    0.005,
)  # known: 5 %; 5 % of an area a section; 1 mm of 200 mm
BENDING = "bending_stiffness_nm_per_rad"  # of the backbone, the last of the numbers
BENDING_PRIOR, BENDING_TOLERANCE = 1.0, 0.05  # a factor of e; 5 %
MAX_RATIO = 2.0  # of a calibrated number to the specified one, and of held-out to other errors
MAX_PRESSURE_GAP = 0.1  # of the range, that may be missing at its end


@dataclass(frozen=True)
class Errors:
    """Simulated against measured tips, over some poses."""

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
        spec: the calibrated arm: chambers, the backbone's bending stiffness, and the range of spring lengths
            that may be commanded, which is what was measured at rest.
        half_width_95: of the 95 % interval of each fitted field of `spec.chambers` (n_chambers,), and of
            `spec.backbone` ().
        direction_widths: half-widths of the 95 % intervals along the principal directions of the fit, in
            units of what counts as known, largest first (4 * n_chambers + 1,).
        weak: the directions whose width is above 1, in words; in these the numbers are not known.
        in_sample, held_out: errors of the calibrated arm; held-out poses took no part in the fit.
        in_sample_before, held_out_before: errors of the specification that the fit started from.
        rows: number of rows of the logs by what became of them.
        n_single: poses of one row, which does not tell whether the tip moved.
        poses: static poses of the logs, in their order.
        is_held_out: which of them took no part (n,), bool.
        tip_error_mm: of the calibrated arm at each pose (n,); NaN where it found no rest.
        chamber_m: chamber lengths of the calibrated arm at each pose (n, n_chambers).
        warnings: reasons not to trust the fit; none is good.
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
        logs: with pressures and tip poses; frequencies or spring lengths help. Which rows count is said in
            `calib.read.static_poses`.
        spec: the arm as it is believed to be, its sensors already calibrated.
        seed: chooses the poses that are held out, in contiguous blocks.

    Raises:
        FitError: a log without pressures or tip poses, or too few poses at rest.
        SpecError: the calibrated numbers are not those of an arm.
    """
    poses, rows = find_static_poses([logs] if isinstance(logs, Log) else logs, spec)
    if poses.n < MIN_POSES:
        fates = ", ".join(f"{count} {fate}" for fate, count in rows.items())
        raise FitError(
            f"chambers: got {poses.n} poses at rest, expected {MIN_POSES} or more; rows of the logs: {fates}"
        )
    poses = poses._replace(pressure_kpa=_held_or_changing(poses.pressure_kpa))
    held_out = held_out_blocks(poses.n, HELD_OUT_SHARE, HELD_OUT_BLOCK, seed)
    fitted = poses.take(~held_out)
    solution = fit(lambda x: _simulate(spec, fitted, x)[:2], _problem(spec.n_chambers))
    before, _, _ = _simulate(spec, poses, np.zeros_like(solution.x))
    after, _, chamber_m = _simulate(spec, poses, solution.x)
    calibrated = _calibrated(spec, solution.x, poses)
    widths, directions = principal(
        solution, np.append(np.repeat(TOLERANCE, spec.n_chambers), BENDING_TOLERANCE)
    )
    weak = tuple(
        _describe(width, vector) for width, vector in zip(widths, directions.T, strict=True) if width > 1.0
    )
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


def _held_or_changing(pressure_kpa: np.ndarray) -> np.ndarray:
    """Pressures (n, n_chambers), without the noise of one that was held: it would pass for a change."""
    held = np.ptp(pressure_kpa, axis=0) < HOLD_KPA
    return np.where(held, np.mean(pressure_kpa, axis=0), pressure_kpa)


@functools.cache
def _jacobian():
    def one(x, params: ArmParams, measured: Measured):
        def errors(x):
            error, left, chamber_m = residuals(x, params, measured)
            return error, (error, left, chamber_m)

        slope, (error, left, chamber_m) = jax.jacfwd(errors, has_aux=True)(x)
        return error, slope, left < RESIDUAL_TOLERANCE, chamber_m

    return jax.jit(jax.vmap(one, in_axes=(None, None, 0)))


def _simulate(spec: ArmSpec, poses: StaticPoses, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return errors and Jacobian at x, see `calib.fit.leastsquares`; chamber lengths (n, n_chambers) [m]."""
    params = ArmParams.from_spec(spec)
    fields = (poses.pressure_kpa, poses.payload_kg, poses.tip_m, poses.tip_rotation, poses.spring_m)
    padded = -(-poses.n // BATCH) * BATCH
    measured = Measured(*(np.resize(np.float32(f), (padded, *f.shape[1:])) for f in fields))
    batches = [Measured(*(f[k : k + BATCH] for f in measured)) for k in range(0, padded, BATCH)]
    parts = [jax.device_get(_jacobian()(np.float32(x), params, batch)) for batch in batches]
    error, slope, settled, chamber_m = (np.concatenate(part)[: poses.n] for part in zip(*parts, strict=True))
    return np.where(settled[:, None], error.astype(float), np.inf), slope.astype(float), chamber_m


def _problem(n_chambers: int) -> Problem:
    return Problem(
        prior=np.append(np.repeat(PRIOR, n_chambers), BENDING_PRIOR),
        group=np.repeat([0, 1, 2], [3, 3, n_chambers]),
        scale=np.array(SCALE),
        min_scale=np.array(MIN_SCALE),
    )


def _calibrated(spec: ArmSpec, x: np.ndarray, poses: StaticPoses) -> ArmSpec:
    """The specification with fitted chambers and the range of the spring lengths that were measured."""
    values = _of_x(spec, x)
    springs = {}
    if np.isfinite(poses.spring_m).any():
        low, high = float(np.nanmin(poses.spring_m)), float(np.nanmax(poses.spring_m))
        springs = {"length_min_m": low, "length_max_m": high}
    chambers = {name: tuple(map(float, values[name])) for name in FIELDS}
    return spec.replace(chambers=chambers, backbone={BENDING: float(values[BENDING])}, springs=springs)


def _of_x(spec: ArmSpec, x: np.ndarray) -> dict[str, np.ndarray]:
    """Fields of the specification that x (4 * n_chambers + 1,) stands for, as in `with_numbers`."""
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
    """A principal direction by its largest parts, in units of TOLERANCE."""
    n_chambers = len(vector) // len(FIELDS)
    names = [f"{SHORT[name]}{k}" for name in FIELDS for k in range(n_chambers)] + [BENDING]
    largest = np.argsort(-np.abs(vector))[:4]
    sign = np.sign(vector[largest[0]])
    parts = (f"{sign * vector[k]:+.2f} {names[k]}" for k in largest)
    return f"known to {width:.1f} times the tolerance: {' '.join(parts)}"


def _errors(error: np.ndarray) -> Errors:
    settled = error[~np.isinf(error[:, 0])].reshape(-1, error.shape[1])
    if len(settled) == 0:
        nan = float("nan")
        return Errors(0, nan, nan, nan, nan, None)
    tip_mm = 1e3 * np.linalg.norm(settled[:, :3], axis=1)
    turn_deg = np.degrees(np.arcsin(np.minimum(np.linalg.norm(settled[:, 3:6], axis=1), 1.0)))
    spring = settled[:, 6:]
    measured = np.isfinite(spring).any()
    return Errors(
        len(settled),
        float(tip_mm.mean()),
        float(np.percentile(tip_mm, 95)),
        float(turn_deg.mean()),
        float(np.percentile(turn_deg, 95)),
        1e3 * float(np.sqrt(np.nanmean(spring**2))) if measured else None,
    )


def _warnings(found: ChamberFit, spec: ArmSpec, solution: Solution) -> tuple[str, ...]:
    said = []
    if not solution.converged:
        said.append("the fit has not come to an end")
    if found.poses.n < ENOUGH_POSES:
        said.append(f"{found.poses.n} poses at rest are few; {ENOUGH_POSES} are better")
    if n_unsettled := np.count_nonzero(np.isnan(found.tip_error_mm)):
        said.append(f"the simulated arm finds no rest at {n_unsettled} of {found.poses.n} poses")
    if found.held_out.translation_mean_mm > MAX_RATIO * found.in_sample.translation_mean_mm:
        said.append(
            f"held-out tip error {found.held_out.translation_mean_mm:.2f} mm is more than {MAX_RATIO:g} "
            f"times the error of the other poses, {found.in_sample.translation_mean_mm:.2f} mm"
        )
    if not found.held_out.translation_mean_mm < found.held_out_before.translation_mean_mm:
        said.append("the specification that the fit started from is better on held-out poses")
    stiffness, area = (np.exp(np.abs(solution.x[:-1].reshape(len(FIELDS), -1)[k])) for k in (0, 1))
    for name, ratio in (("stiffness", stiffness), ("area", area)):
        if (far := np.flatnonzero(ratio > MAX_RATIO)).size:
            said.append(
                f"{name} of chambers {_list(far)} is {MAX_RATIO:g} times off the specification or more"
            )
    if found.weak:
        said.append(f"{len(found.weak)} directions of the numbers are not known, the first: {found.weak[0]}")
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    seen = found.poses.pressure_kpa
    gap = MAX_PRESSURE_GAP * (high - low)
    if (short := np.flatnonzero((seen.min(0) > low + gap) | (seen.max(0) < high - gap))).size:
        said.append(f"pressures of chambers {_list(short)} stay away from {low:g} or {high:g} kPa")
    return tuple(said)


def _list(chambers: np.ndarray) -> str:
    return ", ".join(map(str, chambers))
