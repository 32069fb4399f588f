"""Chambers, their bond to the backbone, its bending, and the mounting, fitted to poses of the arm at rest.

The simulated arm settles at the logged pressures. Robust least squares (`calib.fit.leastsquares`) change its
chambers until tip poses agree, and spring lengths and markers at the sections' ends where there are any. The
Jacobian comes from the implicit function theorem. Errors of straight arms have a scale of their own, as the
model fits straight arms better. A first fit leaves out some poses, which judge it; the last fit begins from
it and takes all poses.

Masses are known and set the scale of all forces. Axial stiffness of backbone and springs acts in parallel
with the chambers, which absorb its error. A weak prior keeps parameters that the poses do not determine near
the specification; the warnings name them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from calib.fit.blocks import held_out_blocks
from calib.fit.leastsquares import NOT_CONVERGED, Problem, Solution, fit, principal, refine
from calib.fit.parameters import (
    by_name,
    free_arm,
    half_widths,
    marker_sites,
    names,
    priors,
    spec_at,
    tolerances,
    with_numbers,
)
from calib.fit.pose_errors import PoseErrors, errors_of
from calib.read.measurements import Measurements
from calib.read.static_poses import StaticPoses
from mjx_softarm._support import xla
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import RESIDUAL_TOLERANCE, settle_pressures
from mjx_softarm.mechanics.workspace import pressure_levels
from mjx_softarm.spec import BONDS, ArmSpec

MIN_POSES = 20
ENOUGH_POSES = 60  # circles of six stand-ins within 1.2 mm; docs/results/arms-minutes.json
N_KINDS = 4  # kinds of errors: tip, rotation, springs, markers
STRAIGHT = 0.2  # excess of one of three chambers over the others in a straight arm, as a share of the range
MIN_STRAIGHT = 20  # poses of straight arms from which their errors have scales of their own
HELD_OUT_BLOCK = 5  # poses
SCALE = (1e-3, 0.01, 1e-3, 1e-3)  # first guess for tip [m], rotation [rad], springs [m] and markers [m]
MIN_SCALE = (1e-4, 1e-3, 1e-4, 1e-4)  # least values of the same scales
MAX_RATIO = 2.0  # warn from this ratio of calibrated to specified values, or of held-out to other errors
NOTED_TURN_DEG = 1.0  # turn of the measured tip from which there is a note
MAX_PRESSURE_GAP = 0.1  # share of the pressure range that may be missing at either end
MAX_OFF_PLATE_M = 0.01  # distance of the last marker from the tip's plate, at most
BATCH = 128  # poses simulated together
N_WORKSPACE = 256  # poses over the workspace


@dataclass(frozen=True, eq=False)
class ChamberFit:
    """Calibrated chambers and whether to trust them.

    The first fit does not know the held-out poses, the last fit is to all poses.
    """

    spec: ArmSpec  # arm of the last fit; springs may be commanded over the range measured at rest
    half_width_95: Mapping[str, np.ndarray]  # half-widths of 95 % intervals, by fields of the specification
    direction_widths: np.ndarray  # (p,) half-widths along principal directions, in tolerances
    weak: tuple[str, ...]  # unknown directions, whose width is above 1, in words
    weak_tip_mm: np.ndarray  # largest movement of the tip along each unknown direction, within its interval
    in_sample: PoseErrors  # errors of the first fit at its own poses
    held_out: PoseErrors  # errors of the first fit at held-out poses
    held_out_before: PoseErrors  # errors of the specification there
    scale: np.ndarray  # (2, 3 or 4) robust errors of bent and straight arms, by `SCALE`
    rows: Mapping[str, int]  # number of rows of the logs, by use
    poses: StaticPoses  # in the order of the logs
    is_held_out: np.ndarray  # (n,) bool
    tip_error_mm: np.ndarray  # (n,) tip error of the first fit; NaN where the arm did not settle
    warnings: tuple[str, ...]  # reasons not to trust the fit, each with its remedy

    @property
    def is_better(self) -> bool:
        """Whether the fit is closer to held-out poses than the specification that it started from."""
        return self.held_out.translation_mean_mm < self.held_out_before.translation_mean_mm

    @property
    def notes(self) -> tuple[str, ...]:
        """Say whether motion capture's axes of the tip differ from the axes of the last plate."""
        turn_deg = np.linalg.norm(self.spec.mounting.tip_turn_deg)
        if turn_deg < NOTED_TURN_DEG:
            return ()
        return (
            f"the tip's measured quaternion is {turn_deg:.1f} deg off with the arm straight. The "
            "calibration accounts for it. Zero it there, and calibrate anew, if angles are to be the plate's",
        )


