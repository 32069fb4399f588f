"""Pressures that hold a calibrated arm at rest, minus the simulated ones: a process for each section.

Real chambers harden, and their areas grow with pressure; simulated chambers do not. The residual of the c
chambers of a section, without their hysteresis, is a Gaussian process of the section's state u: its spring
lengths and simulated pressures, standardised. With the covariance V (c, c) between chambers,

    cov(r(u), r(u')) = k(u, u') V,    k = 1 + u.u' + exp(-|u - u'|^2 / (2 l^2)) + noise where u = u'.

Its mean corrects the pressures that show a payload. Its variance, large far from the poses of the log, is the
accuracy of a payload.

A payload changes a chamber's pressure by the simulated change times a factor. The log of an unloaded arm does
not show this factor: with all stiffnesses, areas and masses greater by the same share, the log is the same.
So the factors are normally distributed about 1, or about what poses with a known weight have shown.

Source: Rasmussen, Williams, "Gaussian Processes for Machine Learning", MIT Press 2006, section 2.2.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from mjx_softarm._support.archive import Entries, entries_of, read_sealed, write_sealed
from mjx_softarm.sensing.load import COMMON_FACTOR, OWN_FACTOR

KIND = "pressures"
PRESSURES_FILE = "pressures.npz"  # in the folder of a calibration, and of a run that was trained with it


class HeldPressures(NamedTuple):
    """Residual pressures at n poses at rest of an arm with s sections, c chambers a section. All float64."""

    state: np.ndarray  # (n, s, d) standardised springs and simulated pressures of the sections
    centre: np.ndarray  # (s, d) [m, kPa] subtracted from springs and pressures
    scale: np.ndarray  # (s, d) [m, kPa] divided by
    residual_kpa: np.ndarray  # (n, s, c) measured minus simulated pressures, without hysteresis
    length: np.ndarray  # (s,) distance of states over which the residual changes
    noise: np.ndarray  # (s,) variance that no state explains, as a multiple of V
    covariance_kpa2: np.ndarray  # (s, c, c) V
    hysteresis_kpa: np.ndarray  # (s,) largest pressure of a chamber's hysteresis
    stroke_m: np.ndarray  # (s,) stroke of its stop operator
    # A payload's change of all chambers' pressures, real over simulated, and its relative standard deviation.
    factor: float = 1.0
    factor_sd: float = COMMON_FACTOR


class Residual(NamedTuple):
    """Posterior of the residual pressures of m arms at rest without a payload."""

    mean_kpa: np.ndarray  # (m, s, c)
    share: np.ndarray  # (m, s) variance, noise included, as a multiple of V


def factor_covariance(held: HeldPressures, n: int) -> np.ndarray:
    """Return the covariance (n, n) of the factors of n chambers at a pose, over their mean `factor`."""
    return held.factor_sd**2 + OWN_FACTOR**2 * np.eye(n)


def held_kpa(
    held: HeldPressures,
    spring_m: np.ndarray,
    light_kpa: np.ndarray,
    effect_kpa: np.ndarray,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Return the pressures (m, n_chambers) [kPa] that hold the real arm.

    Args:
        spring_m (m, n_springs) [m]: spring lengths.
        light_kpa (m, n_chambers) [kPa]: pressures that hold the simulated arm there without a payload.
        effect_kpa (m, n_chambers) [kPa]: simulated change of these pressures by the arm's payload.
        rng: generator of residuals and factors for each arm; without one, means are returned.
    """
    residuals = residual(held, spring_m, light_kpa)
    left_kpa, relative = residuals.mean_kpa, np.ones_like(light_kpa)
    if rng is not None:
        root, (m, n) = np.linalg.cholesky(held.covariance_kpa2), light_kpa.shape
        normal = rng.standard_normal(left_kpa.shape)
        left_kpa = left_kpa + np.sqrt(residuals.share)[..., None] * np.einsum("sij,msj->msi", root, normal)
        relative = rng.multivariate_normal(np.ones(n), factor_covariance(held, n), m)
    return light_kpa + left_kpa.reshape(light_kpa.shape) + held.factor * relative * effect_kpa


def sections_of(spring_m: np.ndarray, pressure_kpa: np.ndarray, n_sections: int) -> np.ndarray:
    """Return the springs [m] and pressures [kPa] (m, s, d) of each section, of arms (m, ...)."""
    parts = [x.reshape(len(x), n_sections, x.shape[1] // n_sections) for x in (spring_m, pressure_kpa)]
    return np.concatenate(parts, axis=-1).astype(float)


def kernel(a: np.ndarray, b: np.ndarray, length: float) -> np.ndarray:
    """Return k (n, m) between the states (n, d) and (m, d) of a section, without noise."""
    inner = a @ b.T
    square = np.maximum(np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * inner, 0.0)
    return 1.0 + inner + np.exp(-square / (2.0 * length**2))


def residual(held: HeldPressures, spring_m: np.ndarray, pressure_kpa: np.ndarray) -> Residual:
    """Return the residuals at springs (m, n_springs) [m] that simulated pressures (m, n_chambers) hold."""
    n_sections = held.state.shape[1]
    state = (sections_of(spring_m, pressure_kpa, n_sections) - held.centre) / held.scale
    mean, share = np.empty((len(state), *held.residual_kpa.shape[1:])), np.empty(state.shape[:2])
    for s in range(n_sections):
        rows, length = held.state[:, s], held.length[s]
        factor = cho_factor(kernel(rows, rows, length) + held.noise[s] * np.eye(len(rows)), lower=True)
        across = kernel(rows, state[:, s], length)  # (n, m)
        mean[:, s] = across.T @ cho_solve(factor, held.residual_kpa[:, s])
        prior = 2.0 + np.sum(state[:, s] ** 2, axis=1)
        share[:, s] = prior - np.sum(across * cho_solve(factor, across), axis=0) + held.noise[s]
    return Residual(mean, np.maximum(share, held.noise))


def covariances(held: HeldPressures, share: np.ndarray) -> np.ndarray:
    """Return covariances (m, s c, s c) [kPa^2] of residual pressures with variances (m, s) over V."""
    s, c, _ = held.covariance_kpa2.shape
    blocks = np.einsum("ms,st,sij->msitj", share, np.eye(s), held.covariance_kpa2)
    return blocks.reshape(len(share), s * c, s * c)


def save_pressures(path: Path, held: HeldPressures) -> None:
    """Write a process; raises as `write_sealed` does."""
    write_sealed(path, entries_of(KIND, held), KIND)


def find_pressures(folder: Path, n_sections: int, n_springs: int, n_chambers: int) -> HeldPressures | None:
    """Read the process of an arm from a folder; None where the folder has none.

    Raises:
        SealedFileError: the file is damaged, or of another arm.
    """
    file = folder / PRESSURES_FILE
    if not file.exists():
        return None
    entries = Entries(read_sealed(file, KIND, "python -m calib run"), str(file))
    s, c = n_sections, n_chambers // n_sections
    d = n_springs // n_sections + c
    shapes: dict[str, tuple[int | None, ...]] = {
        "state": (None, s, d),
        "centre": (s, d),
        "scale": (s, d),
        "residual_kpa": (None, s, c),
        "length": (s,),
        "noise": (s,),
        "covariance_kpa2": (s, c, c),
        "hysteresis_kpa": (s,),
        "stroke_m": (s,),
        "factor": (),
        "factor_sd": (),
    }
    arrays = {name: entries.take(f"{KIND}.{name}", np.float64, shape) for name, shape in shapes.items()}
    entries.finish(1)
    return HeldPressures(**arrays)
