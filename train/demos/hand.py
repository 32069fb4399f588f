"""Demonstrations as a person's hand would give them: the scripted expert with noise and detours.

A hand meets no waypoint exactly. Where it picks or places an object it looks closely; elsewhere it only
passes. Some of its moves are not straight. The sizes here are assumptions, not measurements. The expert still
finds the postures, so each position is one that the arm can take with its body inside the pipe.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import jax
import numpy as np

from train.demos.expert import Expert, ExpertError, Posture
from train.demos.waypoints import Waypoint

NOISE_M = 0.008  # standard deviation per axis
STOP_NOISE_M = 0.003  # where an object is picked or placed; the gripper takes it within 20 mm
DETOUR_SHARE = 1 / 3  # of the moves
DETOUR_M = 0.03  # distance of a detour from the straight way
N_TRIES = 8  # draws of a position before the scripted one is taken


def by_hand(expert: Expert, waypoints: Sequence[Waypoint], seed: int) -> tuple[tuple[Waypoint, ...], Posture]:
    """Return waypoints as a hand takes them, detours included, and their planned postures (n,).

    A position that the arm cannot take is drawn again. After `N_TRIES` draws the scripted one is taken, and a
    detour is left out.

    Args:
        expert: expert for the arm.
        waypoints: scripted ones.
        seed: of the noise and the detours.

    Raises:
        ExpertError: a scripted waypoint is needed, and cannot be met.
    """
    rng, n_moves = np.random.default_rng(seed), len(waypoints) - 1
    detours = 1 + rng.permutation(n_moves)[: round(DETOUR_SHARE * n_moves)]
    path, before_kpa = [], np.zeros(expert.spec.n_chambers)
    for k, waypoint in enumerate(waypoints):
        if k in detours:
            tries = _detours(path[-1][0].finger_m, waypoint, rng)
            with contextlib.suppress(ExpertError):
                path.append(_first_met(expert, tries, before_kpa))
                before_kpa = path[-1][1].pressure_kpa
        path.append(_first_met(expert, [*_off(waypoint, rng), waypoint], before_kpa))
        before_kpa = path[-1][1].pressure_kpa
    taken, found = zip(*path, strict=True)
    return taken, jax.tree.map(lambda *x: np.stack(x), *found)


def _off(waypoint: Waypoint, rng: np.random.Generator) -> list[Waypoint]:
    """Return draws of a waypoint as the hand meets it."""
    noise_m = STOP_NOISE_M if waypoint.operation else NOISE_M
    off_m = noise_m * rng.standard_normal((N_TRIES, 3))
    return [waypoint._replace(finger_m=waypoint.finger_m + off) for off in off_m]


def _detours(start_m: np.ndarray, waypoint: Waypoint, rng: np.random.Generator) -> list[Waypoint]:
    """Return draws of a position beside the middle of the straight way from a point (3,) to a waypoint."""
    way_m = waypoint.finger_m - start_m
    along = way_m / np.linalg.norm(way_m)
    aside = rng.standard_normal((N_TRIES, 3))
    aside -= (aside @ along)[:, None] * along
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    name = f"detour to {waypoint.name.removeprefix('to ')}"
    return [Waypoint(name, start_m + 0.5 * way_m + DETOUR_M * direction) for direction in aside]


def _first_met(expert: Expert, tries: Sequence[Waypoint], before_kpa: np.ndarray) -> tuple[Waypoint, Posture]:
    """Return the first waypoint that the arm can take, with its posture near the one at `before_kpa`.

    Raises:
        ExpertError: it can take none; the message is that of the last one.
    """
    for waypoint in tries[:-1]:
        with contextlib.suppress(ExpertError):
            return waypoint, expert.reach(waypoint.name, expert.target(waypoint), before_kpa)
    last = tries[-1]
    return last, expert.reach(last.name, expert.target(last), before_kpa)
