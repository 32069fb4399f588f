"""Calibration of the springs: L = beta l + delta, L a measured length and l that of a reading.

A robust straight line for each spring, or one for all; see `calib.fit.lines`.

Lengths also tell something of the circuit: L = beta K w / (1 - I_comp w) + delta with w = C (2 pi f)^2 stays
the same when C grows by a factor and beta and I_comp shrink by it. So C stays at its given value and beta
answers for it; I_comp, one for all springs, can be fitted from the curvature of L against f^2 if the lengths
reach far enough.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.errors import FitError
from calib.fit.lines import fit_curved_line, fit_line
from mjx_softarm.sensing.sensors import Coil, Sensor


class SpringFit(NamedTuple):
    """Calibration of n springs; fields as in `LineFit`, lengths in metres."""

    beta: np.ndarray  # (n,)
    delta_m: np.ndarray  # (n,)
    beta_interval: np.ndarray  # (n, 2)
    delta_interval_m: np.ndarray  # (n, 2)
    compensation_h: float | None  # of coils, None where it was not fitted
    compensation_interval_h: tuple[float, float] | None
    rms_m: np.ndarray
    held_out_rms_m: np.ndarray
    noise_m: np.ndarray
    n_rows: np.ndarray
    n_outliers: np.ndarray
    warnings: tuple[str, ...]


def fit_springs(
    readings: np.ndarray,
    length_m: np.ndarray,
    sensor: Sensor,
    fit_compensation: bool = False,
    shared: bool = False,
    block: int = 100,
    seed: int = 0,
) -> SpringFit:
    """Calibrate springs from readings and the lengths that were measured at them.

    Args:
        readings (n, n_springs): readings; those that are not believed are left out.
        length_m (n, n_springs): measured lengths, NaN where there is none.
        sensor: sensor that gave the readings; its beta and delta are not used.
        fit_compensation: fit I_comp, too, one for all springs; coils only.
        shared: fit one beta and delta for all springs.
        block, seed: as in `fit_line`.

    Raises:
        FitError: the shapes differ, a spring has fewer than 3 rows or one reading only, or a compensation is
            to be fitted to sensors that have none.
    """
    readings = np.asarray(readings, float)
    low, high = sensor.range
    believed = (readings >= low) & (readings <= high)
    scale, compensation_h, compensation_interval = 1.0, None, None
    if fit_compensation:
        if not isinstance(sensor, Coil):
            raise FitError(f"fit_compensation: got sensors of kind {sensor.kind}, expected {Coil.kind}")
        inverse_h = np.where(believed, sensor.inverse_inductance(readings), np.nan)
        unit_h = 1.0 / np.nanmax(inverse_h)  # I_comp beyond it would leave no coil
        line, share, half = fit_curved_line(
            inverse_h * unit_h, length_m, sensor.compensation_h / unit_h, True, "spring", shared, block, seed
        )
        scale, compensation_h = unit_h / sensor.coil_hm, share * unit_h
        compensation_interval = ((share - half) * unit_h, (share + half) * unit_h)
        warnings = (*line.warnings, *_compensation_warnings(compensation_interval, unit_h))
    else:
        raw_m, exists = sensor.raw_length(np.where(believed, readings, low))
        line = fit_line(np.where(believed & exists, raw_m, np.nan), length_m, "spring", shared, block, seed)
        warnings = line.warnings
    return SpringFit(
        beta=line.slope * scale,
        delta_m=line.offset,
        beta_interval=line.slope_interval * scale,
        delta_interval_m=line.offset_interval,
        compensation_h=compensation_h,
        compensation_interval_h=compensation_interval,
        rms_m=line.rms,
        held_out_rms_m=line.held_out_rms,
        noise_m=line.noise,
        n_rows=line.n_rows,
        n_outliers=line.n_outliers,
        warnings=warnings,
    )


def _compensation_warnings(interval_h: tuple[float, float], unit_h: float) -> tuple[str, ...]:
    width_h = (interval_h[1] - interval_h[0]) / 2
    if width_h < 0.02 * unit_h:
        return ()
    return (
        f"compensation: known to {width_h:.3g} H only, of {unit_h:.3g} H of the whole circuit, so beta and "
        "delta could make up for it: measure longer and shorter lengths, or leave it as specified",
    )
