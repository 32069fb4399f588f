"""Stiffness, area and rest length of each chamber, from the poses of the arm at rest.

The simulated arm at rest at the measured pressures is compared with what was measured: tip position, tip
orientation and, where they were logged, spring lengths. Least squares over three numbers per chamber: the
logarithms of its stiffness and of its area (whose slope goes along), and its rest length.

The fit is Gauss-Newton, damped after Levenberg and Marquardt, with Huber's weights: from the specification's
values it is done in three to five steps, while a general optimiser that sees the gradient alone needs some
hundred. The Jacobian is exact; see `mjx_softarm.settle.equilibrium`.

What can be told apart: masses and backbone are held at the specification's values, and gravity gives the
scale of all forces. Poses of one kind, such as all chambers at one pressure, leave directions open: the
intervals grow, and a warning says which chamber's.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from calib.blocks import held_out_blocks
from calib.network import block_rows
from mjx_softarm.kinematics import chain_frames
from mjx_softarm.settle import RESIDUAL_TOLERANCE, equilibrium
from mjx_softarm.spec import ArmSpec
from mjx_softarm.statics import ArmParams, statics

BATCH = 256
HELD_OUT_SHARE = 0.2
MAX_STEPS = 30
HUBER = 1.345  # Huber's constant, in standard deviations
MIN_POSES = 60
INTERVAL = 1.96  # standard deviations
MAX_INTERVAL = 0.05  # relative, of stiffness and area
FIRST_NOISE = (1.0, 0.5, 1.0)  # [mm, deg, mm] of tip, orientation, springs: of the first round's weights
PARAMETERS = ("stiffness", "area", "rest length")


class Poses(NamedTuple):
    """The arm at rest, as measured; springs that were not measured are NaN."""

    pressure_kpa: np.ndarray  # (n, n_chambers)
    tip_m: np.ndarray  # (n, 3)
    tip_rotation: np.ndarray  # (n, 3, 3)
    spring_m: np.ndarray  # (n, n_chambers)
    payload_kg: np.ndarray  # (n,)


class TipErrors(NamedTuple):
    """Simulated against measured tip."""

    mean_mm: float
    p95_mm: float
    mean_deg: float


@dataclass(frozen=True, eq=False)
class ChamberFit:
    """Calibrated chambers and whether to trust them."""

    spec: ArmSpec
    stiffness_interval: np.ndarray  # (n,) half width of the 95 % interval, relative
    area_interval: np.ndarray  # (n,) relative
    offset_interval_m: np.ndarray  # (n,)
    in_sample: TipErrors
    held_out: TipErrors
    held_out_before: TipErrors  # with the specification that the fit began with
    predicted_m: np.ndarray  # (n, 3) simulated tips of the calibrated arm
    measured_m: np.ndarray  # (n, 3)
    is_held_out: np.ndarray  # (n,) bool
    n_poses: int
    n_unsettled: int  # of them, left out
    warnings: tuple[str, ...]


def fit_chambers(poses: Poses, spec: ArmSpec, seed: int = 0) -> ChamberFit:
    """Chambers that make the simulated arm reach the measured poses.

    Args:
        poses: at rest, in time's order.
        spec: where the fit begins; springs calibrated.
        seed: of the blocks that are held out.

    Raises:
        ValueError: fewer poses than numbers to fit need.
    """
    n, k = len(poses.pressure_kpa), spec.n_chambers
    if n < MIN_POSES:
        raise ValueError(f"chambers: got {n} poses at rest, expected at least {MIN_POSES}")
    held_out = held_out_blocks(n, HELD_OUT_SHARE, block_rows(n), seed)
    problem = _Problem(poses, spec)
    theta, noise = np.zeros((3, k)), np.array(FIRST_NOISE)
    for _ in range(2):  # the second round weighs by what the first one left
        theta, sigma = _least_squares(problem, theta, noise, ~held_out)
        noise = problem.spread(theta, ~held_out)
    residual, _, settled = problem.linearise(theta)
    before, _, settled_before = problem.linearise(np.zeros_like(theta))
    interval = INTERVAL * sigma
    fitted = _calibrated(spec, theta)
    errors = [
        _tip_errors(residual[held_out & settled]),
        _tip_errors(residual[~held_out & settled]),
        _tip_errors(before[held_out & settled_before]),
    ]
    return ChamberFit(
        spec=fitted,
        stiffness_interval=interval[0],
        area_interval=interval[1],
        offset_interval_m=1e-3 * interval[2],
        held_out=errors[0],
        in_sample=errors[1],
        held_out_before=errors[2],
        predicted_m=poses.tip_m + 1e-3 * residual[:, :3],
        measured_m=poses.tip_m,
        is_held_out=held_out,
        n_poses=n,
        n_unsettled=int(np.sum(~settled)),
        warnings=tuple(_warnings(interval, errors, int(np.sum(~settled)), n)),
    )


class _Problem:
    """Residuals (n, 6 + k): tip [mm], orientation [deg], springs [mm], simulated less measured."""

    def __init__(self, poses: Poses, spec: ArmSpec):
        self.n, self.spec = len(poses.pressure_kpa), spec
        self.base = jax.tree.map(jnp.asarray, ArmParams.from_spec(spec))
        padded = -(-self.n // BATCH) * BATCH
        rows = [np.resize(np.asarray(x, np.float32), (padded, *x.shape[1:])) for x in poses]
        self.batches = [Poses(*(x[first : first + BATCH] for x in rows)) for first in range(0, padded, BATCH)]

    def linearise(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (n, m), Jacobian (n, m, 3 k), NaN where not measured, and what settled (n,)."""
        at = jnp.asarray(theta, jnp.float32)
        parts = [jax.device_get(_linearise(at, self.base, batch)) for batch in self.batches]
        residual, jacobian, settled = (np.concatenate(x)[: self.n] for x in zip(*parts, strict=True))
        return residual, jacobian.reshape(*residual.shape, -1), settled

    def spread(self, theta: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Robust standard deviations (3,) of what is left of tip, orientation and springs."""
        residual, _, settled = self.linearise(theta)
        left = residual[rows & settled]
        kinds = (left[:, :3], left[:, 3:6], left[:, 6:])
        found = [1.4826 * np.nanmedian(np.abs(x)) if np.isfinite(x).any() else np.inf for x in kinds]
        return np.maximum(found, 1e-3)


@jax.jit
def _linearise(theta: Array, base: ArmParams, poses: Poses) -> tuple[Array, Array, Array]:
    def one(pose: Poses):
        jacobian, (residual, settled) = jax.jacfwd(_residual, has_aux=True)(theta, base, pose)
        return residual, jacobian, settled

    return jax.vmap(one)(poses)


def _residual(theta: Array, base: ArmParams, pose: Poses) -> tuple[Array, tuple[Array, Array]]:
    params = _with_chambers(base, theta)
    params = params._replace(tool_mass_kg=params.tool_mass_kg.at[1].set(pose.payload_kg))
    q = equilibrium(params, pose.pressure_kpa)
    frames = chain_frames(q, params.link_length_m)
    rest = statics(frames, q, pose.pressure_kpa, params)
    turn = frames.plate_rotation[-1] @ pose.tip_rotation.T
    axis = 0.5 * jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    residual = jnp.concatenate(
        [
            1e3 * (frames.plate_position[-1] - pose.tip_m),
            jnp.rad2deg(axis),  # sine of the angle, times the axis
            1e3 * (rest.springs.length - pose.spring_m),
        ]
    )
    settled = jnp.max(jnp.abs(rest.gradient)) < RESIDUAL_TOLERANCE
    return residual, (residual, settled)


def _with_chambers(base: ArmParams, theta: Array) -> ArmParams:
    stiffness, area, offset_mm = theta
    return base._replace(
        chamber_stiffness=base.chamber_stiffness * jnp.exp(stiffness),
        area=base.area * jnp.exp(area),
        area_slope=base.area_slope * jnp.exp(area),
        chamber_rest_m=base.chamber_rest_m + 1e-3 * offset_mm,
    )


def _calibrated(spec: ArmSpec, theta: np.ndarray) -> ArmSpec:
    """The specification with the chambers of `_with_chambers`."""
    old = {name: np.array(spec.per_chamber(getattr(spec.chambers, name))) for name in _FITTED}
    stiffness, area, offset_mm = theta
    new = {
        "stiffness_n_per_m": old["stiffness_n_per_m"] * np.exp(stiffness),
        "area_m2": old["area_m2"] * np.exp(area),
        "area_slope_m": old["area_slope_m"] * np.exp(area),
        "length_offset_m": old["length_offset_m"] + 1e-3 * offset_mm,
    }
    return spec.replace(chambers={name: tuple(map(float, value)) for name, value in new.items()})


_FITTED = ("stiffness_n_per_m", "area_m2", "area_slope_m", "length_offset_m")


def _least_squares(
    problem: _Problem, theta: np.ndarray, noise: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (3, k) with the least robust cost, and their standard deviations (3, k)."""
    scale = np.repeat(noise, (3, 3, theta.shape[1]))
    evaluate = functools.partial(_normal_equations, problem, scale=scale, rows=rows)
    cost, normal, slope = evaluate(theta)
    damping = 1e-3
    for _ in range(MAX_STEPS):
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -slope).reshape(theta.shape)
        trial = evaluate(theta + step)
        if trial[0] < cost:
            theta, (cost, normal, slope), damping = theta + step, trial, damping / 10
            if np.max(np.abs(step)) < 1e-4:
                break
        elif damping > 1e6:
            break
        else:
            damping *= 10
    return theta, np.sqrt(np.diag(np.linalg.pinv(normal))).reshape(theta.shape)


