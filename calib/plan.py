"""Poses to record next: first poses that tell a calibration's unknown directions, then poses far from others.

The parameters x are those of `calib.fit.parameters`, and their covariance is that of the calibration's fit. J
holds the derivatives of all measurements by x, over the scales of their errors. A pose that is recorded adds
J^T J / M^2 to the precision of x, with a margin M, since errors are not independent. Poses are chosen one by
one among candidates, each time the pose that reduces the sum of the variances most, in units of the
tolerances, until every direction is expected to be known, but at most half of the poses. Where payloads are
not known well (`calib.fit.payload`), the rest of this half is chosen to tell them. The others are drawn as in
k-means++: by the square of the distance to the nearest pose, times the error of the sim-to-real network
there.

Source: Fedorov, "Theory of Optimal Experiments", 1972 (A-optimal design); Arthur, Vassilvitskii, "k-means++",
SODA 2007.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib.arm import CalibratedArm
from calib.fit.equilibrium import N_KINDS, error_groups, simulate, unmeasured
from calib.fit.leastsquares import QUANTILE
from calib.fit.parameters import priors, tolerances
from calib.fit.payload import payload_half_widths, payload_poses, told_widths
from calib.payload_plan import choose_for_payload, informed
from mjx_softarm._support.archive import Entries, entries_of, read_sealed, write_sealed
from mjx_softarm.control import allocation
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.workspace import pressure_levels, settle_many
from mjx_softarm.spec import ArmSpec

KIND, RECORDED_FILE = "recorded", "recorded.npz"  # file in the folder of a calibration
SHARE_FAR = 0.5  # least share of the poses that are drawn by their distance
KNOWN_SHARE = 0.02  # half-width of no payload, in largest payloads, from which no pose is spent on it
MAX_CANDIDATES = 1500
MARGIN = 2.0  # M: intervals of fits over intervals by J^T J, which takes errors for independent
N_NEAREST = 8  # nearest poses whose errors are averaged
MAX_ERROR_RATIO = 2.0  # largest weight: mean error of the nearest poses over the mean of all


class Recorded(NamedTuple):
    """Poses that a calibration knows, float64."""

    pressure_kpa: np.ndarray  # (n, n_chambers)
    payload_kg: np.ndarray  # (n,)
    error_mm: np.ndarray  # (n,) error of the tip, with the sim-to-real network if there is one
    scale: np.ndarray  # (2, 3) robust errors, see `calib.fit.chambers.ChamberFit`; (2, 4) with markers
    covariance: np.ndarray | None = None  # (p, p) of the fit's parameters; None in older files


class Plan(NamedTuple):
    """Poses to record, and their expected benefit."""

    pressure_kpa: np.ndarray  # (n, n_chambers): the informative poses, those for the payload, the others
    n_informative: int
    n_payload: int
    n_unknown: tuple[int, int]  # unknown directions now, and expected with the plan
    # `calib.fit.payload.told_widths` now, and expected
    half_width_kg: tuple[tuple[float, float], tuple[float, float]] | None


def save_recorded(path: Path, recorded: Recorded) -> None:
    """Write the poses of a calibration; raises as `write_sealed` does."""
    entries = entries_of(KIND, recorded)
    if recorded.covariance is None:
        del entries[f"{KIND}.covariance"]
    write_sealed(path, entries, KIND)


def load_recorded(path: Path, spec: ArmSpec) -> Recorded:
    """Read the poses of the calibration of `spec`.

    Raises:
        SealedFileError: the file is missing, damaged, or of another arm.
    """
    arrays = read_sealed(path, KIND, "python -m calib run")
    # An earlier version fitted other parameters: their covariance follows from the poses
    known, n = f"{KIND}.covariance", len(priors(spec))
    if known in arrays and arrays[known].shape != (n, n):
        arrays = {name: values for name, values in arrays.items() if name != known}
    entries = Entries(arrays, str(path))
    shapes = {
        "pressure_kpa": ((None, spec.n_chambers),),
        "payload_kg": ((None,),),
        "error_mm": ((None,),),
        "scale": ((2, 3), (2, 4)),
    }
    if known in arrays:
        shapes["covariance"] = ((n, n),)
    found = Recorded(**{name: entries.take(f"{KIND}.{name}", np.float64, *s) for name, s in shapes.items()})
    entries.finish(1)
    return found


def plan(arm: CalibratedArm, recorded: Recorded, n: int, seed: int) -> Plan:
    """Choose poses to record.

    Args:
        arm: calibrated arm.
        recorded: poses of its calibration.
        n: number of poses to choose.
        seed: seed of the candidates and of the draw.
    """
    # Draw candidates, and choose informative poses among them.
    (spec, _, held), rng = arm, np.random.default_rng(seed)
    tolerance = tolerances(spec)
    candidates, spring_m = _candidates(spec, min(20 * n, MAX_CANDIDATES), rng)
    covariance = _covariance(spec, recorded)
    before = n_unknown(covariance)
    payload = np.full(len(candidates), spec.mass.payload_kg)
    options = _derivatives(spec, candidates, payload, recorded.scale) * tolerance / MARGIN
    informative, covariance = choose_informative(options, covariance, n - round(SHARE_FAR * n))
    # Choose poses for the payload, where it is not known.
    telling, widths_kg = np.array([], int), None
    if held is not None:
        states = spring_m, candidates
        at, known = payload_poses(arm), informed(held, *(x[informative] for x in states))
        if np.median(payload_half_widths(known, at, 0.0)) > KNOWN_SHARE * spec.mass.largest_payload_kg:
            n_left = n - round(SHARE_FAR * n) - len(informative)
            telling = choose_for_payload(known, at, *states, n_left, informative)
        then = informed(known, *(x[telling] for x in states))
        before_kg, then_kg = (told_widths(x, at, spec.mass.largest_payload_kg) for x in (held, then))
        widths_kg = before_kg, then_kg
    # Choose poses far from all others; all but the first add to the information, too.
    chosen = np.concatenate([informative, telling])
    far = choose_far(spec, recorded, candidates, chosen, n - len(chosen), rng)
    left = options[np.concatenate([telling, far])].reshape(-1, len(tolerance))
    covariance = np.linalg.inv(np.linalg.inv(covariance) + left.T @ left)
    pressure_kpa = candidates[np.concatenate([chosen, far])]
    unknown = before, n_unknown(covariance)
    return Plan(pressure_kpa, len(informative), len(telling), unknown, widths_kg)


def _covariance(spec: ArmSpec, recorded: Recorded) -> np.ndarray:
    """Return the covariance (p, p) of a calibration's parameters, in units of their tolerances."""
    tolerance = tolerances(spec)
    if recorded.covariance is not None:
        return recorded.covariance / np.outer(tolerance, tolerance)
    rows = _derivatives(spec, recorded.pressure_kpa, recorded.payload_kg, recorded.scale)
    scaled, prior = rows.reshape(-1, len(tolerance)) * tolerance, np.diag((tolerance / priors(spec)) ** 2)
    return MARGIN**2 * np.linalg.inv(prior + scaled.T @ scaled)


