"""Poses to record next that tell payloads.

Poses that are recorded make the variances v_s of the residual pressures (`calib.fit.payload`) smaller around
them, whatever pressures are measured there. So poses can be chosen before they are recorded.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.fit.payload import PayloadPoses
from mjx_softarm.sensing.held_pressures import HeldPressures, kernel, residual, sections_of


def informed(held: HeldPressures, spring_m: np.ndarray, pressure_kpa: np.ndarray) -> HeldPressures:
    """Return a process that knows k poses more, whose residuals are its own means there."""
    if not len(spring_m):
        return held
    state = (sections_of(spring_m, pressure_kpa, held.state.shape[1]) - held.centre) / held.scale
    mean_kpa = residual(held, spring_m, pressure_kpa).mean_kpa
    return held._replace(
        state=np.concatenate([held.state, state]), residual_kpa=np.concatenate([held.residual_kpa, mean_kpa])
    )


def choose_for_payload(
    held: HeldPressures,
    at: PayloadPoses,
    spring_m: np.ndarray,
    pressure_kpa: np.ndarray,
    n: int,
    taken: np.ndarray | None = None,
) -> np.ndarray:
    """Choose n poses to record that reduce the payload's mean variance most, one by one.

    Args:
        held: residual pressures known so far.
        at: poses at which the payload is to be told.
        spring_m (k, n_springs) [m]: spring lengths of the candidates.
        pressure_kpa (k, n_chambers) [kPa]: pressures of the candidates.
        n: number of poses.
        taken: indices of candidates that are chosen already, and known to the process.

    Returns:
        Indices (n,) of candidates.
    """
    # Covariances (s, ...) of the sections' states given the recorded poses: candidates with all poses
    options = np.concatenate([spring_m, at.spring_m]), np.concatenate([pressure_kpa, at.pressure_kpa])
    states = (sections_of(*options, held.state.shape[1]) - held.centre) / held.scale
    k, across = len(spring_m), []
    for s, (length, noise) in enumerate(zip(held.length, held.noise, strict=True)):
        rows, state = held.state[:, s], states[:, s]
        factor = cho_factor(kernel(rows, rows, length) + noise * np.eye(len(rows)), lower=True)
        known = kernel(rows, state, length)
        across.append(kernel(state[:k], state, length) - known[:, :k].T @ cho_solve(factor, known))
    covariance, strength = np.array(across), _strength(held, at)
    share = residual(held, at.spring_m, at.pressure_kpa).share
    own = np.arange(k)
    chosen: list[int] = []
    for _ in range(n):
        # Variances (k, m, s) of the payload's poses with each candidate, then the best candidate
        seen = covariance[:, own, own] + held.noise[:, None]  # (s, k)
        less = covariance[:, :, k:] ** 2 / seen[..., None]  # (s, k, m)
        after = np.maximum(share.T[:, None] - less, held.noise[:, None, None])
        variance = 1.0 / np.sum(strength.T[:, None] / after, axis=0)  # (k, m)
        variance = np.mean(variance, axis=1)
        variance[[*chosen, *(() if taken is None else taken)]] = np.inf
        best = int(np.argmin(variance))
        chosen.append(best)
        # Covariances given that one, too
        share = after[:, best].T
        covariance -= covariance[:, :, best, None] * (covariance[:, best] / seen[:, best, None])[:, None]
    return np.array(chosen, int)


def _strength(held: HeldPressures, at: PayloadPoses) -> np.ndarray:
    """Return e_s^T V_s^-1 e_s (m, s) [1/kg^2]."""
    effect = at.effect_kpa_per_kg.reshape(len(at.spring_m), *held.residual_kpa.shape[1:])
    inverse = np.linalg.inv(held.covariance_kpa2)
    return np.einsum("msi,sij,msj->ms", effect, inverse, effect)
