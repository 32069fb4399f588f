"""Sim-to-real network: simulated tip pose and spring lengths -> pose of the real tip, fitted to a log.

As in the paper, the log gives spring lengths and real tip poses, the calibrated simulation its own poses at
these spring lengths. The network learns the difference, which takes fewer rows than the real pose itself.
Rows are few, so a Gaussian process that knows of sections (`calib.fit.section_process`) is fitted to them.
The network learns its mean, at the rows and at simulated arms all over the workspace: a linear map is fitted
first, the network learns its residual, and both are joined to one. Its inputs and outputs stay within the
range of the rows, and anchors measure how far an input is from all rows. Contiguous blocks of rows take part
in neither fit, and measure the error.

The paper's own network is a choice: from (P, L_spring) straight to P_S2R in R^6, by mean squared error, Adam
with 0.01 and batches of 128. It takes the place of the process: the file's network learns its answers.

Source: Sim-to-Real Transfer in Meng et al.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import block_diag

from calib.fit.blocks import block_rows, held_out_blocks
from calib.fit.pose_errors import PoseErrors, pose_errors
from calib.fit.section_process import Sections, fit_process, sections
from mjx_softarm._support import xla
from mjx_softarm._support.mlp import Layer, mlp
from mjx_softarm._support.training import Schedule, initial_layers, train_network
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import arms_at_once, settle
from mjx_softarm.mechanics.workspace import settle_many
from mjx_softarm.sensing.pose import frame_from_pose, pose_error, pose_from_frame
from mjx_softarm.sensing.s2r import (
    S2R,
    apply_correction,
    correct,
    correction,
    correction_between,
    extrapolation,
    inputs,
)
from mjx_softarm.spec import ArmSpec

# Rows below which there is a warning. Calibrated from 60 poses, three twins and three rods followed their
# circles at 0.36 to 1.18 mm, from 150 at 0.39 to 0.65.
MIN_ROWS = 60
PRESSURE_LIMIT_KPA = 200.0  # limit of the simulated arm, beyond what any length of a real one needs
MAX_TURN_DEG = 90.0  # angle between real and simulated tips from which there is a warning
MAX_HELD_OUT_RATIO = 3.0  # ratio of held-out to training errors from which there is a warning
GOOD_SHARE = 0.1  # share of the error without the network below which there is no warning
BATCH = 512  # poses simulated together
N_POINTS = 24_000  # simulated arms at random pressures, at which the network learns the model
PROCESS, PRINTED_NETWORK = "Gaussian process of the sections", "network as printed in the paper"
RIDGE = 1.0  # prior of the linear map: as strong as a row or two, as inputs are from -1 to 1
N_ANCHORS = 256
LIMIT_PERCENTILE = 99.0


@dataclass(frozen=True)
class NetworkConfig:
    """Hidden layers and training."""

    hidden: tuple[int, ...]
    schedule: Schedule
    line: bool = True  # fit a linear map first, and the network to its residual


# Rows of a log are few and noisy, so weights decay. Learning rate and batch size are the paper's.
OF_ROWS = NetworkConfig((64, 64), Schedule(3_000, 0.01, 128, weight_decay=0.3))
# The mean of a process has no noise.
OF_PROCESS = NetworkConfig((192, 192), Schedule(12_000, 4e-3, 512))
# The paper's network from P and L_spring to P_S2R: Adam with 0.01, batches of 128. The paper leaves layers
# and number of updates open: these are the numbers of `OF_ROWS`.
PRINTED = NetworkConfig((64, 64), Schedule(3_000, 0.01, 128, last_share=1.0), line=False)


def fit_network(
    x: np.ndarray,
    y: np.ndarray,
    seed: int,
    config: NetworkConfig = OF_ROWS,
    points: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[S2R, np.ndarray]:
    """Fit a network from inputs to outputs by mean squared error.

    Args:
        x (n, n_in): inputs in order of time, without the rows that will test the network.
        y (n, n_out): outputs.
        seed: seed of weights, batches and blocks.
        config: hidden layers and training.
        points: inputs (m, n_in) and outputs (m, n_out) without noise, which it learns in place of the rows.

    Returns:
        Network; losses (n_epochs,) on the rows that stop the training, of which it has the least.
    """
    # Bring the inputs to -1 to 1, and choose anchors.
    bounds = _bounds(x, y)
    low, high = bounds["input_low"], bounds["input_high"]

    def normalised(x: np.ndarray) -> np.ndarray:
        return (2.0 * (x - low) / (high - low) - 1.0).astype(np.float32)

    z, stop = normalised(x), held_out_blocks(len(x), block=block_rows(len(x)), seed=1_000 * seed)
    anchors, limit = _anchors(z, stop)
    if points is not None:
        z, y, stop = np.clip(normalised(points[0]), -1.0, 1.0), points[1], None
    # Fit a linear map, then a network to its residual.
    linear = np.zeros((z.shape[1], y.shape[1]))
    if config.line:
        centred, about = z - z.mean(axis=0), y - y.mean(axis=0)
        linear = np.linalg.solve(centred.T @ centred + RIDGE * np.eye(len(linear)), centred.T @ about)
    left = y - z @ linear
    centre, spread = left.mean(axis=0), left.std(axis=0)
    spread = np.where(spread > 0.0, spread, 1.0)
    rows = z, ((left - centre) / spread).astype(np.float32)
    key_layers, key_rows = jax.random.split(jax.random.key(seed))
    start = initial_layers(key_layers, (z.shape[1], *config.hidden, y.shape[1]))
    layers, losses = train_network(_loss, start, rows, config.schedule, key_rows, stop)
    layers = _with_line(layers, spread, centre, linear)
    return S2R(layers, **bounds, anchors=anchors, limit=limit), losses


def _loss(layers: tuple[Layer, ...], rows: tuple[Array, Array]) -> Array:
    x, y = rows
    return jnp.mean((mlp(layers, x, "relu") - y) ** 2)


def _bounds(x: np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
    """Return ranges of the training rows; an input that never changes gets a width above zero."""
    low, high = (f(x, axis=0).astype(np.float32) for f in (np.min, np.max))
    narrow = high - low <= 1e-5 * np.maximum(np.abs(low), np.abs(high))
    margin = np.where(narrow, np.maximum(1e-3 * np.abs(low), 1e-3), 0.0).astype(np.float32)
    output_low, output_high = (f(y, axis=0).astype(np.float32) for f in (np.min, np.max))
    inputs = {"input_low": low - margin, "input_high": high + margin}
    return inputs | {"output_low": output_low, "output_high": output_high}


def _with_line(
    layers: tuple[Layer, ...], scale: np.ndarray, offset: np.ndarray, linear: np.ndarray
) -> tuple[Layer, ...]:
    """Return a network of a network's outputs times `scale` plus `offset` (n_out,), plus a linear map.

    The inputs z are -1 or more, so z + 1 passes through the rectified layers unchanged.
    """
    *hidden, (weight, bias) = layers
    n_in = len(linear)
    joined: list[Layer] = []
    for k, (w, b) in enumerate(hidden):
        passing = np.eye(n_in)  # z + 1
        block = block_diag(w, passing) if k else np.hstack([w, passing])  # both read the same inputs
        joined.append((block, np.append(b, np.full(n_in, float(k == 0)))))
    joined.append((np.vstack([weight * scale, linear]), bias * scale + offset - linear.sum(axis=0)))
    return tuple((np.asarray(w, np.float32), np.asarray(b, np.float32)) for w, b in joined)


def _anchors(z: np.ndarray, left_out: np.ndarray) -> tuple[np.ndarray, np.float32]:
    """Return rows that represent all rows z (n, n_in), and the greatest distance to believe.

    Nearly all left-out rows are within this distance of anchors chosen without them.
    """
    without = _spread_rows(z[~left_out])
    gap = np.min(np.mean((z[left_out, None] - without) ** 2, axis=-1), axis=-1)
    limit = np.sqrt(np.percentile(gap, LIMIT_PERCENTILE))
    return _spread_rows(z), np.float32(max(float(limit), 1e-3))


def _spread_rows(z: np.ndarray) -> np.ndarray:
    """Choose up to N_ANCHORS rows, each the farthest from the rows chosen before."""
    chosen, gap = [0], np.full(len(z), np.inf)
    while len(chosen) < min(N_ANCHORS, len(z)):
        gap = np.minimum(gap, np.mean((z - z[chosen[-1]]) ** 2, axis=-1))
        if gap.max() == 0.0:
            break
        chosen.append(int(gap.argmax()))
    return z[chosen]


class SimulatedPoses(NamedTuple):
    """Poses of the simulated arm at commanded spring lengths."""

    pose: np.ndarray  # (n, 6) [mm, deg]
    spring_m: np.ndarray  # (n, n_springs) lengths reached
    pressure_kpa: np.ndarray  # (n, n_chambers) that hold these lengths
    valid: np.ndarray  # (n,) bool, whether the arm settled
    sections: Sections

    def take(self, rows: np.ndarray) -> SimulatedPoses:
        """Return some of the poses, chosen by indices or a mask (n,)."""
        return jax.tree.map(lambda values: values[rows], self)


Model = Callable[[SimulatedPoses], np.ndarray]  # corrections (n, 6) [mm, Gibbs vector] of simulated poses


@dataclass(frozen=True, eq=False)
class S2RFit:
    """Sim-to-real network and whether to trust it."""

    s2r: S2R
    held_out: np.ndarray  # (n,) mask of rows that took no part
    in_sample: PoseErrors
    test: PoseErrors  # held-out rows
    test_uncorrected: PoseErrors
    model: str  # name of the model that the network learned: `PROCESS` or `PRINTED_NETWORK`
    test_model: PoseErrors  # errors of that model itself at held-out rows
    stop_epoch: int  # epoch whose weights are the network's
    n_epochs: int
    flagged_share: float  # share of the held-out rows with extrapolation above 1
    warnings: tuple[str, ...]  # reasons not to trust it, each with its remedy

    @property
    def is_better(self) -> bool:
        """Whether held-out tips are closer with the network than without."""
        return self.test.translation_mean_mm < self.test_uncorrected.translation_mean_mm


def simulate_poses(spec: ArmSpec, reference_m: np.ndarray) -> SimulatedPoses:
    """Settle the simulated arm at lengths (n, n_springs) [m] under the sensor-space law, n at least 1.

    The real arm had these lengths, so the simulated arm must reach them, too. Its own pressure limits would
    often keep it from them, and hide the difference to be learned.
    """
    settled = functools.partial(_solver(arms_at_once(spec.n_links)), without_limits(spec))
    return xla.in_batches(settled, BATCH, reference_m)


def without_limits(spec: ArmSpec) -> ArmParams:
    """Return the numbers of an arm whose pressures have no limits that a real one reaches."""
    limit = np.full(spec.n_chambers, PRESSURE_LIMIT_KPA, np.float32)
    return ArmParams.from_spec(spec)._replace(pressure_min_kpa=-limit, pressure_max_kpa=limit)


@functools.cache
def _solver(n_at_once: int | None):
    def one(params: ArmParams, reference: jax.Array) -> SimulatedPoses:
        end: Any = settle(params, reference, n_at_once)
        pose = pose_from_frame(end.tip_position_m, end.tip_rotation)
        at_sections = sections(chain_kinematics(params)(end.q), params, end.spring_m)
        return SimulatedPoses(pose, end.spring_m, end.pressure_kpa, end.settled, at_sections)

    return xla.jit(jax.vmap(one, in_axes=(None, 0)))


def fit_s2r(
    spec: ArmSpec,
    simulated: SimulatedPoses,
    pose_real: np.ndarray,
    seed: int = 0,
    printed: bool = False,
) -> S2RFit:
    """Fit a network from simulated poses and spring lengths to real poses.

    Args:
        spec: calibrated arm.
        simulated: its n poses from `simulate_poses`, settled ones only, in order of time.
        pose_real (n, 6) [mm, deg]: measured poses in the base frame.
        seed: seed of all random draws.
        printed: fit the paper's network in place of the process.
    """
    n = len(simulated.pose)
    arrays = (simulated.pose, simulated.spring_m, pose_real)
    pose_sim, spring_m, pose_real = (np.asarray(a, np.float64) for a in arrays)
    held_out = held_out_blocks(n, block=block_rows(n), seed=seed)
    # Fit the process, or the paper's network, to the rows, and the network to its answers.
    x, y = inputs(frame_from_pose(pose_sim), spring_m), correction_between(pose_sim, pose_real)
    rows = simulated.take(~held_out)
    model = fit_printed(rows, pose_real[~held_out], seed) if printed else _process(rows, y[~held_out])
    points = _points(spec, model, spring_m[~held_out], seed)
    network, losses = fit_network(x[~held_out], y[~held_out], seed, OF_PROCESS, points)
    # Judge it by the held-out rows.
    corrected = correct(network, pose_sim, spring_m)
    errors = {
        "in_sample": pose_errors(corrected[~held_out], pose_real[~held_out]),
        "test": pose_errors(corrected[held_out], pose_real[held_out]),
        "test_uncorrected": pose_errors(pose_sim[held_out], pose_real[held_out]),
    }
    by_model = moved(pose_sim[held_out], model(simulated.take(held_out)))
    flagged = extrapolation(network, pose_sim[held_out], spring_m[held_out]) > 1.0
    turn_deg = 2.0 * np.rad2deg(np.arctan(np.linalg.norm(y[:, 3:], axis=1)))
    return S2RFit(
        s2r=network._replace(error_mm=np.float32(errors["test"].translation_mean_mm)),
        held_out=held_out,
        **errors,
        model=PRINTED_NETWORK if printed else PROCESS,
        test_model=pose_errors(by_model, pose_real[held_out]),
        stop_epoch=int(losses.argmin()),
        n_epochs=len(losses),
        flagged_share=float(flagged.mean()),
        warnings=tuple(_warnings(n, turn_deg, errors)),
    )


def _process(simulated: SimulatedPoses, y: np.ndarray) -> Model:
    """Fit the process of the sections to corrections y (n, 6) of simulated poses."""
    process = fit_process(simulated.sections, y)
    return lambda simulated: process(simulated.sections)


def fit_printed(simulated: SimulatedPoses, pose_real: np.ndarray, seed: int = 0) -> Model:
    """Fit the paper's network from simulated poses and spring lengths to real poses (n, 6) [mm, deg].

    Inputs are scaled to -1 to 1 and outputs to unit spread, and angles do not jump by 360 degrees. Some rows
    choose the epoch. The paper states none of these.
    """

    def inputs(simulated: SimulatedPoses) -> np.ndarray:
        return np.concatenate([simulated.pose, simulated.spring_m], axis=1).astype(float)

    pose = np.asarray(simulated.pose, float)
    near = pose + pose_error(np.asarray(pose_real, float), pose)
    network, _ = fit_network(inputs(simulated), near, seed, PRINTED)
    return lambda simulated: correction_between(
        np.asarray(simulated.pose, float), np.asarray(correction(network, inputs(simulated)), float)
    )


def moved(pose: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return poses (n, 6) [mm, deg] moved by changes (n, 6) [mm, Gibbs vector]."""
    return pose_from_frame(*apply_correction(frame_from_pose(np.asarray(pose, float)), change))


