"""Accuracy of calibration on a planted arm whose numbers are known.

Errors are on contiguous blocks of rows that took no part in the fit. See `logs` for real arms.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from calib import demo
from calib.fit.chambers import fit_chambers
from calib.fit.sensors import fit_springs
from calib.read.logs import read_log
from calib.read.measurements import measure as measurements_of
from mjx_softarm import ArmSpec


def measure() -> dict[str, Any]:
    """How exactly does calibration find the numbers of a planted arm?

    The arm is that of `python -m calib demo`, whose geometry differs from the simulator's; tips are in mm.
    """
    spec = ArmSpec.default()
    planted = demo.planted_arm(spec, seed=0)
    with tempfile.TemporaryDirectory() as folder:
        files = demo.write_demo(Path(folder), spec, seed=0)
        springs, poses = (read_log(file)[0] for file in files[:2])
    assert springs.readings is not None and springs.spring_m is not None  # as the demo writes them
    lines = fit_springs(springs.readings, springs.spring_m, spec.spring_sensor)
    sensor = {"beta": tuple(map(float, lines.beta)), "delta_m": tuple(map(float, lines.delta_m))}
    fit = fit_chambers(measurements_of([poses], spec), spec.replace(sensor=sensor))
    return {
        "beta, largest error [%]": 100 * _worst(lines.beta, planted.sensor.beta),
        "stiffness, largest error [%]": 100
        * _worst(fit.spec.chambers.stiffness_n_per_m, planted.chambers.stiffness_n_per_m),
        "area, largest error [%]": 100 * _worst(fit.spec.chambers.area_m2, planted.chambers.area_m2),
        "tip at held-out poses, before": fit.held_out_before.translation_mean_mm,
        "tip at held-out poses, calibrated": fit.held_out.translation_mean_mm,
    }


def _worst(found: Any, true: Any) -> float:
    return float(np.max(np.abs(np.array(found) / np.array(true) - 1.0)))
