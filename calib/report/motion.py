"""Sections of the report on the arm in motion: actuators and damping."""

from __future__ import annotations

import dataclasses

import numpy as np

from calib.fit.motion.actuators import MARGIN, SMALL_KPA, ActuatorFit
from calib.fit.motion.damping import DampingFit
from calib.fit.motion.shape import ShapeFit
from calib.report.page import ReportTable, Section, as_json, plain
from calib.report.sections import per_part
from mjx_softarm.pneumatics import Regulator


def actuators(fit: ActuatorFit) -> Section:
    """Show the numbers of the actuators and the errors of the pressures."""
    # A row for each chamber: its numbers, with intervals where they were fitted, and its error
    found, n = fit.spec.actuators, fit.spec.n_chambers
    each = {name: np.broadcast_to(value, n) for name, value in dataclasses.asdict(found).items()}
    widths = fit.half_width_95 if isinstance(found, Regulator) else {}
    rows = []
    for k in range(n):
        pairs = ((value[k], widths[name][k]) if widths else (value[k],) for name, value in each.items())
        numbers = [x for pair in pairs for x in pair]
        rows.append((f"chamber {k}", *map(float, [*numbers, fit.chamber_rms_kpa[k]])))
    titles = [text for name in each for text in ((name, "+-") if widths else (name,))]

    # Errors of each kind of actuator, then the section
    errors = (
        ("held-out seconds, command taken for the pressure", fit.held_out_rms_kpa["command"]),
        ("held-out seconds, before", fit.held_out_rms_kpa["specification"]),
        ("held-out seconds, pump", fit.held_out_rms_kpa["pump"]),
        ("held-out seconds, regulator", fit.held_out_rms_kpa["regulator"]),
        (f"seconds of the fit, {fit.chosen}", fit.in_sample_rms_kpa),
    )
    return Section(
        "Actuators",
        f"{fit.n_tracks} tracks of commanded and measured pressures, {fit.time_s:.0f} s in all: "
        f"{found.kind}s driven with the commands against the measured pressures. Intervals are 95 %. "
        f"The law's ki is {fit.spec.control.ki_kpa_per_ms:.0f} kPa/(m s). {_kept(fit)}",
        (
            ReportTable(("", *titles, "held-out RMS [kPa]"), tuple(rows)),
            ReportTable(("pressures", "RMS [kPa]"), errors),
        ),
        fit.warnings,
        plain(fit, "spec", "notes") | {"kind": found.kind, "values": as_json(dataclasses.asdict(found))},
        notes=fit.notes,
    )


def _kept(fit: ActuatorFit) -> str:
    """Say why these actuators are kept."""
    better = f"better by more than {100 * (MARGIN - 1):.0f} % and {SMALL_KPA:g} kPa"
    if fit.chosen == "regulator":
        return f"The regulator is kept, since at held-out seconds it is {better}."
    kept = "pump" if fit.chosen == "pump" else "specification's actuators"
    text = f"Kept: the {kept}. At held-out seconds nothing else that was fitted is {better}."
    if fit.held_out_rms_kpa["command"] < fit.held_out_rms_kpa[fit.chosen]:
        text += " The command itself is closer: the actuators are quicker than this log can show. It is no "
        text += "actuator, and stands for comparison."
    return text


def damping(fit: DampingFit, shape: ShapeFit | None = None) -> Section:
    """Show damping of chambers and backbone, the lag of the shape, and the errors of the moving tip."""
    values = {
        "damping_ns_per_m": fit.spec.chambers.damping_ns_per_m,
        "bending_damping_nms_per_rad": fit.spec.backbone.bending_damping_nms_per_rad,
    }
    rows = [row for name in values for row in per_part(name, values[name], fit.half_width_95[name])]
    errors = (
        ("held-out seconds, before", fit.held_out_before_rms_mm),
        ("held-out seconds, calibrated", fit.held_out_rms_mm),
        ("seconds of the fit, calibrated", fit.in_sample_rms_mm),
    )
    tables = [ReportTable(("", "value", "+-"), tuple(rows)), ReportTable(("tip", "RMS [mm]"), errors)]
    # The shape's lag, where it could be fitted
    warnings, lag = fit.warnings, {}
    if shape is not None:
        width = shape.half_width_s if np.isfinite(shape.half_width_s) else "not known"
        fitted = "fitted", shape.lag_s, width, shape.rms_mm
        lags = ("before", shape.before_s, "", shape.before_rms_mm), fitted
        tables.append(ReportTable(("lag of the shape behind the springs", "s", "+-", "tip, RMS [mm]"), lags))
        lag = plain(shape, "spec") | {"half_width_s": as_json(shape.half_width_s)}
    if shape is not None and shape.at_end:
        warnings += (
            f"the best lag of the shape, {shape.lag_s:.2g} s, is an end of those tried, and is not used: log "
            "quicker motion, or check that times of springs and tip agree",
        )
    return Section(
        "Damping",
        f"{fit.n_stretches} stretches of the moving arm, {fit.time_s:.0f} s in all: MuJoCo driven with the "
        "measured pressures against the measured tip. Intervals are 95 %.",
        tuple(tables),
        warnings,
        plain(fit, "spec") | {"values": values, "shape": lag or None},
    )
