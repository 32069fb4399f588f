"""Planted arms, their poses with noise, and how far a calibration is from them."""

import dataclasses

import mujoco
import numpy as np

from calib.fit.chambers import fit_chambers
from calib.fit.parameters import BENDING, FIELDS
from calib.read.measurements import measure
from mjx_softarm import ArmSpec
from mjx_softarm._support.fields import scaled
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.workspace import settle_many

SPEC = ArmSpec.default()
TIP_NOISE_M, TURN_NOISE_RAD, PRESSURE_NOISE_KPA, SPRING_NOISE_M = 5e-4, np.radians(0.3), 0.1, 5e-4


def planted(seed=0, spec=SPEC):
    """An arm whose chambers and backbone are unlike those of a specification."""
    rng, chambers, n = np.random.default_rng(seed), spec.chambers, spec.n_chambers

    def off(value, spread):
        return tuple((spec.per_chamber(value) * (1.0 + rng.uniform(-spread, spread, n))).tolist())

    return spec.replace(
        chambers={
            "stiffness_n_per_m": off(chambers.stiffness_n_per_m, 0.2),
            "area_m2": off(chambers.area_m2, 0.1),
            "area_slope_m": off(chambers.area_slope_m, 0.2),
            "length_offset_m": tuple(rng.uniform(-5e-3, 5e-3, n).tolist()),
        },
        backbone={BENDING: scaled(spec.backbone.bending_stiffness_nm_per_rad, 1.1)},
    )


def random_pressures(n, seed, spec=SPEC):
    swing = np.cos(np.random.default_rng(seed).uniform(0.0, np.pi, (n, spec.n_chambers)))
    low, high = SPEC.chambers.pressure_min_kpa, SPEC.chambers.pressure_max_kpa
    return low + (high - low) * 0.5 * (1.0 + swing)


def quaternions(rotation, turn_rad):
    """Return quaternions (n, 4) of rotations (n, 3, 3) followed by small turns (n, 3)."""
    found, unturned = np.empty((len(rotation), 4)), np.empty(4)
    for k, half in enumerate(0.5 * turn_rad):
        small = np.append(1.0, half)
        mujoco.mju_mat2Quat(unturned, np.float64(rotation[k]).ravel())
        mujoco.mju_mulQuat(found[k], small / np.linalg.norm(small), unturned)
    return found


def pose_log(arm, n, seed, pressure_kpa=None, **changes):
    """One row every five seconds, each another pose at rest, with noise."""
    pressure_kpa = random_pressures(n, seed, arm) if pressure_kpa is None else pressure_kpa
    n = len(pressure_kpa)
    found, rng = settle_many(arm, pressure_kpa), np.random.default_rng([seed, 1])
    assert found.settled.all()

    def noise(scale, *shape):
        return rng.normal(scale=scale, size=(n, *shape))

    log = Log(
        source="poses.csv",
        row=np.arange(n) + 2,
        time_s=5.0 * np.arange(n),
        spring_m=found.spring_m + noise(SPRING_NOISE_M, arm.n_springs),
        pressure_kpa=pressure_kpa + noise(PRESSURE_NOISE_KPA, arm.n_chambers),
        tip_m=found.tip_position_m + noise(TIP_NOISE_M, 3),
        tip_quaternion=quaternions(found.tip_rotation, noise(TURN_NOISE_RAD, 3)),
        payload_kg=np.full(n, arm.mass.payload_kg),
    )
    return dataclasses.replace(log, **changes)


def calibrate_chambers(logs, spec):
    return fit_chambers(measure([logs] if isinstance(logs, Log) else logs, spec), spec)


def off_by(found, arm):
    """Largest relative errors of stiffness, area and slope, and largest error of the offsets [m]."""
    pairs = [[np.array(getattr(x.chambers, name)) for x in (found, arm)] for name in FIELDS]
    *relative, (offset, true_offset) = pairs
    return *(np.abs(a / b - 1.0).max() for a, b in relative), np.abs(offset - true_offset).max()


def tip_error_mm(found, arm, n=200):
    """Distance of two arms' tips at pressures that no fit has seen, without noise."""
    a, b = (settle_many(x, random_pressures(n, 99, x)).tip_position_m for x in (found, arm))
    return 1e3 * np.linalg.norm(a - b, axis=1)
