"""Errors of the parameters in millimetres of the tip, over the workspace."""

from __future__ import annotations

import numpy as np

from calib.fit.equilibrium import simulate, unmeasured
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.mechanics.workspace import pressure_levels
from mjx_softarm.spec import ArmSpec

N_POSES = 256
PAYLOAD_SHARE = 1.0 / 4.7  # of the arm's mass, the heaviest: 1 kg of the paper's arm
SEED = 0


def tip_changes(spec: ArmSpec, x: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return how far changes of x move the tip at given pressures, to first order, where they do the most.

    Half of the poses have pressures at random and half at the extremes; every second one has the heaviest
    payload.

    Args:
        spec: arm at x = 0.
        x (p,): see `calib.fit.parameters`.
        change (p, k): changes of x.

    Returns:
        Lengths (k,) [m].
    """
    rng = np.random.default_rng(SEED)
    extremes = rng.choice(pressure_levels(spec), (N_POSES // 2, spec.n_chambers))
    pressure_kpa = np.concatenate([random_pressures(spec, N_POSES - len(extremes), rng), extremes])
    heaviest_kg = PAYLOAD_SHARE * (spec.mass.arm_kg + spec.mass.gripper_kg)
    payload_kg = np.where(np.arange(N_POSES) % 2, heaviest_kg, 0.0)
    rotation = np.broadcast_to(np.eye(3), (N_POSES, 3, 3))
    error, slope, _ = simulate(spec, *unmeasured(spec, pressure_kpa, payload_kg, rotation), x)
    settled = np.isfinite(error[:, 0]) & np.isfinite(slope).all(axis=(1, 2))
    return np.linalg.norm(slope[settled, :3] @ change, axis=1).max(axis=0, initial=0.0)
