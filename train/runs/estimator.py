"""Small networks for the arm's computer, distilled from the simulator: of load, pose and springs.

Equilibria over the whole workspace are the data, held-out ones the test. `mjx_softarm.sensing.estimator` and
`mjx_softarm.sensing.load` describe the networks. The load is estimated from springs and pressures, for arms
whose chambers are off, since a calibration is not perfect either; the pose from springs and the load, for
arms as specified. A pose from pressures would take a chamber that is off for a shape.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm._support.mlp import Layer
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.workspace import (
    CANDIDATES_PER_POSE,
    HELD_OUT_SEED,
    LoadedPool,
    Pool,
    sample_loaded,
    sample_workspace,
)
from mjx_softarm.sensing.estimator import (
    N_CHANGES,
    PoseEstimator,
    SpringModel,
    estimate_frame,
    expected_springs,
)
from mjx_softarm.sensing.load import HIGHEST, LOWEST, LoadEstimator, estimate_load
from mjx_softarm.sensing.pose import frame_from_pose
from mjx_softarm.spec import ArmSpec

N_TRAINING, N_HELD_OUT = 16_384, 2_048
MORE_PRESSURE = 0.25  # share of the pressure range that is added at either end
N_STEPS = 8_000
BATCH = 256
WIDTH = 128
LEARNING_RATE = 4e-3  # at the start, with a cosine decay to zero
PAYLOADS = (0.0, 0.25, 0.5, 1.0)  # at which errors are given, as shares of the largest
CHAMBERS_OFF = 0.03  # share by which stiffness and area of a chamber may be off
TURN_MM = 50.0  # tip distance that costs as much as a turn by one radian
CHANGE_SCALE = 0.015  # scale of the network's outputs, in section lengths and half radians


class Error(NamedTuple):
    """Errors on held-out equilibria."""

    median: float
    p95: float
    largest: float


class Distilled(NamedTuple):
    """The networks with their errors on held-out equilibria."""

    estimator: PoseEstimator
    load_estimator: LoadEstimator
    spring_model: SpringModel
    tip_mm: dict[float, Error]  # with the load known, by payload [kg] on top of the specification's
    turn_deg: dict[float, Error]
    load_kg: dict[float, Error]  # of arms whose chambers are off
    spring_mm: dict[float, Error]  # of the spring with the largest error


def distil(spec: ArmSpec, seed: int) -> Distilled:
    """Return the networks of an arm; the same seed gives the same ones.

    Args:
        spec: the arm, calibrated or not.
        seed: seed of the equilibria, the initial weights and the batches.

    Raises:
        ValueError: the seed is the held-out one.
        SpecError: the arm settles at too few pressures.
    """
    if seed == HELD_OUT_SEED:
        raise ValueError(f"seed: got {seed}, which draws the held-out equilibria, expected another")
    key = jax.random.key(seed)
    key_pose, key_springs = jax.random.split(key)
    key_bend, key_load = (jax.random.fold_in(key, k) for k in (2, 3))
    poses = _with_load(sample_workspace(_stronger(spec), N_TRAINING, seed), spec.mass.payload_kg)
    loaded = _as_measured(spec, sample_loaded(spec, _loads(spec, seed), CHAMBERS_OFF, seed))
    estimator = _fit(_first_estimator(spec, poses, key_pose), _pose_loss, poses, key_pose)
    estimator = _fit(estimator, _pose_loss, loaded, key_bend, "load_layers")
    load_estimator = _fit(_first_load_estimator(spec, loaded, key_load), _load_loss, loaded, key_load)
    unloaded = _as_measured(spec, sample_workspace(spec, N_TRAINING, seed))
    springs = _fit(_first_spring_model(unloaded, key_springs), _spring_loss, unloaded, key_springs)
    pose, load, springs = jax.tree.map(
        lambda x: np.asarray(x, np.float32), (estimator, load_estimator, springs)
    )
    return Distilled(pose, load, springs, *_errors(pose, load, springs, spec))


def _with_load(pool: Pool, load_kg: float) -> LoadedPool:
    return LoadedPool(jnp.full(len(pool.pose), load_kg), pool.pressure_kpa, pool.spring_m, pool.pose)


def _as_measured(spec: ArmSpec, pool: Any) -> Any:
    """Return poses with the pressures that hold the real arm there, as far as its calibration knows them."""
    real_kpa = pool.pressure_kpa + spec.unmodelled_kpa(np.asarray(pool.spring_m))
    return pool._replace(pressure_kpa=jnp.asarray(real_kpa, jnp.float32))


def _loads(spec: ArmSpec, seed: int) -> np.ndarray:
    """Draw payloads (m,) [kg] of the candidates for equilibria with a payload."""
    rng = np.random.default_rng([seed, 1])
    return _load_max_kg(spec) * rng.uniform(LOWEST, HIGHEST, CANDIDATES_PER_POSE * N_TRAINING)


def _load_max_kg(spec: ArmSpec) -> float:
    return spec.mass.payload_kg + spec.mass.largest_payload_kg


def _stronger(spec: ArmSpec) -> ArmSpec:
    """Return the arm with more pressure: a real one reaches spring lengths just beyond the simulated."""
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    more = MORE_PRESSURE * (high - low)
    chambers = {"pressure_min_kpa": max(low - more, -100.0), "pressure_max_kpa": high + more}
    return spec.replace(chambers=chambers)


def _first_estimator(spec: ArmSpec, pool: LoadedPool, key: Array) -> PoseEstimator:
    n, n_sections = spec.n_chambers, spec.structure.n_sections
    scale = np.full(N_CHANGES, CHANGE_SCALE)
    scale[:3] *= spec.geometry.section_length_m
    load_layers = _first_layers(jax.random.fold_in(key, 1), (2 * n + 1, WIDTH, WIDTH, N_CHANGES * n_sections))
    *hidden, (weight, bias) = load_layers
    return PoseEstimator(
        layers=_first_layers(key, (2 * n, WIDTH, WIDTH, N_CHANGES * n_sections)),
        load_layers=(*hidden, (0.1 * weight, bias)),
        spring_site_m=jnp.asarray(ArmParams.from_spec(spec).spring_site_m),
        spring_centre_m=jnp.mean(pool.spring_m, axis=0),
        spring_scale_m=jnp.std(pool.spring_m, axis=0),
        load_centre_kg=jnp.asarray(spec.mass.payload_kg),
        load_scale_kg=jnp.asarray(spec.mass.largest_payload_kg),
        change_scale=jnp.asarray(scale),
    )


def _first_load_estimator(spec: ArmSpec, pool: LoadedPool, key: Array) -> LoadEstimator:
    return LoadEstimator(
        layers=_first_layers(key, (2 * spec.n_chambers, WIDTH, WIDTH, 1)),
        spring_centre_m=jnp.mean(pool.spring_m, axis=0),
        spring_scale_m=jnp.std(pool.spring_m, axis=0),
        pressure_centre_kpa=jnp.mean(pool.pressure_kpa, axis=0),
        pressure_scale_kpa=jnp.std(pool.pressure_kpa, axis=0),
        load_scale_kg=jnp.asarray(_load_max_kg(spec)),
    )


def _first_spring_model(pool: Pool, key: Array) -> SpringModel:
    n = pool.spring_m.shape[1]
    return SpringModel(
        layers=_first_layers(key, (n, WIDTH, WIDTH, n)),
        pressure_centre_kpa=jnp.mean(pool.pressure_kpa, axis=0),
        pressure_scale_kpa=jnp.std(pool.pressure_kpa, axis=0),
        spring_centre_m=jnp.mean(pool.spring_m, axis=0),
        spring_scale_m=jnp.std(pool.spring_m, axis=0),
    )


def _first_layers(key: Array, widths: tuple[int, ...]) -> tuple[Layer, ...]:
    """Return random layers that preserve the magnitude of their input."""
    layers = []
    for k, (n_in, n_out) in enumerate(itertools.pairwise(widths)):
        gain = np.sqrt(2.0 / n_in)  # He et al. 2015, arXiv:1502.01852
        weight = gain * jax.random.normal(jax.random.fold_in(key, k), (n_in, n_out))
        layers.append((weight, jnp.zeros(n_out)))
    return tuple(layers)


def _pose_loss(estimator: PoseEstimator, pool: LoadedPool) -> Array:
    """Return the mean square of the tip error [mm], where a radian of turn counts as `TURN_MM`."""
    position_m, rotation = frame_from_pose(pool.pose)
    guess = estimate_frame(estimator, pool.spring_m, pool.load_kg)
    away = jnp.sum((1e3 * (guess.position_m - position_m)) ** 2, axis=-1)  # (B,)
    turned = jnp.sum((guess.rotation - rotation) ** 2, axis=(-2, -1)) / 2  # (B,) squared angle, if small
    return jnp.mean(away + TURN_MM**2 * turned)


def _load_loss(estimator: LoadEstimator, pool: LoadedPool) -> Array:
    """Return the mean square of the payload's error, as a share of the largest payload."""
    off_kg = estimate_load(estimator, pool.spring_m, pool.pressure_kpa) - pool.load_kg
    return jnp.mean((off_kg / estimator.load_scale_kg) ** 2)


