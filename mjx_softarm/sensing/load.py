"""Payload of an arm at rest, estimated from springs and pressures, and averaged. NumPy and JAX.

The sensor-space law holds the springs where they were, so that only springs and pressures together show a
payload. A small network predicts from springs: the pressures p(l) that hold them without a payload, their
change e(l) by a payload, and how well the calibration knows p(l). The payload m follows by generalised least
squares from the measured pressures p, section by section:

    D = v(l) V + N + diag(f m e)^2,   I = sum e^T D^-1 e,   m = sum e^T D^-1 (p - p(l)) / I,

where p lacks the chambers' hysteresis (`mjx_softarm.sensing.hysteresis`), v(l) V is the calibration's
covariance (`mjx_softarm.sensing.held_pressures`), N that of the network's own error, and f are factors by
which chambers answer differently to a payload. The variance of m is 1 / I + (f' m)^2, where f' is a factor of
all chambers together.

A payload changes rarely, so estimates are averaged, until two in a row disagree with the average. Errors of
neighbouring poses are alike, so an average counts as no more certain than its estimates.

An estimate that is off moves the tip. So a difference d, with the standard deviation s, from the payload of
the specification is believed by the share 1 - s^2 / d^2. It has the least mean square error where the true
difference has the square d^2 - s^2, as it has in the mean.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.archive import Entries
from mjx_softarm._support.mlp import Layer, mlp
from mjx_softarm._support.xp import Array, array_namespace, solve

N_AVERAGED = 8  # number of estimates in the moving average
# An outlier is off the average by more than this share of the largest payload, and their intervals are apart.
JUMP = 0.25
N_JUMPS = 2  # number of consecutive outliers that restart the average
QUANTILE = 1.96  # half-width of a 95 % interval in standard deviations
KNOWN = 0.3  # greatest half-width, in largest payloads, of a 95 % interval that is believed; by hand
# Payloads in the network's data, as shares of the largest one: an interval outside holds no payload.
LOWEST, HIGHEST = -0.5, 1.5
# Standard deviations of the factors by which the simulated change is off. The first is of all chambers
# together, by masses and areas that are off by some per cent, until a known weight shows it. The second is of
# each chamber at each pose. Rods 100 to 104, which no experiment uses, have a little less: 0.04 and 0.08.
COMMON_FACTOR, OWN_FACTOR = 0.05, 0.09
N_PASSES = 2  # number of estimates; each takes D of the last


class LoadEstimator(NamedTuple):
    """Network from springs at rest to the pressures that hold them, with c chambers a section. All float32.

    Its outputs are the pressures without a payload [kPa] and their change by a payload [kPa / kg], both of
    all chambers, and the logarithm of each section's v.
    """

    layers: tuple[Layer, ...]  # normalised springs (n_springs,) -> normalised rest of the outputs (n_out,)
    slope: Array  # (n_springs, n_out) outputs, per normalised spring
    spring_centre_m: Array  # (n_springs,)
    spring_scale_m: Array  # (n_springs,)
    out_centre: Array  # (n_out,)
    out_scale: Array  # (n_out,) of the rest
    covariance_kpa2: Array  # (n_sections, c, c) V
    error_kpa2: Array  # (n_sections, c, c) N
    hysteresis_kpa: Array  # (n_chambers,) largest pressure of each chamber's hysteresis
    stroke_m: Array  # (n_chambers,) [m] stroke of its stop operator
    own_load_kg: Array  # () payload of the specification, on top of which m is
    load_scale_kg: Array  # () largest payload of the arm
    factor_sd: Array  # () standard deviation of f', see `COMMON_FACTOR`


class Holding(NamedTuple):
    """Pressures that hold springs at rest, by sections of c chambers."""

    pressure_kpa: Array  # (..., n_sections, c) without a payload
    effect_kpa_per_kg: Array  # (..., n_sections, c) change by a payload
    log_share: Array  # (..., n_sections) logarithm of v


class Load(NamedTuple):
    """Payload averaged over estimates."""

    kg: float
    n_estimates: int = 0  # estimates in the average, at most N_AVERAGED; with 0 the payload is assumed
    n_jumps: int = 0  # number of consecutive outliers
    began: bool = False  # whether the last estimate restarted the average
    half_width_kg: float = 0.0  # half-width of the 95 % interval, the mean of the estimates' own
    assumed_kg: float = 0.0  # payload without any estimate, the specification's

    @property
    def believed_kg(self) -> float:
        """Payload [kg] that the pose is estimated with, never negative."""
        off_kg, sd_kg = self.kg - self.assumed_kg, self.half_width_kg / QUANTILE
        known_kg = off_kg - sd_kg**2 / off_kg if abs(off_kg) > sd_kg else 0.0
        return max(self.assumed_kg + known_kg, 0.0)


def holding(estimator: LoadEstimator, spring_m: Array) -> Holding:
    """Predict the pressures that hold springs (..., n_springs) [m]."""
    xp = array_namespace(spring_m, estimator.slope)
    spring_m = xp.asarray(spring_m, dtype=estimator.slope.dtype)
    springs = (spring_m - estimator.spring_centre_m) / estimator.spring_scale_m
    rest = estimator.out_scale * mlp(estimator.layers, springs, "swish")
    out = estimator.out_centre + springs @ estimator.slope + rest
    n_sections, c = estimator.covariance_kpa2.shape[:2]
    both = out[..., : 2 * n_sections * c].reshape(*out.shape[:-1], 2, n_sections, c)
    return Holding(both[..., 0, :, :], both[..., 1, :, :], out[..., 2 * n_sections * c :])


def estimate_load(
    estimator: LoadEstimator, spring_m: Array, pressure_kpa: Array, stop: Array | float = 0.0
) -> tuple[Array, Array]:
    """Estimate the payload (...) [kg] of an arm at rest, and the half-width (...) [kg] of its 95 % interval.

    The payload may lie below 0 or above `load_scale_kg`.

    Args:
        spring_m (..., n_springs) [m]: spring lengths.
        pressure_kpa (..., n_chambers) [kPa]: pressures.
        stop (..., n_chambers): states of the chambers' hysteresis; 0 where the way to this pose is not known.
    """
    xp = array_namespace(spring_m, pressure_kpa, estimator.slope)
    predicted = holding(estimator, spring_m)
    effect = predicted.effect_kpa_per_kg
    pressure_kpa = xp.asarray(pressure_kpa, dtype=estimator.slope.dtype)
    pressure_kpa = pressure_kpa - estimator.hysteresis_kpa * xp.asarray(stop, dtype=estimator.slope.dtype)
    left_kpa = pressure_kpa.reshape(*effect.shape) - predicted.pressure_kpa
    known = xp.exp(predicted.log_share)[..., None, None] * estimator.covariance_kpa2 + estimator.error_kpa2
    each = np.eye(effect.shape[-1], dtype=estimator.slope.dtype) * (OWN_FACTOR * effect[..., None]) ** 2
    kg = variance = xp.zeros_like(effect[..., 0, 0])
    for _ in range(N_PASSES):
        weight = solve(known + (kg**2)[..., None, None, None] * each, effect)
        variance = 1.0 / xp.sum(weight * effect, axis=(-2, -1))
        kg = variance * xp.sum(weight * left_kpa, axis=(-2, -1))
    return estimator.own_load_kg + kg, QUANTILE * xp.sqrt(variance + (estimator.factor_sd * kg) ** 2)


def holds_payload(estimate_kg: float, half_width_kg: float, largest_kg: float) -> bool:
    """Return whether the interval of an estimate holds a payload; not where the estimate is NaN."""
    low_kg, high_kg = LOWEST * largest_kg, HIGHEST * largest_kg
    return estimate_kg + half_width_kg >= low_kg and estimate_kg - half_width_kg <= high_kg


def averaged(load: Load, estimate_kg: float, half_width_kg: float, largest_kg: float) -> Load:
    """Return the average with one more estimate and its half-width, for an arm with this largest payload."""
    off_kg = abs(estimate_kg - load.kg)
    far = off_kg > JUMP * largest_kg and off_kg > half_width_kg + load.half_width_kg
    disagrees = load.n_estimates > 0 and far
    if disagrees and load.n_jumps + 1 < N_JUMPS:
        return load._replace(n_jumps=load.n_jumps + 1)
    if disagrees or load.n_estimates == 0:
        return Load(estimate_kg, 1, 0, disagrees, half_width_kg, load.assumed_kg)
    n = min(load.n_estimates + 1, N_AVERAGED)
    kg = load.kg + (estimate_kg - load.kg) / n
    width_kg = load.half_width_kg + (half_width_kg - load.half_width_kg) / n
    return Load(kg, n, 0, False, width_kg, load.assumed_kg)


def take_load_estimator(entries: Entries, n_sections: int, n_chambers: int, n_springs: int) -> LoadEstimator:
    """Take the load estimator from the entries of a file."""
    n_out, c = 2 * n_chambers + n_sections, n_chambers // n_sections
    return entries.network(
        "load_estimator",
        LoadEstimator,
        slope=(n_springs, n_out),
        spring_centre_m=(n_springs,),
        spring_scale_m=(n_springs,),
        out_centre=(n_out,),
        out_scale=(n_out,),
        covariance_kpa2=(n_sections, c, c),
        error_kpa2=(n_sections, c, c),
        hysteresis_kpa=(n_chambers,),
        stroke_m=(n_chambers,),
        own_load_kg=(),
        load_scale_kg=(),
        factor_sd=(),
        layers=(n_springs, n_out),
    )