class Measured(NamedTuple):
    """Measurements of an arm at one pose at rest, with a leading axis at several; NaN where not measured."""

    pressure_kpa: Array | np.ndarray  # (n_chambers,)
    payload_kg: Array | np.ndarray  # ()
    tip_m: Array | np.ndarray  # (3,)
    tip_rotation: Array | np.ndarray  # (3, 3)
    spring_m: Array | np.ndarray  # (n_springs,)
    end_m: Array | np.ndarray  # (n_sections, 3) markers on the sections' last plates

    def take(self, poses: np.ndarray) -> Measured:
        """Return some of the poses, chosen by indices or a mask (n,)."""
        return Measured(*(value[poses] for value in self))


def residuals(x: Array, params: ArmParams, measured: Measured) -> tuple[Array, Array]:
    """Return simulated minus measured pose of one arm at rest.

    Args:
        x (p,): see `calib.fit.parameters`.
        params: arm at x = 0, with free chambers; its payload is not used.
        measured: measurements of one pose.

    Returns:
        Errors (6 + n_springs + 3 n_sections,) of the tip [m], the rotation [rad] as its axis times the sine
        of the angle, the springs [m] and the markers at the sections' ends [m]; largest residual force () [N,
        N m].
    """
    # Settle the arm at the measured pressures.
    masses = jnp.stack([params.tool_mass_kg[0], measured.payload_kg])
    arm = with_numbers(x, params._replace(tool_mass_kg=masses))
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        settled = settle_pressures(arm.without_pressure_limits(), jnp.asarray(measured.pressure_kpa))
        frames = chain_kinematics(arm)(settled.q)
        turn = measured.tip_rotation.T @ settled.tip_rotation
    # Compare it with the measured pose; markers are on the sections' last plates.
    angle = 0.5 * jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    site_m = marker_sites(x, arm)
    step = (len(frames.plate_position) - 1) // len(site_m)
    position, rotation = frames.plate_position[step::step], frames.plate_rotation[step::step]
    end_m = position + jnp.sum(rotation * site_m[:, None], axis=-1)
    error = [
        settled.tip_position_m - measured.tip_m,
        angle,
        settled.spring_m - measured.spring_m,
        (end_m - measured.end_m).reshape(-1),
    ]
    return jnp.concatenate(error), settled.residual


def error_groups(spec: ArmSpec, pressure_kpa: np.ndarray) -> np.ndarray:
    """Return the kind (n, m) of each of the `residuals` at pressures (n, n_chambers).

    Kinds are tip 0, rotation 1, springs 2 and markers 3. Errors of straight arms, whose sections have nearly
    one pressure each, have other kinds, `N_KINDS` more: the simulated arm has no torsion and shear, which act
    where an arm bends.
    """
    n = spec.structure.chambers_per_section
    kind = np.repeat(range(N_KINDS), [3, 3, spec.n_springs, 3 * spec.structure.n_sections])
    circle = np.exp(2j * np.pi * np.arange(n) / n)
    off_centre = np.abs(pressure_kpa.reshape(len(pressure_kpa), -1, n) @ circle)
    span = spec.chambers.pressure_max_kpa - spec.chambers.pressure_min_kpa
    straight = np.all(off_centre < STRAIGHT * span * (n / 3), axis=1, keepdims=True)
    return kind + N_KINDS * straight


