"""Poses that the arm can reach: random ones, or all combinations of the chambers' extreme pressures."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.params import PAYLOAD, ArmParams
from mjx_softarm.mechanics.settle import Settled, arms_at_once, settle, settle_pressures
from mjx_softarm.posture import hangs
from mjx_softarm.sensing.pose import pose_from_frame
from mjx_softarm.spec import ArmSpec, SpecError

BATCH = 1024
CANDIDATES_PER_POSE = 2
CANDIDATES_PER_EVEN_POSE = 10
VOXEL_MM = 25.0
HELD_OUT_SEED = 20_000  # seed of the goals that policies are evaluated on; training uses other seeds

Seed = int | tuple[int, ...]


class Pool(NamedTuple):
    """Equilibria, float32."""

    q: Array  # (n, nv) [m, rad, rad]
    pressure_kpa: Array  # (n, n_chambers)
    spring_m: Array  # (n, n_springs)
    pose: Array  # (n, 6) [mm, deg]
    load_kg: Array | None = None  # (n,) payload; None: that of the specification


def settle_many(spec: ArmSpec, pressure_kpa: np.ndarray) -> Settled:
    """Return equilibria at many pressures (n, n_chambers) [kPa], as NumPy arrays with a leading axis n."""
    return _in_batches(settle_pressures, spec, pressure_kpa)


def _in_batches(settle_one: Callable[..., Settled], spec: ArmSpec, *columns: np.ndarray) -> Settled:
    """Return `settle_one` of rows of columns (n, ...), as NumPy arrays with a leading axis n."""
    solver = _solver(settle_one, arms_at_once(spec.n_links), len(columns))
    params = ArmParams.from_spec(spec)
    return xla.in_batches(lambda batch: solver(params, *batch), BATCH, columns)


@functools.cache
def _solver(settle_one: Callable[..., Settled], n_at_once: int | None, n_columns: int) -> Callable:
    """Return `settle_one` compiled for many rows of columns and arms with the same parameters."""

    def solve(params: ArmParams, *row: Array) -> Settled:
        return settle_one(params, *row, n_at_once=n_at_once)

    return xla.jit(jax.vmap(solve, in_axes=(None, *[0] * n_columns)))


def _settle_loaded(
    params: ArmParams,
    pressure_kpa: Array,
    load_kg: Array,
    stiffness: Array,
    area: Array,
    n_at_once: int | None,
    by_law: bool = False,
) -> Settled:
    """Return the equilibrium of an arm with its own payload, and factors of its chambers' stiffness and area.

    It is at given pressures or, by the law, at the spring lengths that these give the arm unloaded.
    """
    arm = params.stiffened(stiffness)._replace(area=params.area * area)
    loaded = arm._replace(tool_mass_kg=jnp.asarray(arm.tool_mass_kg).at[PAYLOAD].set(load_kg))
    if not by_law:
        return settle_pressures(loaded, pressure_kpa, n_at_once)
    unloaded = settle_pressures(arm, pressure_kpa, n_at_once)
    settled = settle(loaded, unloaded.spring_m, n_at_once)
    return settled._replace(result=jnp.maximum(settled.result, unloaded.result))


_settle_loaded_by_law = functools.partial(_settle_loaded, by_law=True)


def sample_workspace(spec: ArmSpec, n: int, seed: Seed) -> Pool:
    """Draw n poses spread over the whole reachable workspace.

    Pressures follow the arcsine law between their limits, which favours the extremes, where the workspace
    ends. Of twice as many candidates, `n` are drawn with weights that even out the number of tips per voxel
    of 25 mm. Candidates that did not settle are left out.

    Raises:
        SpecError: the arm settles at fewer than `n` of the candidates.
    """
    rng = np.random.default_rng(seed)
    equilibria = settle_many(spec, random_pressures(spec, CANDIDATES_PER_POSE * n, rng))
    return _pool(equilibria, _chosen(spec, equilibria, equilibria.settled, n, rng, replace=False))


def sample_loaded(spec: ArmSpec, load_kg: np.ndarray, spread: float, seed: int) -> Pool:
    """Draw poses as `sample_workspace` does, of arms with payloads and with chambers that deviate.

    With a payload, an arm that lies or stands may buckle at constant pressures. Its law holds its springs, so
    those of the unloaded arm are drawn.

    Args:
        spec: the arm; its own payload is replaced.
        load_kg (m,) [kg]: payloads of the candidates; half of these are drawn.
        spread: largest relative deviation of each chamber's stiffness and area.
        seed: seed of the draw.

    Raises:
        SpecError: the arm settles at fewer than half of the candidates.
    """
    rng = np.random.default_rng(seed)
    pressure_kpa = random_pressures(spec, len(load_kg), rng)
    factors = rng.uniform(1.0 - spread, 1.0 + spread, (2, *pressure_kpa.shape))
    settle_one = _settle_loaded if hangs(spec) else _settle_loaded_by_law
    equilibria = _in_batches(settle_one, spec, pressure_kpa, load_kg, *factors)
    n = len(load_kg) // CANDIDATES_PER_POSE
    rows = _chosen(spec, equilibria, equilibria.settled, n, rng, replace=False)
    pool = _pool(equilibria, rows)
    return pool._replace(load_kg=np.float32(load_kg[rows]))


def sample_evenly(spec: ArmSpec, n: int, seed: Seed) -> Pool:
    """Draw n poses whose tips are uniform in volume over the reachable workspace, rim included.

    Voxels of 25 mm with a candidate are equally likely, and so are the candidates within a voxel. Of ten
    candidates per pose, half have random pressures; the others combine lowest, zero and highest pressures at
    random, which gives the rim. Candidates are left out that did not settle, or that have a spring beyond the
    limits, which no policy can ask for. A pose may come twice.

    Raises:
        SpecError: the arm settles, its springs within their limits, at fewer than `n` of the candidates.
    """
    rng = np.random.default_rng(seed)
    half = CANDIDATES_PER_EVEN_POSE * n // 2
    extremes = rng.choice(pressure_levels(spec), (half, spec.n_chambers))
    equilibria = settle_many(spec, np.concatenate([random_pressures(spec, half, rng), extremes]))
    shortest, longest = map(spec.at_springs, (spec.springs.length_min_m, spec.springs.length_max_m))
    in_range = (shortest <= equilibria.spring_m) & (equilibria.spring_m <= longest)
    usable = equilibria.settled & in_range.all(axis=-1)
    return _pool(equilibria, _chosen(spec, equilibria, usable, n, rng, replace=True))


def _chosen(
    spec: ArmSpec, equilibria: Settled, usable: Array, n: int, rng: np.random.Generator, replace: bool
) -> np.ndarray:
    """Draw rows (n,) of usable equilibria with weights that even out the number of tips per voxel."""
    # Number of candidates in the voxel of each one
    tip_mm = np.where(usable[:, None], 1e3 * equilibria.tip_position_m, 0.0)
    _, voxel, count = np.unique(
        np.floor(tip_mm / VOXEL_MM).astype(int), axis=0, return_inverse=True, return_counts=True
    )

    # Draw with the inverse of that number
    weight = usable / count[voxel.ravel()]
    if np.count_nonzero(weight) < n:
        raise SpecError(
            f"{spec.name}: got an arm that settles at {np.count_nonzero(weight)} of {len(weight)} random "
            f"pressures, expected at {n} or more; is it stiff enough?"
        )
    return rng.choice(len(weight), n, replace=replace, p=weight / weight.sum())


def _pool(equilibria: Settled, chosen: np.ndarray) -> Pool:
    """Return the chosen rows of equilibria with their poses, as NumPy arrays."""
    pose = pose_from_frame(equilibria.tip_position_m[chosen], equilibria.tip_rotation[chosen])
    return Pool(equilibria.q[chosen], equilibria.pressure_kpa[chosen], equilibria.spring_m[chosen], pose)


def extreme_poses(spec: ArmSpec) -> Settled:
    """Return equilibria at every combination of lowest, zero and highest pressure, 3 ** n_chambers of them.

    Source: the paper's workspace figure.
    """
    return settle_many(spec, np.array(list(itertools.product(pressure_levels(spec), repeat=spec.n_chambers))))


def pressure_levels(spec: ArmSpec) -> tuple[float, float, float]:
    """Return lowest, zero and highest pressure [kPa]."""
    return (spec.chambers.pressure_min_kpa, 0.0, spec.chambers.pressure_max_kpa)
