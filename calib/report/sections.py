"""Sections of the report: each shows the numbers of a fit in words, tables and drawings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calib.changes import Changes
from calib.fit.chambers import ChamberFit
from calib.fit.held_pressures import PressureFit
from calib.fit.motion.actuators import MARGIN, MARGIN_BY_SPRINGS, SMALL_KPA, ActuatorFit
from calib.fit.motion.damping import DampingFit
from calib.fit.motion.shape import ShapeFit
from calib.fit.parameters import BENDING, BOND, without_effect
from calib.fit.payload import MOST_OFF, PayloadScaleFit
from calib.fit.pose_errors import PoseErrors
from calib.fit.s2r import S2RFit
from calib.fit.springs import LineFit
from calib.report.page import ReportTable, Section, plain
from mjx_softarm._support.fields import PerSection
from mjx_softarm.pneumatics import Regulator
from mjx_softarm.sensing.load import QUANTILE
from mjx_softarm.sensing.s2r import correct

_BINS = 40
CHANGES, PAYLOADS = "Changes", "Payloads"
ENOUGH = 2.0  # held-out error over that of the calibration, from which there is a warning; by hand


def springs(fit: LineFit, calibrated_m: np.ndarray, length_m: np.ndarray, per_section: int) -> Section:
    """Show beta and delta of each spring, and the residuals.

    Args:
        fit: fitted springs.
        calibrated_m, length_m (n, n_springs) [m]: lengths from the calibrated sensors, and measured.
        per_section: springs of a section, which are a row of the figure.
    """
    head = ("beta", "+-", "delta [mm]", "+- [mm]", "held-out RMS [mm]", "rows", "outliers")
    columns = fit.slope, fit.slope_width, 1e3 * fit.offset, 1e3 * fit.offset_width, 1e3 * fit.held_out_rms
    table = _numbered("spring", head, *columns, fit.n_rows, fit.n_outliers)
    # Draw the residuals of each spring.
    n_rows = len(fit.slope) // per_section
    figure = Figure(figsize=(7.5, 1.0 + 1.6 * n_rows), layout="constrained")
    each = figure.subplots(n_rows, per_section, sharex=True, sharey=True, squeeze=False)
    for k, axes in enumerate(each.flat):
        axes.plot(1e3 * length_m[:, k], 1e3 * (calibrated_m - length_m)[:, k], ".", ms=2)
        axes.set_title(f"spring {k}", fontsize="small")
        axes.grid(alpha=0.3)
    figure.supxlabel("measured length [mm]", fontsize="medium")
    figure.supylabel("calibrated minus measured [mm]", fontsize="medium")
    return Section(
        "Springs",
        "Measured lengths L against lengths l from the readings, L = beta l + delta, by Huber's loss. "
        "Intervals are 95 %; contiguous blocks of rows are held out.",
        (table,),
        fit.warnings,
        plain(fit),
        (("residuals of the lines", figure),),
    )


def chambers(fit: ChamberFit) -> Section:
    """Show stiffness, area and rest length of each chamber, the backbone, and the errors of the tip."""
    spec = fit.spec
    units = (
        ("stiffness_n_per_m", "stiffness [N/m]", 1.0),
        ("area_m2", "area [cm2]", 1e4),
        ("area_slope_m", "its slope [cm2/mm]", 10.0),
        ("length_offset_m", "rest length [mm]", 1e3),
    )
    values = {name: spec.per_chamber(getattr(spec.chambers, name)) for name, _, _ in units}
    head, columns = [], []
    for name, title, factor in units:
        head += [title, "+-"]
        columns += [np.multiply(factor, values[name]), factor * fit.half_width_95[name]]
    each = _numbered("chamber", head, *columns)
    parts = {BENDING: spec.backbone.bending_stiffness_nm_per_rad, BOND: spec.chambers.bonded_share}
    backbone = _parts(parts, fit.half_width_95)
    errors = _errors(
        ("held-out poses, before", fit.held_out_before),
        ("held-out poses, calibrated", fit.held_out),
        ("poses of the fit, calibrated", fit.in_sample),
    )
    held_out_mm, fit_mm = fit.tip_error_mm[fit.is_held_out], fit.tip_error_mm[~fit.is_held_out]
    figure = _histogram("simulated to measured tip [mm]", {"fit": fit_mm, "held out": held_out_mm})
    row_uses = ", ".join(f"{count} {use}" for use, count in fit.rows.items() if count)
    kept = " and ".join(title.split(" [")[0] for name, title, _ in units if name in without_effect(spec))
    return Section(
        "Chambers",
        f"{fit.poses.n} poses at rest: simulated at the measured pressures against the measured tip and "
        "springs. Rest lengths are relative to the section's. Intervals are 95 %. "
        "The fit is to all poses; the errors are of a fit without the held-out poses. "
        f"Rows of the logs: {row_uses}."
        + (f" Patterns of {kept} that neither stretch nor bend a section stay as specified." if kept else ""),
        (each, backbone, _mounting(fit), errors),
        fit.warnings,
        plain(fit, "spec", "poses", "is_held_out", "tip_error_mm")
        | {"values": values | parts | dataclasses.asdict(spec.mounting)},
        (("simulated to measured tip", figure),),
        fit.notes,
    )


def s2r(
    fit: S2RFit,
    pose: np.ndarray,
    spring_m: np.ndarray,
    real: np.ndarray,
    n_unsettled: int,
    others: Sequence[S2RFit] = (),
) -> Section:
    """Show distances of simulated to real poses, with and without the network.

    Args:
        fit: fitted network.
        pose (n, 6) [mm, deg]: simulated poses.
        spring_m (n, n_springs) [m]: their spring lengths.
        real (n, 6) [mm, deg]: measured poses.
        n_unsettled: number of other poses, at whose spring lengths the simulated arm did not settle.
        others: fits to the same poses that were not chosen.
    """
    errors = _errors(
        ("held-out poses, simulated", fit.test_uncorrected),
        ("held-out poses, corrected", fit.test),
        ("poses of the fit, corrected", fit.in_sample),
        (f"held-out poses, {fit.model}", fit.test_model),
        *(
            row
            for other in others
            for row in (
                (f"held-out poses, {other.model}", other.test_model),
                (f"held-out poses, network of the {other.model}", other.test),
            )
        ),
    )
    distances_mm = {
        label: np.linalg.norm((poses - real)[fit.held_out, :3], axis=1)
        for label, poses in (("simulated", pose), ("corrected", correct(fit.s2r, pose, spring_m)))
    }
    figure = _histogram("distance to the real tip, held-out poses [mm]", distances_mm)
    return Section(
        "Sim-to-real network",
        f"{len(pose)} poses at rest: the calibrated simulation settles at the logged lengths, and "
        "the network learns the error of its tip. The arm of Chambers has the measured pressures instead and "
        "spring lengths that are off by some millimetres. So simulated tips may be further off here. "
        f"The network flags {100 * fit.flagged_share:.1f} % of the held-out poses as far from those that it "
        "learned. "
        f"At {n_unsettled} other poses the simulation found no rest; they took no part.",
        (errors,),
        fit.warnings,
        plain(fit, "s2r", "held_out")
        | {"n_unsettled": n_unsettled, "others": [plain(other, "s2r", "held_out") for other in others]},
        (("held-out poses with and without the network", figure),),
    )


def with_pressures(
    section: Section, held: PressureFit, widths_kg: tuple[float, float], known_kg: float
) -> Section:
    """Add the residual pressures, before and after their fit, to the network's section.

    Payloads are known to `widths_kg`, see `calib.fit.payload.payload_intervals`. The control loop believes
    none that is known worse than `known_kg`.
    """
    none_g, largest_g = (1e3 * kg for kg in widths_kg)
    hysteresis_kpa = float(held.held.hysteresis_kpa.max())
    text = (
        f" The pressures that hold these poses are {held.before_kpa:.2f} kPa off the simulated ones (RMS, "
        f"held-out poses), and {held.after_kpa:.2f} kPa with a process of each section, which expects "
        f"{held.expected_kpa:.2f} kPa. A chamber that has grown holds up to {2.0 * hysteresis_kpa:.2f} kPa "
        "more than one that has shrunk to the same length. "
        f"So the loop will know within {none_g:.0f} g (95 %) that nothing hangs at the gripper, at half of "
        f"the workspace's poses, and the largest payload within {largest_g:.0f} g at 95 % of them."
    )
    figures = {"simulated": held.before_kpa, "fitted": held.after_kpa, "expected": held.expected_kpa}
    data = {
        "held_pressures_rms_kpa": figures | {"hysteresis": hysteresis_kpa},
        "payload_half_width_g": {"none, median": none_g, "largest, p95": largest_g},
    }
    warnings = section.warnings
    if largest_g > 1e3 * known_kg:
        accuracy = f"the largest payload known to {largest_g:.0f} g, expected {1e3 * known_kg:.0f} g"
        warnings += (f"{accuracy}: record more random poses",)
    return dataclasses.replace(section, text=section.text + text, warnings=warnings, data=section.data | data)


def actuators(fit: ActuatorFit) -> Section:
    """Show the numbers of the actuators and the errors of the pressures."""
    # The numbers of each chamber, with intervals where they were fitted, and its error
    kept = fit.spec.actuators
    values = dataclasses.asdict(kept)
    head, columns = [], []
    for name, value in values.items():
        head.append(name)
        columns.append(np.full(fit.spec.n_chambers, value, float))
        if isinstance(kept, Regulator):
            head.append("+-")
            columns.append(fit.half_width_95[name])
    each = _numbered("chamber", [*head, "held-out RMS [kPa]"], *columns, fit.chamber_rms_kpa)

    # Errors of each kind of actuator, then the section
    against = "measured pressures"
    if fit.arm_lag_s is not None:
        against = f"pressures by the springs, which lag by {fit.arm_lag_s:.2f} s, as none were measured"
    errors = (
        ("held-out seconds, command taken for the pressure", fit.held_out_rms_kpa["command"]),
        ("held-out seconds, before", fit.held_out_rms_kpa["specification"]),
        ("held-out seconds, pump", fit.held_out_rms_kpa["pump"]),
        ("held-out seconds, regulator", fit.held_out_rms_kpa["regulator"]),
        (f"seconds of the fit, {fit.chosen}", fit.in_sample_rms_kpa),
    )
    return Section(
        "Actuators",
        f"{fit.n_tracks} tracks of commands and pressures, {fit.time_s:.0f} s in all: "
        f"{kept.kind}s driven with the commands against the {against}. Intervals are 95 %. "
        f"The law's ki is {fit.spec.control.ki_kpa_per_ms:.0f} kPa/(m s). {_kept(fit)}",
        (each, ReportTable(("pressures", "RMS [kPa]"), errors)),
        fit.warnings,
        plain(fit, "spec", "notes") | {"kind": kept.kind, "values": values},
        notes=fit.notes,
    )


def _kept(fit: ActuatorFit) -> str:
    """Say why these actuators are kept."""
    margin = MARGIN if fit.arm_lag_s is None else MARGIN_BY_SPRINGS
    better = f"better by more than {100 * (margin - 1):.0f} % and {SMALL_KPA:g} kPa"
    if fit.chosen == "regulator":
        return f"The regulator is kept, since at held-out seconds it is {better}."
    kept = "pump" if fit.chosen == "pump" else "specification's actuators"
    text = f"Kept: the {kept}. At held-out seconds nothing else that was fitted is {better}."
    if fit.held_out_rms_kpa["command"] < fit.held_out_rms_kpa[fit.chosen]:
        text += " The command itself is closer: the actuators are quicker than this log can show. It is no "
        text += "actuator, and stands for comparison."
    return text


def damping(fit: DampingFit, shape: ShapeFit | None) -> Section:
    """Show damping of chambers and backbone, the lag of the shape, and the errors of the moving tip."""
    values = {
        "damping_ns_per_m": fit.spec.chambers.damping_ns_per_m,
        "bending_damping_nms_per_rad": fit.spec.backbone.bending_damping_nms_per_rad,
    }
    errors = (
        ("held-out seconds, before", fit.held_out_before_rms_mm),
        ("held-out seconds, calibrated", fit.held_out_rms_mm),
        ("seconds of the fit, calibrated", fit.in_sample_rms_mm),
    )
    tables = [_parts(values, fit.half_width_95), ReportTable(("tip", "RMS [mm]"), errors)]
    warnings, lag = fit.warnings, None
    if shape is not None:  # it could be fitted
        width = shape.half_width_s if np.isfinite(shape.half_width_s) else "not known"
        fitted = "fitted", shape.lag_s, width, shape.rms_mm
        lags = ("before", shape.before_s, "", shape.before_rms_mm), fitted
        tables.append(ReportTable(("lag of the shape behind the springs", "s", "+-", "tip, RMS [mm]"), lags))
        lag = plain(shape, "spec") | {"half_width_s": shape.half_width_s}
        if shape.at_end:
            warnings += (
                f"the best lag of the shape, {shape.lag_s:.2g} s, is an end of those tried, and is not used: "
                "log quicker motion, or check that times of springs and tip agree",
            )
    return Section(
        "Damping",
        f"{fit.n_stretches} stretches of the moving arm, {fit.time_s:.0f} s in all: MuJoCo driven with the "
        "measured pressures against the measured tip. Intervals are 95 %.",
        tuple(tables),
        warnings,
        plain(fit, "spec") | {"values": values, "shape": lag},
    )


def changes(fit: Changes, known_mm: float) -> Section:
    """Show what has changed, and whether that explains the later poses.

    `known_mm` is the mean error of the tip at held-out poses of the calibration, 0 if not known.
    """
    errors = tuple(
        (what, tip.translation_mean_mm, tip.rotation_mean_deg, kpa)
        if tip.n
        else (what, "not measured", "not measured", kpa)
        for what, tip, kpa in (
            ("before", fit.before, fit.before_kpa),
            ("with the changes", fit.after, fit.after_kpa),
        )
    )
    tables = (
        _numbered("spring", ("zero [mm]", "+-"), 1e3 * fit.zero_m, 1e3 * fit.zero_half_width_m),
        _numbered("chamber", ("stiffness [%]", "pressure [kPa]"), 100 * fit.stiffness, fit.offset_kpa),
        ReportTable(("held-out poses", "tip [mm]", "turn [deg]", "pressures, RMS [kPa]"), errors),
    )

    warnings: tuple[str, ...] = ()
    after_mm = fit.after.translation_mean_mm if fit.is_better else fit.before.translation_mean_mm
    if known_mm and after_mm > ENOUGH * known_mm:
        warnings = (
            f"{after_mm:.1f} mm remain at held-out poses, {known_mm:.1f} mm at the calibration: more has "
            "changed than zeros and stiffness, so record poses anew and calibrate",
        )
    return Section(
        CHANGES,
        f"{fit.n} later poses of the unloaded arm against the calibrated simulation. Zeros are true "
        "lengths minus lengths read. A stiffness and an offset of the pressures differ to some per cent. "
        "Intervals are 95 %; contiguous blocks of poses are held out.",
        tables,
        warnings,
        plain(fit, "spec") | {"is_better": fit.is_better},
        notes=(_sentence(fit),),
    )


def payloads(fit: PayloadScaleFit) -> Section:
    """Show how strongly the arm feels payloads, by poses with a known weight."""
    estimate = f"{fit.n} poses with a known weight gave {fit.ratio:.3f} of it in the mean"
    if not fit.is_plausible:
        expected = f"expected {1.0 - MOST_OFF:.1f} to {1.0 + MOST_OFF:.1f}"
        remedy = "check the weight and its unit, and whether the arm has changed since the calibration"
        warning = f"{estimate}, {expected}: {remedy}"
        return Section(PAYLOADS, f"{estimate}.", warnings=(warning,), data=fit._asdict())
    percent = 100.0 * QUANTILE * fit.factor_sd
    text = (
        f"{estimate}. So a payload changes the pressures by {fit.factor:.3f} of the simulated change. Near "
        f"these poses this factor is known to {percent:.0f} % (95 %); other errors add to it."
    )
    way = "heavy" if fit.ratio > 1.0 else "light"
    note = f"payloads were estimated {100.0 * abs(fit.ratio - 1.0):.1f} % too {way}; this is corrected"
    return Section(PAYLOADS, text, data=fit._asdict(), notes=(note,))


def _sentence(fit: Changes) -> str:
    if not fit.is_better:
        return "nothing has changed that these poses show: the calibration stays as it is"
    zero_mm = ", ".join(f"{x:+.1f}" for x in 1e3 * fit.zero_m)
    mean, half = 100 * fit.stiffness.mean(), 100 * fit.mean_half_width
    what = f"zeros of the springs {zero_mm} mm; stiffness of the chambers {mean:+.0f} +- {half:.0f} %"
    if not fit.before.n:  # no motion capture
        off = f"{fit.before_kpa:.2f} kPa off before, {fit.after_kpa:.2f} now"
        return f"{what}; pressures at held-out poses {off}"
    before_mm, after_mm = fit.before.translation_mean_mm, fit.after.translation_mean_mm
    return f"{what}; tips at held-out poses {before_mm:.1f} mm off before, {after_mm:.1f} mm now"


def _numbered(name: str, head: Sequence[str], *columns: np.ndarray) -> ReportTable:
    """Return a table with a row for each spring or chamber."""
    rows = (tuple(numbers) for numbers in zip(*columns, strict=True))
    return ReportTable(("", *head), tuple((f"{name} {k}", *row) for k, row in enumerate(rows)))


def _parts(values: Mapping[str, PerSection], half_width_95: Mapping[str, Any]) -> ReportTable:
    """Return a table of numbers with intervals, each a row, or a row for each section."""
    rows = []
    for name, value in values.items():
        names = [f"{name} {k}" for k in range(len(value))] if isinstance(value, tuple) else [name]
        rows += zip(names, np.atleast_1d(value), np.atleast_1d(half_width_95[name]), strict=True)
    return ReportTable(("", "value", "+-"), tuple(rows))


def _mounting(fit: ChamberFit) -> ReportTable:
    """Return the table of the arm's mounting, with intervals."""
    rows = []
    for name, values in dataclasses.asdict(fit.spec.mounting).items():
        unit, factor = ("deg", 1.0) if name.endswith("_deg") else ("mm", 1e3)
        what = name.removesuffix("_deg").removesuffix("_m").replace("_", " ")
        labels = range(len(values)) if "section" in name else "xyz"
        rows += [
            (f"{what} {label} [{unit}]", factor * value, float(factor * width))
            for label, value, width in zip(labels, values, fit.half_width_95[name], strict=True)
        ]
    return ReportTable(("", "value", "+-"), tuple(rows))


def _errors(*rows: tuple[str, PoseErrors]) -> ReportTable:
    head = ("tip", "poses", "mean [mm]", "95 % [mm]", "mean turn [deg]")
    shown = ((what, e.n, e.translation_mean_mm, e.translation_95_mm, e.rotation_mean_deg) for what, e in rows)
    return ReportTable(head, tuple(shown))


def _histogram(x_label: str, errors_mm: Mapping[str, np.ndarray]) -> Figure:
    """Draw the densities of errors by their labels, up to where 1 % are larger."""
    figure = Figure(figsize=(7.5, 3.6), layout="constrained")
    axes = figure.add_subplot()
    bins = np.linspace(0.0, np.nanquantile(np.concatenate([*errors_mm.values()]), 0.99), _BINS).tolist()
    for label, values in errors_mm.items():
        axes.hist(values, bins, density=True, alpha=0.5, label=label)
    axes.set(xlabel=f"{x_label}; 1 % are larger", ylabel="density")
    axes.legend(fontsize="small", loc="upper left")
    axes.grid(alpha=0.3)
    return figure
