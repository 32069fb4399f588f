"""Regulators of a real arm, fitted to the log of one day and asked for the pressures of another day.

The fit is calibration's, `calib.fit.motion.actuators`. The chambers' volumes are not known and taken as
constant. A prediction begins with the first measured pressures and then sees the commands alone.

Source: ASU-RISE-Lab/4-chamber-softarm-control (commit 6df7ec9d).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.calibration.logs import ASU_LOGS, read_asu
from benchmarks.harness.common import target
from calib.fit.motion.actuators import fit_regulator
from calib.fit.motion.tracks import Runs, Track
from mjx_softarm.logs.schema import UNITS

PSI = UNITS["pressure"]["psi"]
PERIOD_S = 0.02
GOAL_PSI = 0.5


def measure(data: Path) -> dict[str, Any]:
    """How well do regulators fitted to one day of a real arm predict its pressures on another day, in psi?

    Args:
        data: folder with `asu_softarm`.

    Raises:
        LogError: a log is missing, or cannot be read.
    """
    days = {name: Runs([track_of(data, name)], PERIOD_S) for name in ASU_LOGS}
    figures, targets = {}, []
    for fitted, asked in (("apr5", "apr4"), ("apr4", "apr5")):
        regulator = fit_regulator(days[fitted], np.ones(days[fitted].n_seconds * 6, bool))[0]
        track = days[asked].tracks[0]
        command = days[asked].clusters([track.commanded_kpa - track.pressure_kpa])
        errors = {
            f"of {fitted}, the day of the fit": days[fitted].errors(regulator),
            f"of {asked}": days[asked].errors(regulator),
            f"of {asked}, the command taken for the pressure": command,
        }
        found = {name: _rms_psi(error, days[asked].rows) for name, error in errors.items()}
        numbers = {name: np.round(value, 3).tolist() for name, value in vars(regulator).items()}
        figures[f"fitted to {fitted}"] = {"RMS [psi]": found, "regulators": numbers}
        rms = found[f"of {asked}"]["all"]
        text = f"fitted to {fitted}, pressures of {asked}: at most {GOAL_PSI:g} psi RMS"
        targets.append(target(text, f"{rms:.2f}", rms <= GOAL_PSI))
    return {"targets": targets, **figures}


def track_of(data: Path, name: str) -> Track:
    """Return the log of a day at a steady rate; a command holds until the next row."""
    log = read_asu(data / ASU_LOGS[name])
    grid = np.arange(log.time_s[0], log.time_s[-1], PERIOD_S)
    held = np.searchsorted(log.time_s, grid, side="right") - 1
    measured = np.stack([np.interp(grid, log.time_s, column) for column in log.pressure_kpa.T], axis=1)
    return Track(log.commanded_kpa[held], measured, np.ones_like(measured))


def _rms_psi(error_kpa: np.ndarray, rows: int) -> dict[str, Any]:
    """Return the RMS of errors (clusters, rows), of all chambers together and of each."""
    square = (error_kpa.reshape(-1, 6, rows) / PSI) ** 2
    of_each = np.sqrt(np.nanmean(square, axis=(0, 2)))
    return {"all": float(np.sqrt(np.nanmean(square))), "chambers": np.round(of_each, 2).tolist()}
