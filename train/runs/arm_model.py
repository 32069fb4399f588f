"""Networks and workspace of an arm for its computer; the same for every policy that drives the arm.

The estimators of load, pose and springs (`mjx_softarm.sensing.estimator`, `mjx_softarm.sensing.load`) learn
equilibria over the whole workspace, and are tested on held-out ones. No calibration is perfect. So the load
network learns how well the log of the arm shows the pressures that hold it
(`mjx_softarm.sensing.held_pressures`), or, without a log, by how much arms differ whose chambers are off. The
pose is not estimated from pressures: a chamber's error would pass for a change of shape.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import calib.fit
import mjx_softarm
from calib.arm import CalibratedArm
from calib.fit.payload import effect_of_s2r, held_at
from calib.fit.s2r import simulate_poses
from mjx_softarm._support import xla
from mjx_softarm._support.archive import Entries, SealedFileError, entries_of, read_sealed, write_sealed
from mjx_softarm._support.training import Schedule, initial_layers, train_network
from mjx_softarm._support.xp import array_namespace
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.workspace import (
    CANDIDATES_PER_POSE,
    HELD_OUT_SEED,
    Pool,
    sample_evenly,
    sample_loaded,
    sample_workspace,
)
from mjx_softarm.policy.file import ArmModel, take_networks
from mjx_softarm.posture import hangs
from mjx_softarm.sensing.estimator import (
    N_CHANGES,
    N_TERMS,
    N_VARIABLES,
    Frame,
    PoseEstimator,
    SpringModel,
    arcs,
    estimate_frame,
    expected_springs,
    first_moments,
    polynomial_terms,
    section_shapes,
    variables,
)
from mjx_softarm.sensing.held_pressures import held_kpa, residual
from mjx_softarm.sensing.load import (
    COMMON_FACTOR,
    HIGHEST,
    LOWEST,
    LoadEstimator,
    estimate_load,
    holding,
)
from mjx_softarm.sensing.pose import frame_from_pose, quaternion_from_rotation
from mjx_softarm.sensing.s2r import S2R, correct
from mjx_softarm.spec import ArmSpec

N_WORKSPACE = 2048  # poses that stand for the workspace
SEED = 0  # seed of equilibria, initial weights, batches and the workspace; it is not that of held-out poses
ESTIMATORS_FILE, _KIND = "estimators.npz", "estimators"
N_TRAINING, N_JUDGING, N_HELD_OUT = 16_384, 2_048, 2_048
# Share of the pressure range that is added at either end for poses. Much more brings sections that are about
# to buckle, which no polynomial follows: with 0.25, the paper's arm has 3.7 mm at 95 % instead of 0.1.
MORE_PRESSURE = 0.05
RIDGE = 1e-8  # added to the mean squares of the polynomial's terms
SCHEDULE = Schedule(n_updates=8_000, learning_rate=4e-3, batch_size=256)
LOAD_SCHEDULES = 2  # schedules for which the payload's network learns
PRESSURE_WEIGHT = 4.0  # of the pressures in its loss: they tell the payload more than its other outputs
PAYLOADS = (0.0, 0.25, 0.5, 1.0)  # shares of the largest payload at which errors are given
CHAMBERS_OFF = 0.03  # share by which stiffness and area of a chamber may be off without a log of the arm
WIDTH = 128  # width of the networks' hidden layers
LEAST_SCALE = 1e-6  # least scale of an output off its plane: without a log, one variance holds everywhere
Errors = dict[str, dict[str, dict[str, float]]]


class DistilledArm(NamedTuple):
    """A model of an arm, with the errors of its networks."""

    model: ArmModel
    errors: Errors  # "median", "p95" and "largest" by quantity and payload, such as "0.5 kg"


_distilled: dict[str, DistilledArm] = {}  # by key, of this process


def arm_model(
    arm: CalibratedArm, folder: Path | None = None, say: Callable[[str], object] = lambda step: None
) -> DistilledArm:
    """Return the model of an arm, which is distilled once in a process.

    A file in `folder` keeps the model, and is used again for the same arm and the same code. `say` takes a
    text before each step. Raises SpecError if the arm settles at too few pressures.
    """
    file, key = folder and folder / ESTIMATORS_FILE, _key(arm)
    if file and (kept := _read(file, key, arm)):
        return kept
    if key not in _distilled:
        _distilled[key] = distil(arm, say)
    if file:
        with contextlib.suppress(SealedFileError):  # a folder to read only: the next export distils anew
            _write(file, key, _distilled[key])
    return _distilled[key]


def distil(arm: CalibratedArm, say: Callable[[str], object] = lambda step: None) -> DistilledArm:
    """Return the model of an arm, always the same for the same arm; see `arm_model`."""
    say("fitting the pose estimator")
    estimator = fit_pose(arm.spec)
    say("training the payload estimator")
    load_estimator = fit_load_estimator(arm)
    say("training the model of the springs")
    spring_model = fit_spring_model(arm)
    say("simulating the workspace")
    networks = estimator, load_estimator, spring_model
    estimator, load_estimator, spring_model = jax.tree.map(lambda x: np.asarray(x, np.float32), networks)
    model = ArmModel(_workspace(arm.spec, arm.s2r), estimator, load_estimator, spring_model, arm.s2r)
    say("testing them at held-out poses")
    return DistilledArm(model, _errors(model, arm))


def fit_pose(spec: ArmSpec) -> PoseEstimator:
    """Return the pose estimator of an arm, least squares over simulated poses with payloads."""
    # Poses, with the ends of their sections, and how far these are off constant curvature
    pool = sample_loaded(_stronger(spec), _payloads(spec), 0.0, SEED)
    sections, ups = _sections(spec, pool.q)
    estimator = _first_estimator(spec)
    length, bend = section_shapes(estimator.spring_site_m, np.asarray(pool.spring_m, float))
    even = arcs(length, bend)
    turn = quaternion_from_rotation(sections.rotation @ even.rotation.swapaxes(-1, -2))
    gibbs = turn[..., 1:] / turn[..., :1]
    changes = np.concatenate([sections.position_m - even.position_m, gibbs], axis=-1)

    # A polynomial for each section
    load_kg = np.asarray(pool.load_kg, float)[:, None]
    moments = first_moments(estimator, length, sections, load_kg)
    loads_kg = load_kg[:, None] * np.ones_like(length)
    every = variables(length, bend, even.rotation, ups, moments, loads_kg)
    fits = list[tuple[np.ndarray, np.ndarray, np.ndarray]]()
    for k, x in enumerate(np.moveaxis(every, 1, 0)):
        low, high = x.min(axis=0), x.max(axis=0)
        centre, scale = (low + high) / 2.0, np.maximum((high - low) / 2.0, LEAST_SCALE)
        terms = polynomial_terms(((x - centre) / scale).T)  # (N_TERMS, n)
        size = np.maximum(np.sqrt(np.mean(terms**2, axis=1)), LEAST_SCALE)
        terms /= size[:, None]
        square = terms @ terms.T / len(x) + RIDGE * np.eye(N_TERMS)
        weights = np.linalg.solve(square, terms @ changes[:, k] / len(x))
        fits.append((weights / size[:, None], centre, scale))
    coefficient, centre, scale = (np.stack(parts) for parts in zip(*fits, strict=True))
    return estimator._replace(coefficient=coefficient, variable_centre=centre, variable_scale=scale)


def _sections(spec: ArmSpec, q: Array) -> tuple[Frame, np.ndarray]:
    """Return the ends of the sections (n, n_sections) of arms with joint coordinates (n, nv).

    They are in the frames of the sections' starts. Beside them stand the directions against gravity
    (n, n_sections, 3) in these frames.
    """
    frames = xla.jit(jax.vmap(chain_kinematics(ArmParams.from_spec(spec))))(q)
    links = spec.structure.links_per_section
    position_m = np.asarray(frames.plate_position, float)[:, ::links]
    rotation = np.asarray(frames.plate_rotation, float)[:, ::links]
    start = rotation[:, :-1].swapaxes(-1, -2)
    moved_m = (start @ np.diff(position_m, axis=1)[..., None])[..., 0]
    return Frame(moved_m, start @ rotation[:, 1:]), rotation[:, :-1, 2]


def _first_estimator(spec: ArmSpec) -> PoseEstimator:
    """Return the pose estimator of an arm whose sections bend evenly, in double precision."""
    params = ArmParams.from_spec(spec)
    n_sections = params.n_sections
    estimator = PoseEstimator(
        coefficient=np.zeros((n_sections, N_TERMS, N_CHANGES)),
        variable_centre=np.zeros((n_sections, N_VARIABLES)),
        variable_scale=np.ones((n_sections, N_VARIABLES)),
        spring_site_m=params.spring_site_m,
        section_mass_kg=np.reshape(params.link_mass_kg, (n_sections, -1)).sum(axis=1),
        gripper_mass_kg=params.tool_mass_kg[0],
        tool_offset_m=params.tool_offset_m,
        **params.mount._asdict(),
    )
    return jax.tree.map(lambda value: np.asarray(value, float), estimator)


def _payloads(spec: ArmSpec) -> np.ndarray:
    """Draw payloads [kg] of the candidates for poses to learn from."""
    share = np.random.default_rng([SEED, 1]).uniform(LOWEST, HIGHEST, CANDIDATES_PER_POSE * N_TRAINING)
    return (spec.mass.payload_kg + spec.mass.largest_payload_kg) * share


def _chambers_off(arm: CalibratedArm) -> float:
    """Return the share by which chambers may be off: a log of the arm shows its own."""
    return CHAMBERS_OFF if arm.held is None else 0.0


def fit_load_estimator(arm: CalibratedArm) -> LoadEstimator:
    """Return the payload network of an arm, learned at poses with payloads."""
    spec, _, held = arm
    loaded = sample_loaded(spec, _payloads(spec), _chambers_off(arm), SEED)
    own_kg, n_sections = spec.mass.payload_kg, spec.structure.n_sections
    # Pressures that hold the springs without a payload, and their change by one
    at, both = held_at(arm, np.asarray(loaded.spring_m))
    spring_m, light_kpa, effect = (values[both] for values in at)
    # What the calibration knows of the real arm's pressures
    if held is None:
        load_kg, kpa = (np.asarray(values)[both] for values in (loaded.load_kg, loaded.pressure_kpa))
        off_kpa = kpa - light_kpa - (load_kg - own_kg)[:, None] * effect
        covariance = _square(off_kpa.reshape(len(kpa), n_sections, -1))
        left_kpa, share = np.zeros_like(light_kpa), np.ones((len(kpa), n_sections))
    else:
        mean_kpa, share = residual(held, spring_m, light_kpa)
        covariance, left_kpa = held.covariance_kpa2, mean_kpa.reshape(light_kpa.shape)
    held_at_kpa = light_kpa + left_kpa + spec.unmodelled_kpa
    # Learn, and judge by poses that are not learned
    out = np.float32(np.concatenate([held_at_kpa, effect, np.log(share)], axis=1))
    split = ([jnp.asarray(part) for part in np.split(values, [-N_JUDGING])] for values in (spring_m, out))
    (learned_m, judging_m), (learned, judging) = split
    keys = _keys()
    first = _first_load_estimator(arm, learned_m, learned, jnp.asarray(covariance), keys[3])
    network = _fit(first, _holding_loss, (learned_m, learned), keys[4], n_schedules=LOAD_SCHEDULES)
    # The network's own error. It is larger at the rim, so the intervals of 95 % of these poses shall hold it.
    predicted_kpa = holding(network, judging_m).pressure_kpa
    true_kpa = judging[:, : spec.n_chambers]
    error = _square(predicted_kpa - true_kpa.reshape(predicted_kpa.shape))
    alone = network._replace(covariance_kpa2=jnp.zeros_like(error), error_kpa2=error)
    estimated_kg, half_width_kg = estimate_load(alone, judging_m, true_kpa)
    widened = jnp.quantile(jnp.abs(estimated_kg - own_kg) / half_width_kg, 0.95) ** 2
    return network._replace(error_kpa2=widened * error)


def fit_spring_model(arm: CalibratedArm) -> SpringModel:
    """Return the network from pressures to springs of an arm without a payload."""
    pool, keys = _as_measured(arm, sample_workspace(arm.spec, N_TRAINING, SEED)), _keys()
    first = SpringModel(
        layers=initial_layers(keys[5], (arm.spec.n_chambers, WIDTH, WIDTH, arm.spec.n_springs)),
        **_scaling("pressure", "kpa", pool.pressure_kpa),
        **_scaling("spring", "m", pool.spring_m),
    )

    def loss(model: SpringModel, pool: Any) -> Array:
        return jnp.mean((1e3 * (expected_springs(model, pool.pressure_kpa) - pool.spring_m)) ** 2)  # [mm^2]

    return _fit(first, loss, pool, keys[6])


def _square(off_kpa: Any) -> Any:
    """Return the mean squares (s, c, c) of pressures (n, s, c) that are off."""
    xp = array_namespace(off_kpa)
    return xp.einsum("nsi,nsj->sij", off_kpa, off_kpa) / len(off_kpa)


def _keys() -> Array:
    return jax.random.split(jax.random.key(SEED), 7)


def _loaded(arm: CalibratedArm, many_kg: np.ndarray) -> Pool:
    """Draw held-out poses of arms with payloads [kg], off as far as the calibration does not tell."""
    pool = sample_loaded(arm.spec, many_kg, _chambers_off(arm), HELD_OUT_SEED)
    if arm.held is None:
        return _as_measured(arm, pool)
    # The effect of the payload is the difference to the arm without it, held at the same springs.
    light = simulate_poses(arm.spec, np.asarray(pool.spring_m))
    pool = jax.tree.map(lambda values: np.asarray(values)[light.valid], pool)
    light_kpa, own_kg = light.pressure_kpa[light.valid], arm.spec.mass.payload_kg
    effect_kpa = pool.pressure_kpa - light_kpa
    effect_kpa += (pool.load_kg - own_kg)[:, None] * effect_of_s2r(arm, pool.spring_m)
    kpa = held_kpa(arm.held, pool.spring_m, light_kpa, effect_kpa, np.random.default_rng([HELD_OUT_SEED, 2]))
    return pool._replace(pressure_kpa=jnp.asarray(kpa + arm.spec.unmodelled_kpa, jnp.float32))


def _as_measured(arm: CalibratedArm, pool: Any) -> Any:
    """Return poses with the pressures that hold the real arm without a payload, as far as they are known."""
    kpa = np.asarray(pool.pressure_kpa)
    if arm.held is not None:
        kpa = held_kpa(arm.held, np.asarray(pool.spring_m), kpa, np.zeros_like(kpa))
    return pool._replace(pressure_kpa=jnp.asarray(kpa + arm.spec.unmodelled_kpa, jnp.float32))


def _stronger(spec: ArmSpec) -> ArmSpec:
    """Return the arm with more pressure: a real arm reaches spring lengths just beyond the simulated ones."""
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    more = MORE_PRESSURE * (high - low)
    chambers = {"pressure_min_kpa": max(low - more, -100.0), "pressure_max_kpa": high + more}
    return spec.replace(chambers=chambers)


def _holding_loss(estimator: LoadEstimator, rows: tuple[Array, Array]) -> Array:
    """Return the mean square of the outputs' errors, as shares of what a plane leaves.

    Rows are spring lengths (n, n_springs), and the outputs (n, n_out) of `LoadEstimator` there.
    """
    spring_m, out = rows
    each = [x.reshape(len(out), -1) for x in holding(estimator, spring_m)]
    off = (jnp.concatenate(each, axis=1) - out) / estimator.out_scale
    weight = jnp.ones(off.shape[1]).at[: each[0].shape[1]].set(PRESSURE_WEIGHT)
    return jnp.mean(weight * off**2)


def _fit(network: Any, loss: Callable[[Any, Any], Array], rows: Any, key: Array, n_schedules: int = 1) -> Any:
    """Return the network with its layers trained; its other fields stay."""
    schedule = SCHEDULE._replace(n_updates=n_schedules * SCHEDULE.n_updates)

    def loss_of(layers: Any, rows: Any) -> Array:
        return loss(network._replace(layers=layers), rows)

    layers, _ = train_network(loss_of, network.layers, rows, schedule, key)
    return network._replace(layers=layers)


def _first_load_estimator(
    arm: CalibratedArm, spring_m: Array, out: Array, covariance_kpa2: Array, key: Array
) -> LoadEstimator:
    """Return the payload network of an arm, with the plane that fits its outputs (n, n_out) best.

    `covariance_kpa2` (n_sections, c, c) is that of the arm's residual pressures.
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
        out_scale=jnp.maximum(rest, LEAST_SCALE),
        covariance_kpa2=covariance_kpa2,
        error_kpa2=jnp.zeros_like(covariance_kpa2),
        hysteresis_kpa=jnp.asarray(at_chambers(0.0 if held is None else tuple(held.hysteresis_kpa))),
        stroke_m=jnp.asarray(at_chambers(1.0 if held is None else tuple(held.stroke_m))),
        own_load_kg=jnp.asarray(own_kg),
        load_scale_kg=jnp.asarray(own_kg + arm.spec.mass.largest_payload_kg),
        factor_sd=jnp.asarray(COMMON_FACTOR if held is None else held.factor_sd),
    )


