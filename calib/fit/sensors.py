"""Calibration of the springs: L = beta l + delta, L a measured length and l the raw length of a reading.

Each spring has a robust line, or all have one; see `calib.fit.lines`.

Of a coil, L = beta K w / (1 - I_comp w) + delta with w = C (2 pi f)^2. This stays the same when C grows by a
factor and beta and I_comp shrink by it, so C keeps its given value. The curvature of L against f^2 shows
I_comp, one for all springs, if the lengths reach far enough.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.fit.lines import fit_line
from mjx_softarm._support.errors import InputError
from mjx_softarm.sensing.sensors import Coil, Sensor


class SpringFit(NamedTuple):
    """Calibration of n springs; fields as in `LineFit`, lengths in metres."""

    beta: np.ndarray  # (n,)
    delta_m: np.ndarray  # (n,)
    beta_interval: np.ndarray  # (n, 2)
    delta_interval_m: np.ndarray  # (n, 2)
    compensation_h: float | None  # None where it was not fitted
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
    seed: int = 0,
) -> SpringFit:
    """Calibrate springs from readings and the lengths that were measured at them.

    Args:
        readings (n, n_springs): readings; readings outside the sensor's range are left out.
        length_m (n, n_springs): measured lengths, NaN where there is none.
        sensor: sensor that gave the readings; its beta and delta are not used.
        fit_compensation: fit I_comp, too, one for all springs; coils only.
        shared: fit one beta and delta for all springs.
        seed: seed that chooses which blocks of rows are held out together.

    Raises:
        InputError: the shapes differ, a spring has fewer than 3 rows or one reading only, or the sensors have
            no compensation to fit.
    """
    readings = np.asarray(readings, float)
    low, high = sensor.range
    believed = (readings >= low) & (readings <= high)
    scale, share, unit_h = 1.0, 0.0, 1.0
    # Lengths are straight in raw lengths; with a compensation in w / (1 - I_comp w), the largest w being 1.
    if fit_compensation:
        if not isinstance(sensor, Coil):
            raise InputError(f"fit_compensation: got sensors of kind {sensor.kind}, expected {Coil.kind}")
        inverse_h = np.where(believed, sensor.inverse_inductance(readings), np.nan)
        unit_h = 1.0 / np.nanmax(inverse_h)  # I_comp beyond it would leave no coil
        x, scale, share = inverse_h * unit_h, unit_h / sensor.coil_hm, sensor.compensation_h / unit_h
    else:
        raw_m, exists = sensor.raw_length(np.where(believed, readings, low))
        x = np.where(believed & exists, raw_m, np.nan)
    line = fit_line(x, length_m, shared, seed, share, fit_compensation)
    low_h, high_h = (unit_h * bound for bound in line.share_interval)
    warnings = _compensation_warnings(0.5 * (high_h - low_h), unit_h) if fit_compensation else ()
    return SpringFit(
        beta=line.slope * scale,
        delta_m=line.offset,
        beta_interval=line.slope_interval * scale,
        delta_interval_m=line.offset_interval,
        compensation_h=line.share * unit_h if fit_compensation else None,
        compensation_interval_h=(low_h, high_h) if fit_compensation else None,
        rms_m=line.rms,
        held_out_rms_m=line.held_out_rms,
        noise_m=line.noise,
        n_rows=line.n_rows,
        n_outliers=line.n_outliers,
        warnings=(*line.warnings, *warnings),
    )


def _compensation_warnings(width_h: float, unit_h: float) -> tuple[str, ...]:
    if width_h < 0.02 * unit_h:
        return ()
    return (
        f"compensation: known to {width_h:.3g} H only, of {unit_h:.3g} H of the whole circuit, so beta and "
        "delta could make up for it: measure longer and shorter lengths, or leave it as specified",
    )
