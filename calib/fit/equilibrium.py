"""Static equilibrium of the arm as a differentiable function of its parameters, beside measured poses."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from calib.fit.parameters import free_arm, marker_sites, with_numbers
from mjx_softarm._support import xla
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.kinematics import Frames, chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import RESIDUAL_TOLERANCE, settle_pressures
from mjx_softarm.mechanics.workspace import pressure_levels
from mjx_softarm.spec import ArmSpec

BATCH = 128  # poses simulated together
N_KINDS = 4  # kinds of errors: tip, rotation, springs, markers
N_WORKSPACE = 256  # poses over the workspace
STRAIGHT = 0.2  # excess of one of three chambers over the others in a straight arm, as a share of the range


class Measured(NamedTuple):
    """Measurements of an arm at one pose at rest, with a leading axis at several; NaN where not measured."""

    pressure_kpa: Array | np.ndarray  # (n_chambers,)
    payload_kg: Array | np.ndarray  # ()
    tip_m: Array | np.ndarray  # (3,)
    tip_rotation: Array | np.ndarray  # (3, 3)
    spring_m: Array | np.ndarray  # (n_springs,)
    end_m: Array | np.ndarray  # (n_sections, 3) markers on the sections' last plates

    def take(self, poses: np.ndarray) -> Measured:
        """Return some of the poses, chosen by indices or a mask (n,)."""
        return Measured(*(value[poses] for value in self))


def residuals(x: Array, params: ArmParams, measured: Measured) -> tuple[Array, Array]:
    """Return simulated minus measured pose of one arm at rest.

    Args:
        x (p,): see `calib.fit.parameters`.
        params: arm at x = 0, with free chambers; its payload is not used.
        measured: measurements of one pose.

    Returns:
        Errors (6 + n_springs + 3 n_sections,) of the tip [m], the rotation [rad] as its axis times the sine
        of the angle, the springs [m] and the markers at the sections' ends [m]; largest residual force () [N,
        N m].
    """
    # Settle the arm at the measured pressures.
    masses = jnp.stack([params.tool_mass_kg[0], measured.payload_kg])
    arm = with_numbers(x, params._replace(tool_mass_kg=masses))
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        found = settle_pressures(arm.without_pressure_limits(), jnp.asarray(measured.pressure_kpa))
        frames = chain_kinematics(arm)(found.q)
        turn = measured.tip_rotation.T @ found.tip_rotation
        end_m = _section_ends(frames, marker_sites(x, arm))
    # Compare it with the measured pose.
    angle = 0.5 * jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    error = [
        found.tip_position_m - measured.tip_m,
        angle,
        found.spring_m - measured.spring_m,
        (end_m - measured.end_m).reshape(-1),
    ]
    return jnp.concatenate(error), found.residual


def error_groups(spec: ArmSpec, pressure_kpa: np.ndarray) -> np.ndarray:
    """Return the kind (n, m) of each of the `residuals` at pressures (n, n_chambers).

    Kinds are tip 0, rotation 1, springs 2 and markers 3. Errors of straight arms, whose sections have nearly
    one pressure each, have other kinds, `N_KINDS` more: the simulated arm has no torsion and shear, which act
    where an arm bends.
    """
    n = spec.structure.chambers_per_section
    kind = np.repeat(range(N_KINDS), [3, 3, spec.n_springs, 3 * spec.structure.n_sections])
    circle = np.exp(2j * np.pi * np.arange(n) / n)
    off_centre = np.abs(pressure_kpa.reshape(len(pressure_kpa), -1, n) @ circle)
    span = spec.chambers.pressure_max_kpa - spec.chambers.pressure_min_kpa
    straight = np.all(off_centre < STRAIGHT * span * (n / 3), axis=1, keepdims=True)
    return kind + N_KINDS * straight


def _section_ends(frames: Frames, site_m: Array) -> Array:
    """Return the places (n_sections, 3) [m] of sites (n_sections, 3) [m] on the sections' last plates."""
    step = (len(frames.plate_position) - 1) // len(site_m)
    position, rotation = frames.plate_position[step::step], frames.plate_rotation[step::step]
    return position + jnp.sum(rotation * site_m[:, None], axis=-1)


def unmeasured(
    spec: ArmSpec, pressure_kpa: np.ndarray, payload_kg: np.ndarray, tip_rotation: np.ndarray
) -> Measured:
    """Return n poses to simulate that nobody measured: zeros but for the axes of the tip."""
    n, n_sections = len(payload_kg), spec.structure.n_sections
    tip_m, spring_m, end_m = np.zeros((n, 3)), np.zeros((n, spec.n_springs)), np.zeros((n, n_sections, 3))
    return Measured(pressure_kpa, payload_kg, tip_m, tip_rotation, spring_m, end_m)


def simulate(spec: ArmSpec, measured: Measured, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Simulate all poses at x.

    Args:
        spec: arm at x = 0.
        measured: n poses.
        x (p,): see `calib.fit.parameters`.

    Returns:
        Errors (n, m) of `residuals`, inf where the arm does not settle; their Jacobian (n, m, p).
    """
    start, params = free_arm(spec, x)
    simulated = functools.partial(_jacobian(), np.float32(start), params)
    error, slope, settled = xla.in_batches(simulated, BATCH, measured)
    return np.where(settled[:, None], error.astype(float), np.inf), slope.astype(float)


def tip_changes(spec: ArmSpec, x: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the largest movement of the tip by changes of x, over the workspace and to first order.

    Half of the poses have random pressures and half have extreme ones; every second pose has the heaviest
    payload.

    Args:
        spec: arm at x = 0.
        x (p,): see `calib.fit.parameters`.
        change (p, k): changes of x.

    Returns:
        Lengths (k,) [m].
    """
    rng = np.random.default_rng(0)
    extremes = rng.choice(pressure_levels(spec), (N_WORKSPACE // 2, spec.n_chambers))
    pressure_kpa = np.concatenate([random_pressures(spec, N_WORKSPACE - len(extremes), rng), extremes])
    payload_kg = np.where(np.arange(N_WORKSPACE) % 2, spec.mass.largest_payload_kg, 0.0)
    rotation = np.broadcast_to(np.eye(3), (N_WORKSPACE, 3, 3))
    error, slope = simulate(spec, unmeasured(spec, pressure_kpa, payload_kg, rotation), x)
    settled = np.isfinite(error[:, 0]) & np.isfinite(slope).all(axis=(1, 2))
    return np.linalg.norm(slope[settled, :3] @ change, axis=1).max(axis=0, initial=0.0)


@functools.cache
def _jacobian():
    """Return the compiled errors, Jacobian and mask of settled arms of a batch."""

    def one(x, params: ArmParams, measured: Measured):
        def errors(x):
            error, left = residuals(x, params, measured)
            return error, (error, left)

        slope, (error, left) = jax.jacfwd(errors, has_aux=True)(x)
        return error, slope, left < RESIDUAL_TOLERANCE

    return xla.jit(jax.vmap(one, in_axes=(None, None, 0)))
