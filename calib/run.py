"""Calibration of an arm from its logs: a loop over steps; each step uses the results of the steps before.

The result is a folder that training takes:

    arm.toml      the calibrated specification
    s2r.npz       the sim-to-real network, if there were poses to fit it to
    pressures.npz residual pressures that hold the arm, if there were poses to fit them to
    report.html   results with pictures, and whether to trust them
    report.json   the same for programs
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib import steps
from calib.arm import CalibratedArm
from calib.read.measurements import Measurements, measure
from calib.read.static_poses import SAME_KG
from calib.report.page import Section, to_html, to_json
from calib.steps import Step
from mjx_softarm._support.provenance import write_json
from mjx_softarm.logs.schema import Log
from mjx_softarm.spec import ARM_FILE, ArmSpec


@dataclass(frozen=True)
class Calibration:
    """Calibrated arm, and the sections of the report."""

    arm: CalibratedArm
    sections: tuple[Section, ...]


def calibrate(
    logs: Sequence[Log],
    spec: ArmSpec,
    seed: int = 0,
    printed: bool = False,
    progress: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Fit everything that the logs allow.

    Logs of the control loop beside others are later ones: they show what has changed since the others.

    Args:
        logs: logs of one arm, see `calib.read.logs.read_log`.
        spec: arm as believed so far.
        seed: seed of all random draws.
        printed: fit the paper's sim-to-real network.
        progress: called with a line of text before each step.

    Raises:
        LogError: the logs are of different arms.
        InputError: the logs do not allow a fit.
    """
    later = [log for log in logs if log.goal is not None]
    if 0 < len(later) < len(logs):
        first = calibrate([log for log in logs if log.goal is None], spec, seed, printed, progress)
        return go_on(first, later, seed, progress)
    chosen: dict[str, Step] = {
        "springs": steps.springs,
        "chambers": steps.chambers,
        "sim-to-real network": functools.partial(steps.s2r, printed=printed),
        "actuators": steps.actuators,
        "damping": steps.damping,
    }
    return _run_steps(Calibration(CalibratedArm(spec), ()), chosen, measure(logs, spec), seed, progress)


def go_on(
    since: Calibration,
    later: Sequence[Log],
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Return a calibration that goes on with later logs; arguments as of `calibrate`.

    Poses without a payload show what has changed, poses with a known weight how strongly payloads are felt.

    Raises:
        LogError: the logs are of different arms.
    """
    spec = since.arm.spec
    measurements = measure(later, spec, needed=("pressure_kpa",))
    loaded = measurements.poses.payload_kg > spec.mass.payload_kg + SAME_KG
    chosen: dict[str, Step] = {} if len(loaded) and loaded.all() else {"changes": steps.changes}
    chosen |= {"payloads": steps.payloads} if loaded.any() else {}
    return _run_steps(since, chosen, measurements, seed, progress)


def _run_steps(
    calibration: Calibration,
    chosen: Mapping[str, Step],
    measurements: Measurements,
    seed: int,
    progress: Callable[[str], None],
) -> Calibration:
    """Return a calibration after further steps; each begins with the arm of the step before."""
    for name, step in chosen.items():
        progress(f"{name} ...")
        result = step(measurements, calibration.arm, seed)
        calibration = Calibration(result.arm, (*calibration.sections, result.section))
    return calibration


def refuse_existing(folder: Path) -> None:
    """Refuse to overwrite a folder.

    Raises:
        FileExistsError: the folder exists and is not empty, or is the current one.
    """
    if not folder.name or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise FileExistsError(f"--out: got {folder}, which is there already, expected a new folder")


def write_calibration(
    folder: Path, calibration: Calibration, findings: Sequence[str], provenance: dict[str, Any]
) -> None:
    """Write the folder, whole or not at all; the report has the logs' findings and the provenance.

    Raises:
        FileExistsError: the folder exists and is not empty.
        OSError: it cannot be written.
    """
    refuse_existing(folder)
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        # Write a folder beside it, then rename that.
        part.mkdir(parents=True)
        calibration.arm.spec.to_toml(part / ARM_FILE)
        calibration.arm.write_models(part)
        report = (calibration.sections, findings, provenance)
        write_json(part / "report.json", to_json(*report))
        (part / "report.html").write_text(to_html(calibration.arm.spec.name, *report), "utf-8")
        part.replace(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
