"""Stiffness, effective area and length of each chamber, fitted to poses of the arm at rest.

The simulated arm rests at the logged pressures; its chambers are changed until tip poses, and spring lengths
where they were measured, agree. The Jacobian comes from the implicit function theorem (`calib.equilibrium`).
With it, a damped Gauss-Newton method with Huber's weights needs four or five sets of settled arms.

Masses are known and set the scale of all forces. Springs and backbone are taken as the specification has
them: a chamber works beside them, so a backbone that is stiffer than specified appears as stiffer chambers. What the
poses cannot tell apart stays near the specification, by a weak prior, and is named.

Source: Huber, "Robust Estimation of a Location Parameter", Ann. Math. Statist. 35 (1964); intervals: White,
"A Heteroskedasticity-Consistent Covariance Matrix Estimator", Econometrica 48 (1980).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np

from calib.blocks import held_out_blocks
from calib.equilibrium import FIELDS, Measured, residuals
from calib.rests import Rests, find_rests
from mjx_softarm.logs import Log
from mjx_softarm.settle import RESIDUAL_TOLERANCE
from mjx_softarm.spec import ArmSpec
from mjx_softarm.statics import ArmParams

BATCH = 256
MIN_POSES = 20
ENOUGH_POSES = 100
HELD_OUT_SHARE = 0.2
HELD_OUT_BLOCK = 5  # poses
MAX_ITERATIONS = 12  # of each round
ROUNDS = 3  # the first with the scales below, the others with those of the residuals left
SMALL_STEP = 1e-4
SCALE = (1e-3, 0.01, 1e-3)  # of tip [m], rotation [rad] and springs [m]
MIN_SCALE = (1e-4, 1e-3, 1e-4)
HUBER = 2.0  # scales
UNSETTLED = 30.0  # scales of error that a pose counts where the simulated arm finds no rest
PRIOR = (1.0, 1.0, 1.0, 0.25)  # of each field of x: a factor of e; an area per section length; a quarter section
TOLERANCE = (0.05, 0.05, 0.05, 0.01)  # of x, within which a number counts as known: 5 %, ..., 1 % of a section
QUANTILE = 1.96  # of 95 % intervals


@dataclass(frozen=True)
class Errors:
    """Simulated against measured tips, over some poses."""

    n: int
    translation_mean_mm: float
    translation_95_mm: float
    rotation_mean_deg: float
    rotation_95_deg: float
    spring_rms_mm: float  # NaN where no spring was measured


@dataclass(frozen=True, eq=False)
class ChamberFit:
    """Calibrated chambers and whether to trust them.

    Attributes:
        spec: the calibrated arm: chambers, and the range of spring lengths that may be commanded.
        half_width_95: of the 95 % interval of each fitted field of `spec.chambers`, (n_chambers,) each.
        weak: directions in which the poses do not tell the numbers, in words; none is good.
        singular_values: of the weighted Jacobian in units of what counts as known, (4 * n_chambers,); below 2,
            a direction is not known.
        in_sample, held_out: errors of the calibrated arm; held-out poses took no part in the fit.
        in_sample_before, held_out_before: errors of the specification that the fit started from.
        rows: number of rows of the logs by what became of them.
        rests: the poses, for pictures.
        is_held_out: which of them took no part, (n,) bool.
        tip_error_mm: of the calibrated arm at each pose, (n,); NaN where it did not settle.
        n_unsettled: number of poses where the simulated arm found no rest.
        warnings: reasons not to trust the fit; none is good.
    """

    spec: ArmSpec
    half_width_95: Mapping[str, np.ndarray]
    weak: tuple[str, ...]
    singular_values: np.ndarray
    in_sample: Errors
    held_out: Errors
    in_sample_before: Errors
    held_out_before: Errors
    rows: Mapping[str, int]
    rests: Rests
    is_held_out: np.ndarray
    tip_error_mm: np.ndarray
    n_unsettled: int
    warnings: tuple[str, ...]


class _Solution(NamedTuple):
    x: np.ndarray  # (4 * n_chambers,)
    covariance: np.ndarray
    information: np.ndarray  # of the poses alone, without the prior
    converged: bool


def calibrate_chambers(logs: Log | Sequence[Log], spec: ArmSpec, seed: int = 0) -> ChamberFit:
    """Fit the chambers of an arm to its logs.

    Args:
        logs: with pressures and tip poses; frequencies or spring lengths help (see `calib.rests` for the
            rows that count).
        spec: the arm as it is believed to be, its sensors already calibrated.
        seed: chooses the poses that are held out, in contiguous blocks.

    Raises:
        ValueError: a log without pressures or tip poses, or too few poses at rest.
    """
    rests, rows = find_rests([logs] if isinstance(logs, Log) else logs, spec)
    if rests.n < MIN_POSES:
        found = ", ".join(f"{count} {fate}" for fate, count in rows.items())
        raise ValueError(
            f"chambers: got {rests.n} poses at rest, expected {MIN_POSES} or more; rows: {found or 'none'}"
        )
    held_out = held_out_blocks(rests.n, HELD_OUT_SHARE, HELD_OUT_BLOCK, seed)
    params = ArmParams.from_spec(spec)
    solution = _solve(params, rests.take(~held_out))
    before, _ = simulate_errors(np.zeros_like(solution.x), params, rests)
    after, settled = simulate_errors(solution.x, params, rests)
    width = QUANTILE * np.sqrt(np.diag(solution.covariance))
    calibrated = _calibrated(spec, solution.x, rests)
    values, vectors = _known(solution.information, solution.covariance)
    fit = ChamberFit(
        spec=calibrated,
        half_width_95=_physical(spec, solution.x, width),
        weak=tuple(_describe(v) for s, v in zip(*_directions(solution.covariance), strict=True) if s > 1.0),
        singular_values=values,
        in_sample=_errors(after[~held_out]),
        held_out=_errors(after[held_out]),
        in_sample_before=_errors(before[~held_out]),
        held_out_before=_errors(before[held_out]),
        rows=rows,
        rests=rests,
        is_held_out=held_out,
        tip_error_mm=1e3 * np.linalg.norm(after[:, :3], axis=1),
        n_unsettled=int(np.count_nonzero(~settled)),
        warnings=(),
    )
    return fit
