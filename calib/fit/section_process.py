"""Gaussian process of an arm's sections: from the simulated tip to the real one, learned from few poses.

A real section twists, shears and hardens as its simulation does not. How much depends on that section's own
shape and load. So each section s has an unknown correction g_s, a small shift and turn at its middle in its
own axes. It depends on the section's state u_s alone: its spring lengths, the direction of gravity in its
axes, and the moment of all weights below. With E_s, the lever by which the middle of section s moves the
tip, the correction of the tip is

    y = sum_s E_s g_s(u_s) + noise.

Each g_s is a Gaussian process with the covariance v (1 + exp(-|u - u'|^2 / (2 l^2))), so y is one, too. Of a
grid, the length l and the noise are taken that make the rows most likely; the variance v has a closed form.

Source: Rasmussen, Williams, "Gaussian Processes for Machine Learning", MIT Press 2006, section 2.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from calib.fit.likelihood import most_likely, solve
from mjx_softarm.mechanics.kinematics import Frames
from mjx_softarm.mechanics.params import ArmParams

LENGTHS = (2.0, 3.0, 4.5, 7.0)  # distances of states, see `sections`
NOISES = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0)  # variances over the variance of a section
MAX_GRID_ROWS = 200  # rows by which length and noise are chosen
MAX_ROWS = 1_000  # rows of the process
LEAST = 1e-12  # [mm^2] least variance of a section
N_OUTPUTS = 6  # shift [mm], Gibbs vector


class Sections(NamedTuple):
    """States of the s sections of simulated arms at rest, and the levers of their middles on the tip.

    A movement (6,) is a shift [mm] and a Gibbs vector times `lever_mm`.
    """

    state: np.ndarray | Array  # (n, s, 6 + springs of a section), see `sections`
    effect: np.ndarray | Array  # (n, s, 6, 6) tip's movement by a movement of a middle
    lever_mm: np.ndarray | Array  # (n,) half of the longest section's length


def sections(frames: Frames, params: ArmParams, spring_m: Array) -> Sections:
    """Return states and effects (s, ...) of the sections of one arm with springs (n_springs,) [m].

    A state holds spring lengths in quarters of the section's length, the vertical in the section's axes, and
    the moment of the weights below, in units of the whole arm's weight half the section's length aside. More
    than three springs, which measure no more than three do, weigh as much as three.
    """
    # Find the plate in the middle of each section, and the moment of the weights below it.
    n_sections, length_m = params.n_sections, params.section_length_m
    per_section = params.link_mass_kg.shape[0] // n_sections
    middle = per_section * np.arange(n_sections) + per_section // 2
    position, rotation = frames.plate_position[middle], frames.plate_rotation[middle]
    last_m, down = frames.plate_position[-1], -frames.plate_rotation[-1, :, 2]
    body_m = jnp.concatenate([frames.anchor, last_m + params.tool_offset_m[:, None] * down])
    body_kg = jnp.concatenate([params.link_mass_kg, params.tool_mass_kg])
    below = np.arange(len(body_m)) >= middle[:, None]  # (s, bodies)
    lever_kgm = jnp.sum((below * body_kg)[..., None] * (body_m - position[:, None]), axis=1)
    moment = jnp.cross(lever_kgm, jnp.array([0.0, 0.0, 1.0])) / (0.5 * length_m[:, None] * body_kg.sum())
    local = jnp.einsum("sij,si->sj", rotation, moment)
    stretched = spring_m.reshape(n_sections, -1) / (0.25 * length_m[:, None])
    stretched = stretched * math.sqrt(3 / stretched.shape[1])
    # Let the middle move: the tip moves with it as one rigid body.
    lever_mm = 500.0 * jnp.max(length_m)
    aside = 1000.0 * (frames.tip_position - position)[:, None, :]
    turned = jnp.cross(jnp.swapaxes(rotation, 1, 2), aside) * 2.0 / lever_mm  # (s, axis of the turn, shift)
    shift = jnp.concatenate([rotation, jnp.swapaxes(turned, 1, 2)], axis=2)
    turn = jnp.concatenate([jnp.zeros_like(rotation), rotation], axis=2)
    effect = jnp.concatenate([shift, turn], axis=1)
    return Sections(jnp.concatenate([stretched, rotation[:, 2, :], local], axis=1), effect, lever_mm)


def fit_process(rows: Sections, y: np.ndarray) -> Callable[[Sections], np.ndarray]:
    """Fit a process to the corrections y (n, 6) [mm, Gibbs vector] of n simulated tips.

    At most `MAX_ROWS` rows take part, evenly spread.

    Returns:
        Function from m simulated arms to the mean (m, 6) [mm, Gibbs vector] of the process.
    """
    rows, y = _some(Sections(*(np.asarray(values, float) for values in rows)), y, MAX_ROWS)
    few, few_y = _some(rows, y, MAX_GRID_ROWS)
    movement = (few_y * _units(few)).reshape(-1, 1)
    length, noise, _ = most_likely(
        movement, lambda length: _covariance(few, few, length), LENGTHS, NOISES, LEAST
    )
    weight, _ = solve(_covariance(rows, rows, length), noise, (y * _units(rows)).ravel())
    at_sections = np.einsum("nsji,nj->nsi", rows.effect, weight.reshape(len(y), N_OUTPUTS))

    def predict(at: Sections) -> np.ndarray:
        mean = np.zeros((len(at.state), N_OUTPUTS))
        for s in range(at.state.shape[1]):
            likeness = _likeness(at.state[:, s], rows.state[:, s], length)
            mean += np.einsum("nij,nj->ni", at.effect[:, s], likeness @ at_sections[:, s])
        return mean / _units(at)

    return predict


def _some(rows: Sections, y: np.ndarray, n: int) -> tuple[Sections, np.ndarray]:
    chosen = np.linspace(0, len(y) - 1, min(n, len(y))).round().astype(int)
    return Sections(*(values[chosen] for values in rows)), y[chosen]


def _covariance(a: Sections, b: Sections, length: float) -> np.ndarray:
    """Return the covariance (6 n, 6 m) of two sets of tips, over the sections' variance."""
    total = np.zeros((len(a.state), N_OUTPUTS, len(b.state), N_OUTPUTS))
    for s in range(a.state.shape[1]):
        likeness = _likeness(a.state[:, s], b.state[:, s], length)
        total += likeness[:, None, :, None] * np.einsum("nik,mjk->nimj", a.effect[:, s], b.effect[:, s])
    return total.reshape(N_OUTPUTS * len(a.state), -1)


def _likeness(a: np.ndarray | Array, b: np.ndarray | Array, length: float) -> np.ndarray:
    square = np.maximum((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T, 0.0)
    return 1.0 + np.exp(-square / (2.0 * length**2))


def _units(at: Sections) -> np.ndarray:
    """Return factors (n, 6) that bring the Gibbs vector to millimetres."""
    lever_mm = np.asarray(at.lever_mm)[:, None]
    return np.concatenate([np.ones((len(lever_mm), 3)), np.repeat(lever_mm, 3, axis=1)], axis=1)
