"""Accuracy of the payload that springs and pressures show, over the workspace.

A payload m changes the pressures that hold given springs by m e. The residual pressures of the sections
(`mjx_softarm.sensing.held_pressures`) have the covariances v_s V_s. By generalised least squares, the
variance of the payload is the inverse of the information

    I = sum_s e_s^T V_s^-1 e_s / v_s.

The log of an unloaded arm does not show e, but it shows how the tip rises with the springs. By the principle
of virtual work, chambers of effective areas A that lift a payload at the height z do the work

    m g dz = sum_t A_t dp_t dc_t    for all changes dc of the chambers' lengths.

So where the sim-to-real network raises the simulated tip by h, e grows by g (dh / dc) / A. A real arm's tip
lies up to some centimetres aside of the simulated one, which is a lever of a payload. At random poses of rods
100 to 104, 500 g are estimated with RMS errors of 23 to 47 g; without this part of e, 26 to 61 g. On the
circle with 1 kg it helps three of them.

What is left of e is a factor that is alike for all chambers and for poses that are alike. Poses with a known
weight show it (`fit_payload_scale`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from calib.arm import CalibratedArm
from calib.fit.held_pressures import effective_area_m2, hysteresis_kpa, without_redundant_part
from calib.fit.s2r import BATCH, simulate_poses, without_limits
from calib.read.static_poses import StaticPoses
from mjx_softarm._support import xla
from mjx_softarm.control import chambers_of_springs
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import arms_at_once, settle
from mjx_softarm.mechanics.statics import GRAVITY_M_S2
from mjx_softarm.mechanics.workspace import settle_many
from mjx_softarm.sensing.held_pressures import HeldPressures, covariances, factor_covariance, residual
from mjx_softarm.sensing.load import COMMON_FACTOR, N_PASSES, QUANTILE
from mjx_softarm.sensing.s2r import S2R, corrected

N_POSES, SEED = 400, 1  # poses over the workspace, and their seed
# Poses with a known weight: fewer do not show how far they scatter. Least weight, as a share of the largest
# payload: less is hardly above errors of the pressures.
MIN_WEIGHED, LEAST_WEIGHT = 8, 0.25
MOST_OFF = 0.3  # six standard deviations of a factor
# Standard deviation of a fitted factor at poses like those of the fit. On the circle of rods 100 to 104,
# which no experiment uses, 500 g give the factor of 1 kg to 0.007. Factors of random poses are off there by
# 0.037.
LEFT_FACTOR = 0.02


class PayloadPoses(NamedTuple):
    """Poses of the simulated arm over its workspace, and the effect of payloads on them."""

    spring_m: np.ndarray  # (m, n_springs)
    pressure_kpa: np.ndarray  # (m, n_chambers) that hold these springs without a payload
    effect_kpa_per_kg: np.ndarray  # (m, n_chambers) change of these pressures by a payload


def payload_poses(arm: CalibratedArm, n: int = N_POSES, seed: int = SEED) -> PayloadPoses:
    """Return poses at n random pressures, without those at which the arm does not settle."""
    settled = settle_many(arm.spec, random_pressures(arm.spec, n, seed))
    at, both = held_at(arm, np.asarray(settled.spring_m)[settled.settled])
    return PayloadPoses(*(values[both] for values in at))


def held_at(arm: CalibratedArm, spring_m: np.ndarray) -> tuple[PayloadPoses, np.ndarray]:
    """Return springs (m, n_springs) [m] with what holds them, and a mask (m,) of those that are held."""
    spec, payload_kg = arm.spec, arm.spec.mass.largest_payload_kg
    arms = (spec.replace(mass={"payload_kg": spec.mass.payload_kg + kg}) for kg in (0.0, payload_kg))
    light, heavy = (simulate_poses(arm, spring_m) for arm in arms)
    effect = (heavy.pressure_kpa - light.pressure_kpa) / payload_kg + effect_of_s2r(arm, spring_m)
    factor = 1.0 if arm.held is None else arm.held.factor
    return PayloadPoses(spring_m, light.pressure_kpa, factor * effect), light.valid & heavy.valid


def effect_of_s2r(arm: CalibratedArm, spring_m: np.ndarray) -> np.ndarray:
    """Return by how much S2R changes the effect (m, n_chambers) [kPa / kg] of a payload; 0 without S2R."""
    spec, s2r = arm.spec, arm.s2r
    if s2r is None:
        return np.zeros((len(spring_m), spec.n_chambers))
    # With half of the largest payload the derivative is the mean one up to the largest.
    half_kg = spec.mass.payload_kg + spec.mass.largest_payload_kg / 2
    params = without_limits(spec.replace(mass={"payload_kg": half_kg}))
    rise = _rises(arms_at_once(spec.n_links))
    rises = xla.in_batches(lambda rows: rise(rows, params, s2r), BATCH, spring_m)
    force_n = GRAVITY_M_S2 * rises @ np.linalg.pinv(chambers_of_springs(spec))
    return without_redundant_part(1e-3 * force_n / effective_area_m2(spec, spring_m), spring_m, spec)


@functools.cache
def _rises(n_at_once: int | None) -> Callable[..., Array]:
    """Return a program for the derivative (..., n_springs) of the payload's rise by S2R, by the springs."""

    def rise_m(reference_m: Array, params: ArmParams, s2r: S2R) -> Array:
        end = settle(params, reference_m, n_at_once)
        frame = end.tip_position_m, end.tip_rotation
        simulated_m, real_m = (_height_m(at, params) for at in (frame, corrected(s2r, frame, end.spring_m)))
        return real_m - simulated_m

    return xla.jit(jax.vmap(jax.grad(rise_m), in_axes=(0, None, None)))