def _scaling(name: str, unit: str, values: Array) -> dict[str, Array]:
    """Return the fields of a network that standardise a quantity (n, ...)."""
    return {
        f"{name}_centre_{unit}": jnp.mean(values, axis=0),
        f"{name}_scale_{unit}": jnp.std(values, axis=0),
    }


def _errors(learned: ArmModel, arm: CalibratedArm) -> Errors:
    """Return errors by payload on top of the specification's.

    `tip_mm` and `turn_deg` are errors of the estimated pose with the true load. `load_kg` is the error of
    arms whose chambers are off, `spring_mm` the error of each arm's worst spring.
    """
    spec, errors_by_name = arm.spec, Errors()
    for share in PAYLOADS:
        payload_kg = share * spec.mass.largest_payload_kg
        load_kg = spec.mass.payload_kg + payload_kg
        loaded = spec.replace(mass={"payload_kg": load_kg})
        # Compare pose and springs with equilibria of the arm as specified.
        many_kg = np.full(CANDIDATES_PER_POSE * N_HELD_OUT, load_kg)
        if hangs(spec):
            held_out = sample_workspace(loaded, N_HELD_OUT, HELD_OUT_SEED)
        else:  # at constant pressures it may buckle
            held_out = sample_loaded(spec, many_kg, 0.0, HELD_OUT_SEED)
        pool = jax.tree.map(np.asarray, _as_measured(arm, held_out))
        position_m, rotation = frame_from_pose(pool.pose)
        guess = estimate_frame(learned.estimator, pool.spring_m, load_kg)
        chord = np.sqrt(np.sum((guess.rotation - rotation) ** 2, axis=(-2, -1)) / 8)  # sin of half the angle
        springs = np.abs(expected_springs(learned.spring_model, pool.pressure_kpa) - pool.spring_m)
        # Estimate the load of arms whose chambers are off.
        off = _loaded(arm, many_kg)
        estimated_kg, half_width_kg = estimate_load(learned.load_estimator, off.spring_m, off.pressure_kpa)
        errors = {
            "tip_mm": 1e3 * np.linalg.norm(guess.position_m - position_m, axis=-1),
            "turn_deg": np.degrees(2.0 * np.arcsin(np.minimum(chord, 1.0))),
            "load_kg": np.abs(np.asarray(estimated_kg) - load_kg),
            "load_half_width_kg": np.asarray(half_width_kg),
            "spring_mm": 1e3 * springs.max(axis=-1),
        }
        for name, values in errors.items():
            shares = {"median": 0.5, "p95": 0.95, "largest": 1.0}
            quantiles = {label: float(np.quantile(values, share)) for label, share in shares.items()}
            errors_by_name.setdefault(name, {})[f"{payload_kg:g} kg"] = quantiles
    return errors_by_name