def n_unknown(covariance: np.ndarray) -> int:
    """Return the number of directions of a covariance (p, p), in units of tolerances, that are not known."""
    widths = QUANTILE * np.sqrt(np.linalg.eigvalsh(covariance))
    return int(np.count_nonzero(widths > 1.0))


def choose_informative(options: np.ndarray, covariance: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose up to n poses by A-optimality; fewer once no direction is unknown.

    Args:
        options (m, k, p): derivatives of each candidate's k measurements, in units of scales and tolerances.
        covariance (p, p): covariance of the parameters before, in units of their tolerances.
        n: greatest number of poses.

    Returns:
        Indices of the chosen candidates, and the covariance with them.
    """
    chosen: list[int] = []
    left = np.ones(len(options), bool)
    while len(chosen) < n and n_unknown(covariance) > 0:
        # Compute how much each candidate would reduce the sum of the variances.
        spread = options @ covariance  # (m, k, p)
        inner = np.eye(options.shape[1]) + spread @ np.swapaxes(options, 1, 2)
        reduction = np.trace(np.linalg.solve(inner, spread @ np.swapaxes(spread, 1, 2)), axis1=1, axis2=2)
        # Add the best candidate.
        best = int(np.argmax(np.where(left, reduction, -np.inf)))
        chosen.append(best)
        left[best] = False
        covariance = covariance - spread[best].T @ np.linalg.solve(inner[best], spread[best])
    return np.array(chosen, int), covariance


def choose_far(
    spec: ArmSpec,
    recorded: Recorded,
    candidates: np.ndarray,
    taken: np.ndarray,
    n: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draw n candidates (m, n_chambers) far from poses, recorded or taken; return their indices."""
    # Weigh candidates by the errors of the poses nearest to them.
    span = spec.chambers.pressure_max_kpa - spec.chambers.pressure_min_kpa
    candidates, known = (_acting(spec, kpa) for kpa in (candidates, recorded.pressure_kpa))
    square = np.mean((candidates[:, None] - known) ** 2, axis=-1) / span**2
    near = np.argsort(square, axis=1)[:, :N_NEAREST]
    ratio = recorded.error_mm[near].mean(axis=1) / recorded.error_mm.mean()
    weight = np.clip(ratio, 1.0 / MAX_ERROR_RATIO, MAX_ERROR_RATIO)
    # Draw by the square of the distance, anew after each pose.
    away = square.min(axis=1)

    def keep_away(k: int) -> np.ndarray:
        return np.minimum(away, np.mean((candidates - candidates[k]) ** 2, axis=1) / span**2)

    for k in taken:
        away = keep_away(k)
    found: list[int] = []
    for _ in range(n):
        chance = weight * away
        found.append(int(rng.choice(len(candidates), p=chance / chance.sum())))
        away = keep_away(found[-1])
    return np.array(found, int)


def _acting(spec: ArmSpec, pressure_kpa: np.ndarray) -> np.ndarray:
    """Return pressures (m, n_chambers) without the part that neither stretches nor bends a section."""
    matrices = allocation(spec)
    return pressure_kpa if matrices is None else pressure_kpa - pressure_kpa @ matrices.redundant


def _candidates(spec: ArmSpec, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw pressures (m, n_chambers) at which the arm settles: random, extreme, equal within sections.

    Beside them stand the spring lengths (m, n_springs) [m] that they make.

    With equal pressures a section is straight; long and short straight arms tell a shift of the base from a
    tilt.
    """
    third = -(-n // 3)
    extremes = rng.choice(pressure_levels(spec), (third, spec.n_chambers))
    per_section = spec.structure.chambers_per_section
    equal = np.repeat(random_pressures(spec, third, rng)[:, ::per_section], per_section, axis=1)
    drawn = np.concatenate([random_pressures(spec, third, rng), extremes, equal])
    found = settle_many(spec, drawn)
    return drawn[found.settled], np.asarray(found.spring_m[found.settled], float)


def _derivatives(
    spec: ArmSpec, pressure_kpa: np.ndarray, payload_kg: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Return derivatives (n, m, p) of measurements over their scales; zero where the arm does not settle."""
    rotation = np.asarray(settle_many(spec, pressure_kpa).tip_rotation)
    measured = unmeasured(spec, pressure_kpa, payload_kg, rotation)
    error, slope, _ = simulate(spec, measured, np.zeros(len(priors(spec))))
    straight, kind = np.divmod(error_groups(spec, pressure_kpa), N_KINDS)
    seen = kind[0] < scale.shape[1]
    settled = np.isfinite(error[:, 0]) & np.isfinite(slope).all(axis=(1, 2))
    sigma = scale[straight[:, seen], kind[:, seen]]
    return np.where(settled[:, None, None], slope[:, seen], 0.0) / sigma[..., None]
