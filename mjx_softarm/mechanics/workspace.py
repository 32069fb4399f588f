"""Poses that the arm can reach: drawn at random, or all combinations of the chambers' extremes."""

from __future__ import annotations

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.settle import Settled, settle_pressures
from mjx_softarm.mechanics.statics import ArmParams
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.spec import ArmSpec, SpecError

BATCH = 1024
CANDIDATES_PER_POSE = 2
CANDIDATES_PER_EVEN_POSE = 10
VOXEL_MM = 25.0
HELD_OUT_SEED = 20_000  # seed of the goals that policies are evaluated on; training uses other seeds


class Pool(NamedTuple):
    """Equilibria of the nominal arm, none of them saturated: every spring is at its reference."""

    q: Array  # (n, nv) [m, rad, rad]
    pressure_kpa: Array  # (n, n_chambers)
    spring_m: Array  # (n, n_chambers)
    pose: Array  # (n, 6) [mm, deg]


@functools.cache
def _solver():
    def solve(params: ArmParams, pressure_kpa: Array) -> Settled:
        kinematics = chain_kinematics(params)
        return settle_pressures(kinematics, params, pressure_kpa)

    return jax.jit(jax.vmap(solve, in_axes=(None, 0)))


def settle_many(spec: ArmSpec, pressure_kpa: np.ndarray) -> Settled:
    """Return equilibria at many pressures (n, n_chambers) [kPa], as NumPy arrays with a leading axis n."""
    params = ArmParams.from_spec(spec)
    n = len(pressure_kpa)
    padded = np.resize(np.asarray(pressure_kpa, np.float32), (-(-n // BATCH) * BATCH, spec.n_chambers))
    parts = [jax.device_get(_solver()(params, part)) for part in np.split(padded, len(padded) // BATCH)]
    return jax.tree.map(lambda *x: np.concatenate(x)[:n], *parts)


def sample_workspace(spec: ArmSpec, n: int, seed: int) -> Pool:
    """Draw poses spread over the whole reachable workspace.

    Pressures follow the arcsine law between their limits, which favours the extremes where the workspace
    ends; of twice as many candidates, `n` are drawn with weights that even out the number of tips per
    voxel of 25 mm. Candidates that did not settle, or with a spring beyond its limits, are left out.

    Args:
        spec: the arm.
        n: number of poses.
        seed: of the draw; training and evaluation use different ones.

    Raises:
        SpecError: the arm settles, its springs within their limits, at fewer than `n` of the candidates.
    """
    rng = np.random.default_rng(seed)
    return _draw(spec, n, random_pressures(spec, CANDIDATES_PER_POSE * n, rng), rng, replace=False)


def sample_evenly(spec: ArmSpec, n: int, seed: int) -> Pool:
    """Draw poses whose tips are uniform in volume over the reachable workspace, rim included.

    Every voxel of 25 mm that a candidate reaches is equally likely, and every candidate within it. Of the ten
    candidates per pose, half have random pressures and half lowest, zero or highest ones in random
    combinations, which are the rim. A pose may come twice.

    Args:
        spec: the arm.
        n: number of poses.
        seed: of the draw; training and evaluation use different ones.

    Raises:
        SpecError: the arm settles, its springs within their limits, at fewer than `n` of the candidates.
    """
    rng = np.random.default_rng(seed)
    half = CANDIDATES_PER_EVEN_POSE * n // 2
    extremes = rng.choice(pressure_levels(spec), (half, spec.n_chambers))
    return _draw(spec, n, np.concatenate([random_pressures(spec, half, rng), extremes]), rng, replace=True)


def _draw(spec: ArmSpec, n: int, pressure_kpa: np.ndarray, rng: np.random.Generator, replace: bool) -> Pool:
    found = settle_many(spec, pressure_kpa)
    in_range = (spec.springs.length_min_m <= found.spring_m) & (found.spring_m <= spec.springs.length_max_m)
    usable = found.settled & in_range.all(axis=-1)
    tip_mm = np.where(usable[:, None], 1e3 * found.tip_position_m, 0.0)
    _, voxel, count = np.unique(
        np.floor(tip_mm / VOXEL_MM).astype(int), axis=0, return_inverse=True, return_counts=True
    )
    weight = usable / count[voxel.ravel()]
    if np.count_nonzero(weight) < n:
        raise SpecError(
            f"{spec.name}: got an arm that settles, its springs within their limits, at "
            f"{np.count_nonzero(weight)} of {len(weight)} random pressures, expected at {n} or more; is it "
            "stiff enough?"
        )
    chosen = rng.choice(len(weight), n, replace=replace, p=weight / weight.sum())
    pose = pose_from_frame(found.tip_position_m[chosen], found.tip_rotation[chosen])
    arrays = (found.q[chosen], found.pressure_kpa[chosen], found.spring_m[chosen], pose)
    return Pool(*map(jnp.asarray, arrays))


def extreme_poses(spec: ArmSpec) -> Settled:
    """Return equilibria at every combination of lowest, zero and highest pressure, 3 ** n_chambers of them.

    Source: the paper's workspace figure.
    """
    return settle_many(spec, np.array(list(itertools.product(pressure_levels(spec), repeat=spec.n_chambers))))


def pressure_levels(spec: ArmSpec) -> tuple[float, float, float]:
    """Return lowest, zero and highest pressure [kPa]."""
    return (spec.chambers.pressure_min_kpa, 0.0, spec.chambers.pressure_max_kpa)