def _height_m(frame: tuple[Array, Array], params: ArmParams) -> Array:
    """Return the height () [m] of the payload below a tip; the length of its axes does not matter."""
    position_m, rotation = frame
    axis = rotation[:, 2] / jnp.linalg.norm(rotation[:, 2])
    return position_m[2] - params.tool_offset_m[-1] * axis[2]


def payload_intervals(held: HeldPressures, at: PayloadPoses, largest_kg: float) -> tuple[float, float]:
    """Return the accuracy of payloads over the workspace, as half-widths [kg] of 95 % intervals.

    Returns:
        Median over the poses without a payload; 95 % of the poses with the largest payload have less.
    """

    def half_widths(payload_kg: float) -> np.ndarray:
        effect = at.effect_kpa_per_kg
        covariance = _covariance(held, at, np.full(len(effect), payload_kg))
        information = np.einsum("mi,mi->m", effect, np.linalg.solve(covariance, effect[..., None])[..., 0])
        return QUANTILE / np.sqrt(information)

    return float(np.median(half_widths(0.0))), float(np.quantile(half_widths(largest_kg), 0.95))


def estimated_payload(
    arm: CalibratedArm, spring_m: np.ndarray, pressure_kpa: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return payloads (m,) [kg] of arms at rest, and half-widths (m,) of their 95 % intervals.

    The covariance depends a little on the payload itself, so the estimate is repeated once.

    Args:
        arm: calibrated arm, with residual pressures.
        spring_m (m, n_springs) [m]: spring lengths.
        pressure_kpa (m, n_chambers) [kPa]: measured pressures.
    """
    (at, _), held = held_at(arm, spring_m), arm.held
    assert held is not None  # the steps see to it
    effect, predicted = at.effect_kpa_per_kg, residual(held, spring_m, at.pressure_kpa)
    left_kpa = pressure_kpa - at.pressure_kpa - predicted.mean_kpa.reshape(effect.shape)
    payload_kg, variance = np.zeros(len(spring_m)), np.zeros(len(spring_m))
    for _ in range(N_PASSES):
        weight = np.linalg.solve(_covariance(held, at, payload_kg), effect[..., None])[..., 0]
        variance = 1.0 / np.sum(weight * effect, axis=1)
        payload_kg = variance * np.sum(weight * left_kpa, axis=1)
    return payload_kg, QUANTILE * np.sqrt(variance)


class PayloadScaleFit(NamedTuple):
    """Factor of all payloads by poses with a known weight, and the estimate of the weight itself."""

    ratio: float  # estimated payload over the weight
    factor: float  # new `HeldPressures.factor`
    factor_sd: float
    n: int  # poses

    @property
    def is_plausible(self) -> bool:
        """Whether an arm can feel payloads so; otherwise the logged weight is wrong, or the arm changed."""
        return abs(self.ratio - 1.0) < MOST_OFF


def fit_payload_scale(arm: CalibratedArm, poses: StaticPoses, rows: np.ndarray) -> PayloadScaleFit:
    """Fit the factor of payloads to poses with a known weight.

    Args:
        arm: calibrated arm, with residual pressures; its factor is what is believed so far.
        poses: poses with spring lengths, in the order of time, which hysteresis follows.
        rows (k,): indices of `MIN_WEIGHED` poses or more with weights of `LEAST_WEIGHT` or more.
    """
    spec, held = arm.spec, arm.held
    assert held is not None  # the steps see to it
    # Estimate the weights from the pressures that remain
    weight_kg, spring_m = poses.payload_kg[rows] - spec.mass.payload_kg, poses.spring_m[rows]
    kpa = without_redundant_part(poses.pressure_kpa[rows], spring_m, spec)
    kpa = kpa - hysteresis_kpa(spec, held, poses.spring_m)[rows] - spec.unmodelled_kpa
    estimated_kg, _ = estimated_payload(arm, spring_m, kpa)
    # Least squares for their ratio, with a prior: the part of a factor's deviation that a weight shows
    information, prior = np.sum(weight_kg**2), COMMON_FACTOR**2 - LEFT_FACTOR**2
    ratio = np.sum(estimated_kg * weight_kg) / information
    variance = np.sum((estimated_kg - ratio * weight_kg) ** 2) / (len(rows) - 1) / information
    share = prior / (prior + variance)
    factor, sd = held.factor * (1.0 + share * (ratio - 1.0)), np.sqrt(share * variance + LEFT_FACTOR**2)
    return PayloadScaleFit(float(ratio), float(factor), float(sd), len(rows))


def _covariance(held: HeldPressures, at: PayloadPoses, payload_kg: np.ndarray) -> np.ndarray:
    """Return covariances (m, n, n) [kPa^2] of the pressures that hold arms with payloads (m,) [kg]."""
    effect = payload_kg[:, None] * at.effect_kpa_per_kg
    share = residual(held, at.spring_m, at.pressure_kpa).share
    of_factor = factor_covariance(held, effect.shape[1])
    return covariances(held, share) + effect[:, :, None] * of_factor * effect[:, None]