def _spring_loss(model: SpringModel, pool: Pool) -> Array:
    """Return the mean square of the springs' errors [mm]."""
    return jnp.mean((1e3 * (expected_springs(model, pool.pressure_kpa) - pool.spring_m)) ** 2)


def _fit(
    network: Any, loss: Callable[[Any, Any], Array], pool: Any, key: Array, layers: str = "layers"
) -> Any:
    """Return the network with its field `layers` trained by Adam; its other fields stay."""
    optimiser = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, N_STEPS))

    def step(carry: tuple[Any, Any], key_batch: Array) -> tuple[tuple[Any, Any], None]:
        weights, state = carry
        rows = jax.random.randint(key_batch, (BATCH,), 0, len(pool.pose))
        batch = jax.tree.map(lambda x: x[rows], pool)
        gradient = jax.grad(lambda weights: loss(network._replace(**{layers: weights}), batch))(weights)
        updates, state = optimiser.update(gradient, state)
        return (optax.apply_updates(weights, updates), state), None

    def run(weights: Any) -> Any:
        keys = jax.random.split(key, N_STEPS)
        return jax.lax.scan(step, (weights, optimiser.init(weights)), keys)[0][0]

    weights = xla.jit(run, uses_mjx=False)(getattr(network, layers))
    return network._replace(**{layers: weights})