def _points(spec: ArmSpec, model: Model, spring_m: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs of the network and answers of a model, at rows of springs and all over the workspace."""
    drawn = settle_many(spec, random_pressures(spec, N_POINTS, seed))
    over = np.clip(drawn.spring_m[drawn.settled], spring_m.min(axis=0), spring_m.max(axis=0))
    simulated = simulate_poses(spec, np.concatenate([spring_m, over]))
    settled = simulated.take(simulated.valid)
    return inputs(frame_from_pose(settled.pose), settled.spring_m), model(settled)


def _warnings(n: int, turn_deg: np.ndarray, errors: dict[str, PoseErrors]) -> list[str]:
    warnings = []
    if n < MIN_ROWS:
        warnings.append(f"got {n} rows, expected {MIN_ROWS} or more for a network: log more poses")
    if rows := np.count_nonzero(turn_deg > MAX_TURN_DEG):
        warnings.append(
            f"in {rows} of {n} rows the real tip is turned by more than {MAX_TURN_DEG:g} degrees against the "
            "simulated one: bring motion capture into the base frame"
        )
    for what, unit in (("translation", "mm"), ("rotation", "deg")):
        got, without, seen = (
            getattr(errors[e], f"{what}_mean_{unit}") for e in ("test", "test_uncorrected", "in_sample")
        )
        held_out = f"{what}: {got:.3g} {unit} on held-out rows"
        if got >= without:
            left_out = ", so it is left out" if what == "translation" else ""
            better = f"no better than {without:.3g} without the network{left_out}"
            warnings.append(f"{held_out}, {better}: log more poses")
        if got > max(MAX_HELD_OUT_RATIO * seen, GOOD_SHARE * without):
            warnings.append(f"{held_out}, far more than {seen:.3g} in training: log more poses")
    return warnings