def simulate(spec: ArmSpec, measured: Measured, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Simulate n poses of an arm, `spec` at x = 0, at x (p,).

    Returns:
        Errors (n, m) of `residuals`, inf where the arm does not settle; their Jacobian (n, m, p).
    """
    start, params = free_arm(spec, x)
    simulated = functools.partial(_jacobian(), np.float32(start), params)
    error, slope, settled = xla.in_batches(simulated, BATCH, measured)
    return np.where(settled[:, None], error.astype(float), np.inf), slope.astype(float)


def tip_changes(spec: ArmSpec, x: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the largest movement of the tip by changes of x, over the workspace and to first order.

    Half of the poses have random pressures and half have extreme ones; every second pose has the heaviest
    payload.

    Args:
        spec: arm at x = 0.
        x (p,): see `calib.fit.parameters`.
        change (p, k): changes of x.

    Returns:
        Lengths (k,) [m].
    """
    rng, n = np.random.default_rng(0), N_WORKSPACE
    extremes = rng.choice(pressure_levels(spec), (n // 2, spec.n_chambers))
    poses = Measured(
        pressure_kpa=np.concatenate([random_pressures(spec, n - len(extremes), rng), extremes]),
        payload_kg=np.where(np.arange(n) % 2, spec.mass.largest_payload_kg, 0.0),
        tip_m=np.zeros((n, 3)),
        tip_rotation=np.broadcast_to(np.eye(3), (n, 3, 3)),
        spring_m=np.zeros((n, spec.n_springs)),
        end_m=np.zeros((n, spec.structure.n_sections, 3)),
    )
    error, slope = simulate(spec, poses, x)
    settled = np.isfinite(error[:, 0]) & np.isfinite(slope).all(axis=(1, 2))
    return np.linalg.norm(slope[settled, :3] @ change, axis=1).max(axis=0, initial=0.0)


@functools.cache
def _jacobian():
    """Return the compiled errors, Jacobian and mask of settled arms of a batch."""

    def one(x, params: ArmParams, measured: Measured):
        def errors(x):
            error, left = residuals(x, params, measured)
            return error, (error, left)

        slope, (error, left) = jax.jacfwd(errors, has_aux=True)(x)
        return error, slope, left < RESIDUAL_TOLERANCE

    return xla.jit(jax.vmap(one, in_axes=(None, None, 0)))


def fit_chambers(measurements: Measurements, spec: ArmSpec, seed: int = 0) -> ChamberFit:
    """Fit the chambers of an arm to its poses at rest.

    Args:
        measurements: `MIN_POSES` poses at rest or more; readings, spring lengths and markers help.
        spec: arm as believed so far, its sensors already calibrated.
        seed: seed that chooses the held-out poses, in contiguous blocks.

    Raises:
        SpecError: no arm can have the calibrated values.
    """
    poses = measurements.poses.with_lengths(spec)
    # Fit without the held-out poses, then, from there, to all poses.
    held_out = held_out_blocks(poses.n, block=HELD_OUT_BLOCK, seed=seed)
    end_m, complaints = section_ends(poses, spec)
    measured = Measured(
        poses.pressure_kpa, poses.payload_kg, poses.tip_m, poses.tip_rotation, poses.spring_m, end_m
    )
    judged, solution = _solutions(spec, measured, held_out)
    # Judge the specification and the first fit, and name the directions that the last fit does not know.
    before, _ = simulate(spec, measured, np.zeros_like(solution.x))
    after, _ = simulate(spec, measured, judged.x)
    calibrated = _calibrated(spec, solution.x, poses)
    bent, straight = solution.scale.reshape(2, -1)
    widths, directions = principal(solution, tolerances(spec))
    unknown = widths > 1.0
    change = (tolerances(spec)[:, None] * widths * directions)[:, unknown]
    weak_tip_mm = 1e3 * tip_changes(spec, solution.x, change)
    each = zip(widths[unknown], weak_tip_mm, directions.T[unknown], strict=True)
    fit = ChamberFit(
        spec=calibrated,
        half_width_95=half_widths(calibrated, solution.covariance),
        direction_widths=widths,
        weak=tuple(_describe(*numbers, names(spec)) for numbers in each),
        weak_tip_mm=weak_tip_mm,
        in_sample=_errors(after[~held_out]),
        held_out=_errors(after[held_out]),
        held_out_before=_errors(before[held_out]),
        scale=np.stack([bent, np.minimum(bent, straight)])[:, : 4 if np.isfinite(end_m).any() else 3],
        rows=measurements.row_uses,
        poses=poses,
        is_held_out=held_out,
        tip_error_mm=np.where(np.isinf(after[:, 0]), np.nan, 1e3 * np.linalg.norm(after[:, :3], axis=1)),
        warnings=(),
    )
    return dataclasses.replace(fit, warnings=complaints + _warnings(fit, spec, solution))


def _solutions(spec: ArmSpec, measured: Measured, held_out: np.ndarray) -> tuple[Solution, Solution]:
    """Return the fit without the held-out poses, which judge it, and the fit to all poses, begun from it."""
    group = error_groups(spec, np.asarray(measured.pressure_kpa))
    if np.count_nonzero(group[~held_out, 0] >= N_KINDS) < MIN_STRAIGHT:
        group %= N_KINDS
    problem = Problem(priors(spec), group, np.tile(SCALE, 2), np.tile(MIN_SCALE, 2))
    part, learned = dataclasses.replace(problem, group=group[~held_out]), measured.take(~held_out)
    judged = fit(lambda x: simulate(spec, learned, x), part)
    return judged, refine(lambda x: simulate(spec, measured, x), judged.x, problem)


def section_ends(poses: StaticPoses, spec: ArmSpec) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the markers on the sections' last plates, and why they are not to be used.

    Markers sit on rings, equally many in each section, the last of each anywhere on its last plate.

    Returns:
        Markers (n, n_sections, 3) [m], NaN where not measured or not to be used; reasons.
    """
    n_markers, n_sections = poses.marker_m.shape[1], spec.structure.n_sections
    nothing = np.full((poses.n, n_sections, 3), np.nan)
    if n_markers == 0:
        return nothing, ()
    if n_markers % n_sections:
        return nothing, (f"markers: got {n_markers}, expected as many in each of {n_sections} sections",)
    seen = poses.take(np.flatnonzero(np.isfinite(poses.marker_m).all(axis=(1, 2))))
    if not seen.n:
        return nothing, ("markers: got no pose at rest that has them, expected one or more",)
    # Height of the last marker above the tip's plate, in the tip's frame
    last_m = np.einsum("nij,ni->nj", seen.tip_rotation, seen.marker_m[:, -1] - seen.tip_m)
    above_m = np.median(last_m[:, 2])
    if abs(above_m) > MAX_OFF_PLATE_M:
        return nothing, (
            f"markers: got the last {1e3 * above_m:+.1f} mm above the tip's plate, expected it in the "
            f"plate within {1e3 * MAX_OFF_PLATE_M:.0f} mm: number the markers from base to tip",
        )
    step = n_markers // n_sections
    return poses.marker_m[:, step - 1 :: step], ()


def _calibrated(spec: ArmSpec, x: np.ndarray, poses: StaticPoses) -> ArmSpec:
    """Return the specification with fitted chambers and the range of the measured spring lengths."""
    springs: dict[str, Any] = {}
    if np.isfinite(poses.spring_m).any():
        low, high = np.nanmin(poses.spring_m, axis=0), np.nanmax(poses.spring_m, axis=0)
        springs = {"length_min_m": float(low.min()), "length_max_m": float(high.max())}
        limits = spec.springs.length_min_m, spec.springs.length_max_m
        if any(isinstance(limit, tuple) for limit in limits):  # the sections have ranges of their own
            by_section = (x.reshape(spec.structure.n_sections, -1) for x in (low, high))
            shortest, longest = next(by_section).min(axis=1), next(by_section).max(axis=1)
            springs = {"length_min_m": tuple(shortest.tolist()), "length_max_m": tuple(longest.tolist())}
    return spec_at(spec, x).replace(springs=springs)


def _describe(width: float, tip_mm: float, vector: np.ndarray, names: Sequence[str]) -> str:
    """Describe a principal direction by its largest components, in units of their tolerances."""
    largest = np.argsort(-np.abs(vector))[:4]
    sign = np.sign(vector[largest[0]])
    components = (f"{sign * vector[k]:+.2f} {names[k]}" for k in largest)
    return f"known to {width:.2f} times the tolerance, the tip to {tip_mm:.1f} mm: {' '.join(components)}"


def _errors(error: np.ndarray) -> PoseErrors:
    """Sum up the errors (n, ...) of the tips of arms that settled."""
    settled = error[~np.isinf(error[:, 0])].reshape(-1, error.shape[1])
    sine = np.minimum(np.linalg.norm(settled[:, 3:6], axis=1), 1.0)
    tip_mm = 1e3 * np.linalg.norm(settled[:, :3], axis=1)
    return errors_of(tip_mm, np.degrees(np.arcsin(sine)))


def _warnings(fit: ChamberFit, spec: ArmSpec, solution: Solution) -> tuple[str, ...]:
    # Look at the fit and its poses.
    share, said = fit.spec.chambers.bonded_share, []
    if share in BONDS:  # its derivative stays there, so that no fit converges
        evenly = "more" if share == max(BONDS) else "less"
        said.append(
            f"bonded_share is at its bound, {share:g}: the links of a section bend {evenly} evenly than any "
            "bond makes them: check [mass] of the specification, whose weights bend them, and the payload"
        )
    elif not solution.converged:
        said.append(NOT_CONVERGED)
    if fit.poses.n < ENOUGH_POSES:
        said.append(f"got {fit.poses.n} poses at rest, expected {ENOUGH_POSES} or more: log more poses")
    if n_unsettled := np.count_nonzero(np.isnan(fit.tip_error_mm)):
        said.append(
            f"the simulated arm finds no rest at {n_unsettled} of {fit.poses.n} poses: check payload and "
            "pressures of these rows"
        )
    if fit.held_out.translation_mean_mm > MAX_RATIO * fit.in_sample.translation_mean_mm:
        said.append(
            f"held-out tip error {fit.held_out.translation_mean_mm:.2f} mm is more than {MAX_RATIO:g} "
            f"times the error of the others, {fit.in_sample.translation_mean_mm:.2f} mm: log more poses"
        )
    if not fit.is_better:
        said.append("the specification itself is better on held-out poses, so it stays: log more poses")
    # Look at the fitted numbers.
    changes = by_name(solution.x, spec.structure)
    for name in ("stiffness", "area"):
        far = np.flatnonzero(np.exp(np.abs(changes[name])) > MAX_RATIO)
        if far.size:
            said.append(
                f"{name} of chambers {_list(far)} is {MAX_RATIO:g} times off the specification or more: "
                "check the unit of pressure, the order of the columns, and the payload"
            )
    if fit.weak:
        worth = f"{len(fit.weak)} unknown directions, each worth up to {fit.weak_tip_mm.max():.1f} mm"
        springs = ", with spring lengths" if np.isnan(fit.poses.spring_m).any() else ""
        remedy = f"record more random poses{springs}"
        said.append("\n  ".join([f"{worth}: {remedy}", *fit.weak]))
    # Look at the range of the pressures.
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    gap = MAX_PRESSURE_GAP * (high - low)
    lowest, highest = fit.poses.pressure_kpa.min(0), fit.poses.pressure_kpa.max(0)
    if (short := np.flatnonzero((lowest > low + gap) | (highest < high - gap))).size:
        said.append(
            f"pressures of chambers {_list(short)} stay away from {low:g} or {high:g} kPa: log poses there"
        )
    return tuple(said)


def _list(chambers: np.ndarray) -> str:
    return ", ".join(map(str, chambers))