def _errors(
    estimator: PoseEstimator, load_estimator: LoadEstimator, spring_model: SpringModel, spec: ArmSpec
) -> tuple[dict[float, Error], ...]:
    """Return errors of tip [mm], axes [deg], load [kg] and springs [mm], by payload."""
    tip_mm, turn_deg, load_off_kg, spring_mm = {}, {}, {}, {}
    for share in PAYLOADS:
        payload_kg = share * spec.mass.largest_payload_kg
        load_kg = spec.mass.payload_kg + payload_kg
        loaded = spec.replace(mass={"payload_kg": load_kg})
        pool = jax.tree.map(
            np.asarray, _as_measured(spec, sample_workspace(loaded, N_HELD_OUT, HELD_OUT_SEED))
        )
        position_m, rotation = frame_from_pose(pool.pose)
        guess = estimate_frame(estimator, pool.spring_m, load_kg)
        chord = np.sqrt(np.sum((guess.rotation - rotation) ** 2, axis=(-2, -1)) / 8)  # sin of half the angle
        springs = np.abs(expected_springs(spring_model, pool.pressure_kpa) - pool.spring_m)
        tip_mm[payload_kg] = _error(1e3 * np.linalg.norm(guess.position_m - position_m, axis=-1))
        turn_deg[payload_kg] = _error(np.degrees(2.0 * np.arcsin(np.minimum(chord, 1.0))))
        spring_mm[payload_kg] = _error(1e3 * springs.max(axis=-1))
        many_kg = np.full(CANDIDATES_PER_POSE * N_HELD_OUT, load_kg)
        off = _as_measured(spec, sample_loaded(loaded, many_kg, CHAMBERS_OFF, HELD_OUT_SEED))
        estimate_kg = np.asarray(estimate_load(load_estimator, off.spring_m, off.pressure_kpa))
        load_off_kg[payload_kg] = _error(np.abs(estimate_kg - load_kg))
    return tip_mm, turn_deg, load_off_kg, spring_mm


def _error(values: np.ndarray) -> Error:
    return Error(*(float(np.quantile(values, share)) for share in (0.5, 0.95, 1.0)))
