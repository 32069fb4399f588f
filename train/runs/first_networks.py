"""Networks for the arm's computer before they learn: random weights, and scales by an arm's poses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from calib.arm import CalibratedArm
from mjx_softarm._support.training import initial_layers
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.workspace import LoadedPool, Pool
from mjx_softarm.sensing.estimator import N_CHANGES, PoseEstimator, SpringModel
from mjx_softarm.sensing.load import COMMON_FACTOR, LoadEstimator
from mjx_softarm.spec import ArmSpec

WIDTH = 128  # width of the hidden layers
LEAST_REST = 1e-6  # least scale of an output's rest: an arm without a log has one variance everywhere
CHANGE_SCALE = 0.015  # scale of the pose network's outputs, in mean section lengths and half radians


def first_estimator(spec: ArmSpec, pool: LoadedPool, key: Array) -> PoseEstimator:
    """Return the pose network of an arm, scaled by poses of it; a load changes little at first."""
    n_sections = spec.structure.n_sections
    n_in, n_out = spec.n_springs + 3 * n_sections, N_CHANGES * n_sections
    scale = np.full(N_CHANGES, CHANGE_SCALE)
    scale[:3] *= spec.length_m / n_sections
    params = ArmParams.from_spec(spec)
    site_m = jnp.asarray(params.spring_site_m)
    load_layers = initial_layers(jax.random.fold_in(key, 1), (n_in + 1, WIDTH, WIDTH, n_out))
    *hidden, (weight, bias) = load_layers
    return PoseEstimator(
        layers=initial_layers(key, (n_in, WIDTH, WIDTH, n_out)),
        load_layers=(*hidden, (0.1 * weight, bias)),
        spring_site_m=site_m,
        **_scaling("spring", "m", pool.spring_m),
        load_centre_kg=jnp.asarray(spec.mass.payload_kg),
        load_scale_kg=jnp.asarray(spec.mass.largest_payload_kg),
        change_scale=jnp.asarray(scale),
        base_position_m=jnp.asarray(params.mount.base_position_m),
        base_rotation=jnp.asarray(params.mount.base_rotation),
    )


def first_load_estimator(
    arm: CalibratedArm, spring_m: Array, out: Array, covariance_kpa2: Array, key: Array
) -> LoadEstimator:
    """Return the payload network of an arm, with the plane that fits its outputs best.

    Args:
        arm: the arm, whose residual pressures tell the hysteresis.
        spring_m (n, n_springs) [m]: spring lengths.
        out (n, n_out): outputs of `LoadEstimator` there.
        covariance_kpa2 (n_sections, c, c): covariance of the residual pressures.
        key: key of the weights.
    """
    scaling, centre = _scaling("spring", "m", spring_m), jnp.mean(out, axis=0)
    springs = (spring_m - scaling["spring_centre_m"]) / scaling["spring_scale_m"]
    slope = jnp.linalg.lstsq(springs, out - centre)[0]
    rest = jnp.std(out - centre - springs @ slope, axis=0)
    (n_in, n_out), own_kg = slope.shape, arm.spec.mass.payload_kg
    held, at_chambers = arm.held, arm.spec.at_chambers
    return LoadEstimator(
        layers=initial_layers(key, (n_in, WIDTH, WIDTH, n_out)),
        slope=slope,
        **scaling,
        out_centre=centre,
        out_scale=jnp.maximum(rest, LEAST_REST),
        covariance_kpa2=covariance_kpa2,
        error_kpa2=jnp.zeros_like(covariance_kpa2),
        hysteresis_kpa=jnp.asarray(at_chambers(0.0 if held is None else tuple(held.hysteresis_kpa))),
        stroke_m=jnp.asarray(at_chambers(1.0 if held is None else tuple(held.stroke_m))),
        own_load_kg=jnp.asarray(own_kg),
        load_scale_kg=jnp.asarray(own_kg + arm.spec.mass.largest_payload_kg),
        factor_sd=jnp.asarray(COMMON_FACTOR if held is None else held.factor_sd),
    )


def first_spring_model(pool: Pool, key: Array) -> SpringModel:
    """Return the network from pressures to springs, scaled by poses of an arm."""
    n_chambers, n_springs = pool.pressure_kpa.shape[1], pool.spring_m.shape[1]
    return SpringModel(
        layers=initial_layers(key, (n_chambers, WIDTH, WIDTH, n_springs)),
        **_scaling("pressure", "kpa", pool.pressure_kpa),
        **_scaling("spring", "m", pool.spring_m),
    )


def _scaling(name: str, unit: str, values: Array) -> dict[str, Array]:
    """Return the fields of a network that standardise a quantity (n, ...)."""
    return {
        f"{name}_centre_{unit}": jnp.mean(values, axis=0),
        f"{name}_scale_{unit}": jnp.std(values, axis=0),
    }
