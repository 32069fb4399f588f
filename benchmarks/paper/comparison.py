"""A twin beside its simulation, before and after calibration, at poses that the calibration has not seen.

The poses are recorded in another session than the calibration's log. What is measured comes from that log
alone: motion capture of the tip, of the rings and of the springs, readings, pressures.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from calib.errors import FitError
from calib.fit.s2r import simulate_poses
from calib.read.static_poses import find_static_poses
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.statics import tendons
from mjx_softarm.mechanics.workspace import settle_many
from mjx_softarm.sensing.s2r import S2R, correct
from mjx_softarm.spec import N_CHAMBERS_PER_SECTION, ArmSpec

# Simulations of a tip: at the measured pressures, twice, and at the spring lengths read, twice.
SIMULATIONS = ("specified", "calibrated", "lengths", "S2R")


class Shapes(NamedTuple):
    """Arms at rest, simulated at given pressures; NaN where an arm finds no rest."""

    plate_m: np.ndarray  # (n, n_links + 1, 3) middles of the plates, the base first
    tip_m: np.ndarray  # (n, 3)
    chamber_m: np.ndarray  # (n, n_chambers)


class Comparison(NamedTuple):
    """Measured poses beside simulated ones; axis 0 of a pair is the arm as specified, then as calibrated."""

    marker_m: np.ndarray  # (n, n_markers, 3) measured, from the base to the tip
    tip_m: np.ndarray  # (n, 3) measured
    chamber_m: np.ndarray  # (n, n_chambers) by `chambers_beside` the measured springs
    plate_pair_m: np.ndarray  # (2, n, n_links + 1, 3) simulated at the measured pressures
    tip_pair_m: np.ndarray  # (2, n, 3)
    chamber_pair_m: np.ndarray  # (2, n, n_chambers)
    read_tip_m: np.ndarray  # (n, 3) simulated at the spring lengths read, as calibrated
    corrected_tip_m: np.ndarray  # (n, 3) the same, corrected by the S2R network
    reading: np.ndarray  # (rows, n_chambers) of the springs' sensors
    ruler_m: np.ndarray  # (rows, n_chambers) spring lengths measured at these readings

    @property
    def errors_mm(self) -> dict[str, np.ndarray]:
        """Distances (n,) of simulated to measured tips, by keys of `SIMULATIONS`."""
        tips = (*self.tip_pair_m, self.read_tip_m, self.corrected_tip_m)
        return {
            name: 1e3 * np.linalg.norm(tip - self.tip_m, axis=-1)
            for name, tip in zip(SIMULATIONS, tips, strict=True)
        }

    @property
    def chamber_rms_mm(self) -> np.ndarray:
        """RMS differences (2, n_sections) of simulated to measured lengths of chambers, at the pressures."""
        by_section = (self.chamber_pair_m - self.chamber_m).reshape(
            2, len(self.tip_m), -1, N_CHAMBERS_PER_SECTION
        )
        return 1e3 * np.sqrt(np.nanmean(by_section**2, axis=(1, 3)))

    def figures(self) -> dict[str, Any]:
        """Return the means of what the pictures show, in mm; NaN where there is no network."""
        specified, calibrated = self.chamber_rms_mm.tolist()
        return {
            "poses": len(self.tip_m),
            "tip_mean_mm": {name: float(np.mean(error)) for name, error in self.errors_mm.items()},
            "chamber_rms_mm": {"specified": specified, "calibrated": calibrated},
        }


def simulate(spec: ArmSpec, pressure_kpa: np.ndarray) -> Shapes:
    """Return an arm at rest at pressures (n, n_chambers) [kPa]."""
    found, params = settle_many(spec, pressure_kpa), ArmParams.from_spec(spec)

    def shape(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        frames = chain_kinematics(params)(q)
        return frames.plate_position, tendons(frames, params.chamber_site_m).length

    plate_m, chamber_m = jax.device_get(jax.vmap(shape)(found.q))
    values = (plate_m, found.tip_position_m, chamber_m)
    settled = np.asarray(found.settled)
    return Shapes(*(_known(settled, np.asarray(x, float)) for x in values))


def chambers_beside(spec: ArmSpec, spring_m: np.ndarray) -> np.ndarray:
    """Return the lengths of the chambers (n, n_chambers) [m] beside springs of measured lengths.

    The mean of a section's springs is the length of its axis. A chamber lies in the direction of its spring,
    nearer to the axis, and differs from the mean by as much less: exact to 0.2 mm on the simulated arm.
    """
    by_section = spring_m.reshape(len(spring_m), -1, N_CHAMBERS_PER_SECTION)
    axis_m = by_section.mean(axis=2, keepdims=True)
    share = spec.geometry.chamber_radius_m / spec.geometry.spring_radius_m
    return (axis_m + share * (by_section - axis_m)).reshape(spring_m.shape)


def compare(log: Log, specified: ArmSpec, calibrated: ArmSpec, s2r: S2R | None) -> Comparison:
    """Simulate the static poses of a log, before and after calibration.

    Args:
        log: poses at rest, with markers, measured spring lengths and readings.
        specified: arm before calibration.
        calibrated: arm after it.
        s2r: its sim-to-real network; without one, no tip is corrected.

    Raises:
        FitError: the log lacks a column.
    """
    for name in ("readings", "spring_m"):
        if getattr(log, name) is None:
            raise FitError(f"{log.source}: {name}: got no such columns, expected those of a twin's log")
    assert log.readings is not None and log.spring_m is not None
    poses, _ = find_static_poses([dataclasses.replace(log, readings=None)], calibrated)
    read, _ = find_static_poses([log], calibrated)
    pair = [simulate(spec, poses.pressure_kpa) for spec in (specified, calibrated)]
    settled = simulate_poses(calibrated, read.spring_m)
    corrected_m = np.full_like(poses.tip_m, np.nan)
    if s2r is not None:
        corrected_m = _known(settled.valid, 1e-3 * correct(s2r, settled.pose, settled.spring_m)[:, :3])
    return Comparison(
        marker_m=poses.marker_m,
        tip_m=poses.tip_m,
        chamber_m=chambers_beside(specified, poses.spring_m),
        plate_pair_m=np.stack([arm.plate_m for arm in pair]),
        tip_pair_m=np.stack([arm.tip_m for arm in pair]),
        chamber_pair_m=np.stack([arm.chamber_m for arm in pair]),
        read_tip_m=_known(settled.valid, 1e-3 * settled.pose[:, :3]),
        corrected_tip_m=corrected_m,
        reading=log.readings,
        ruler_m=log.spring_m,
    )


def _known(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (n, ...), NaN where the mask (n,) is False."""
    return np.where(mask.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)