def _write(file: Path, key: str, arm: DistilledArm) -> None:
    """Keep a model in a file, with the key of its arm; the sim-to-real network has a file of its own."""
    entries = {"key": key, "errors_json": json.dumps(arm.errors), "workspace": arm.model.workspace}
    for name in ("estimator", "load_estimator", "spring_model"):
        entries |= entries_of(name, getattr(arm.model, name))
    write_sealed(file, entries, _KIND)


def _read(file: Path, key: str, arm: CalibratedArm) -> DistilledArm | None:
    """Return the model that a file keeps; None where the file is absent, damaged or of another key."""
    try:
        entries = Entries(read_sealed(file, _KIND, "python -m train export"), str(file))
        if entries.take("key", np.str_, ()) != key:
            return None
        workspace = entries.take("workspace", np.float32, (None, 6))
        model = ArmModel(workspace, *take_networks(entries, arm.spec), arm.s2r)
        return DistilledArm(model, entries.table("errors_json"))
    except SealedFileError:
        return None


def _key(arm: CalibratedArm) -> str:
    """Return a checksum of the arm with its models, of the networks' settings, JAX and the code.

    The code is this file, `mjx_softarm/spec.py`, and the modules of `calib/fit` and of
    `_support`, `mechanics` and `sensing` in `mjx_softarm`, without subfolders. Versions of other packages,
    and the device, are not part of it.
    """
    settings = [arm.spec.to_dict(), SEED, N_WORKSPACE, N_TRAINING, N_HELD_OUT]
    digest = hashlib.sha256(json.dumps([*settings, SCHEDULE, PAYLOADS, jax.__version__]).encode())
    for values in jax.tree.leaves((arm.s2r, arm.held)):
        digest.update(np.asarray(values).tobytes())
    package, fit = (Path(module.__path__[0]) for module in (mjx_softarm, calib.fit))
    folders = (package / "_support", package / "mechanics", package / "sensing", fit)
    modules = (file for folder in folders for file in sorted(folder.glob("*.py")))
    for source in (package / "spec.py", Path(__file__), *modules):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _workspace(spec: ArmSpec, s2r: S2R | None) -> np.ndarray:
    """Return poses (N_WORKSPACE, 6) of the real arm: half at random pressures, half uniform in volume."""
    halves = [sample(spec, N_WORKSPACE // 2, SEED) for sample in (sample_workspace, sample_evenly)]
    poses = [p.pose if s2r is None else correct(s2r, p.pose, p.spring_m) for p in halves]
    return np.concatenate(poses).astype(np.float32)