def _normal_equations(
    problem: _Problem, theta: np.ndarray, scale: np.ndarray, rows: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mean cost, weighted J^T J and J^T r. A pose that does not settle costs as one far off."""
    residual, jacobian, settled = problem.linearise(theta)
    used = rows & settled
    r = (residual[used] / scale).ravel()
    jacobian = (jacobian[used] / scale[:, None]).reshape(len(r), -1)
    known = np.isfinite(r) & np.isfinite(jacobian).all(axis=1)
    r, jacobian = r[known], jacobian[known]
    size = np.abs(r)
    weight = np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
    cost = np.sum(np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER)))
    cost += np.sum(rows & ~settled) * 100.0
    weighted = jacobian * weight[:, None]
    return float(cost), weighted.T @ jacobian, weighted.T @ r


def _tip_errors(residual: np.ndarray) -> TipErrors:
    distance = np.linalg.norm(residual[:, :3], axis=1)
    turn = np.linalg.norm(residual[:, 3:6], axis=1)
    return TipErrors(float(distance.mean()), float(np.quantile(distance, 0.95)), float(turn.mean()))


def _warnings(interval: np.ndarray, errors: list[TipErrors], n_unsettled: int, n: int) -> list[str]:
    held_out, in_sample, before = errors
    found = [
        f"chamber {chamber}: {name} known to +-{100 * widths[chamber]:.0f} % only; log poses in which its "
        "pressure differs more from the others'"
        for name, widths in zip(PARAMETERS[:2], interval[:2], strict=True)
        for chamber in np.flatnonzero(~(widths < MAX_INTERVAL))
    ]
    got = f"tip: {held_out.mean_mm:.2g} mm on held-out poses"
    if held_out.mean_mm > 2.0 * in_sample.mean_mm:
        found.append(f"{got}, far more than {in_sample.mean_mm:.2g} mm in the fit")
    if held_out.mean_mm > before.mean_mm:
        found.append(f"{got}, {before.mean_mm:.2g} mm without the fit")
    if n_unsettled > 0.02 * n:
        found.append(f"{n_unsettled} of {n} poses did not settle in simulation and were left out")
    return found
