"""Pictures of a calibrated twin beside its simulation: configurations, lengths, and the springs' sensors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.paper.comparison import Comparison
from benchmarks.paper.engine import Settings, load_arrays
from benchmarks.paper.jobs import CALIBRATION, COMPARISON_FILE
from benchmarks.paper.plots import GREEN, RED
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import ARM_FILE, N_CHAMBERS_PER_SECTION, ArmSpec
from train.runs.plots import BLUE, GREY, INK, ORANGE, dress

N_SHOWN = 4  # configurations
STYLES = {  # of `SIMULATIONS`: label, colour, name below an axis
    "specified": ("simulated, as specified", ORANGE, "specified,\npressures"),
    "calibrated": ("simulated, calibrated", BLUE, "calibrated,\npressures"),
    "lengths": ("at lengths", RED, "calibrated,\nlengths"),
    "S2R": ("tip with S2R", GREEN, "S2R,\nlengths"),
}
PAIR = (STYLES["specified"], STYLES["calibrated"])
_LEFT: dict[str, Any] = {"x": 0.01, "ha": "left", "fontsize": 11}  # of a figure's title
UNSEEN = "at poses that its calibration has not seen"
VIEWS = ((0, "x [mm]"), (1, "y [mm]"))


def calibration_figures(folder: Path, settings: Settings) -> dict[str, Figure]:
    """Return the drawings of the first twin's calibration by name."""
    twin = settings.twins[0]
    comparison, sensors = _found(folder, twin)
    name = f"{settings.arm} {twin}"
    return {
        "configurations": configurations_figure(comparison, name),
        "lengths": lengths_figure(comparison, name),
        "sensor": sensor_figure(comparison, name, *sensors),
    }


def calibration_numbers(folder: Path, settings: Settings) -> dict[str, Any]:
    """Return the numbers of the first twin's calibration that the drawings show."""
    comparison, sensors = _found(folder, settings.twins[0])
    off_mm = [_spring_rms_mm(comparison, sensor) for sensor in sensors]
    rms_mm = (float(np.sqrt(np.mean(off**2))) for off in off_mm)
    springs = dict(zip(("specified", "calibrated"), rms_mm, strict=True))
    return {**comparison.figures(), "spring_rms_mm": springs}


def _found(folder: Path, twin: int) -> tuple[Comparison, tuple[Sensor, Sensor]]:
    """Return a twin's comparison, and its sensors as specified and as calibrated."""
    here = folder / f"twin{twin}"
    calibrated = ArmSpec.from_toml(here / CALIBRATION / ARM_FILE)
    sensors = ArmSpec.default().spring_sensor, calibrated.spring_sensor
    return load_arrays(Comparison, here / COMPARISON_FILE), sensors


def _spring_rms_mm(found: Comparison, sensor: Sensor) -> np.ndarray:
    """Return how far the lengths that a sensor reads are off, for each spring (n_chambers,) [mm]."""
    off_m = sensor.lengths(found.reading, np.nan).length_m - found.ruler_m
    return 1e3 * np.sqrt(np.nanmean(off_m**2, axis=0))


def configurations_figure(found: Comparison, name: str) -> Figure:
    """Draw arms from two sides at poses far apart, and how far all simulated tips are from the measured."""
    figure = Figure(figsize=(10.5, 6.2), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(N_SHOWN, 1.9))[0]
    panels = left.subplots(len(VIEWS), N_SHOWN, sharex=True, sharey=True)
    for column, pose in enumerate(spread_poses(found)):
        for row, (axis, label) in enumerate(VIEWS):
            panel = panels[row, column]
            dress(panel, f"pose {column + 1}" if row == 0 else "", label, "" if column else "z [mm]")
            panel.set_aspect("equal", adjustable="box")
            panel.margins(x=0.25)
            _draw_arm(panel, found, pose, [axis, 2])
    _draw_errors(right.subplots(), found)
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(),
        frameon=False,
        loc="outside lower center",
        ncols=4,
    )
    figure.suptitle(f"{name} {UNSEEN}", **_LEFT)
    return figure


def _draw_arm(panel: Any, found: Comparison, pose: int, axes: list[int]) -> None:
    """Draw one pose along two axes [mm]: simulated arms, measured markers and tip, corrected tip."""
    for (label, colour, _), plate_m, tip_m in zip(PAIR, found.plate_pair_m, found.tip_pair_m, strict=True):
        line = 1e3 * np.vstack([plate_m[pose], tip_m[pose]])[:, axes]
        panel.plot(*line.T, color=colour, linewidth=1.8, label=label)
    measured = 1e3 * np.vstack([found.marker_m[pose], found.tip_m[pose]])[:, axes]
    ring = {"color": INK, "markersize": 5.5, "fillstyle": "none", "linestyle": "none"}
    panel.plot(*measured.T, "o", label="measured markers and tip", **ring)
    if np.isfinite(found.corrected_tip_m).any():
        tip = 1e3 * found.corrected_tip_m[pose, axes]
        panel.plot(*tip, "x", color=GREEN, markersize=5.5, markeredgewidth=1.8, label=STYLES["S2R"][0])


def _draw_errors(panel: Any, found: Comparison) -> None:
    """Draw every pose's distance of the simulated to the measured tip, and the mean, of each simulation."""
    labels = "arm, and what it is simulated at", "simulated to measured [mm]"
    dress(panel, f"tips, {len(found.tip_m)} poses", *labels)
    errors_mm = {name: error[np.isfinite(error)] for name, error in found.errors_mm.items()}
    shown = {name: error for name, error in errors_mm.items() if len(error)}
    for at, (name, error_mm) in enumerate(shown.items()):
        aside = np.linspace(-0.25, 0.25, len(error_mm))
        panel.plot(at + aside, error_mm, "o", color=STYLES[name][1], markersize=3.5, alpha=0.7)
        panel.hlines(error_mm.mean(), at - 0.35, at + 0.35, color=INK, linewidth=1.5)
        place = {"xytext": (0, 5), "textcoords": "offset points", "ha": "center"}
        text = f"mean\n{error_mm.mean():.1f}"
        panel.annotate(text, (at, error_mm.max()), fontsize=9, color=INK, **place)
    panel.set_yscale("log")
    panel.yaxis.set_major_formatter("{x:g}")
    panel.set_ylim(top=2.5 * max(error.max() for error in shown.values()))
    panel.set_xticks(range(len(shown)), [STYLES[name][2] for name in shown], fontsize=8)


def spread_poses(found: Comparison, n: int = N_SHOWN) -> list[int]:
    """Return n poses with measured tips far from each other, the first the farthest to the side."""
    known = np.flatnonzero(np.isfinite(found.tip_pair_m).all(axis=(0, 2)))
    tip_m = found.tip_m[known]
    chosen = [int(np.argmax(np.linalg.norm(tip_m[:, :2], axis=1)))]
    while len(chosen) < min(n, len(known)):
        distance_m = np.linalg.norm(tip_m[:, None] - tip_m[chosen], axis=-1).min(axis=1)
        chosen.append(int(np.argmax(distance_m)))
    return known[chosen].tolist()


def lengths_figure(found: Comparison, name: str) -> Figure:
    """Draw simulated over measured lengths of the chambers, and their differences: a column per section."""
    n_sections = found.chamber_m.shape[1] // N_CHAMBERS_PER_SECTION
    figure = Figure(figsize=(9.5, 6.0), layout="constrained")
    panels = figure.subplots(2, n_sections, sharex=True, sharey="row", height_ratios=(3, 2))
    ends = 1e3 * np.array([np.nanmin(found.chamber_m), np.nanmax(found.chamber_m)])
    for section, (upper, lower) in enumerate(panels.T):
        dress(upper, f"section {section + 1}, from the base", "", "" if section else "simulated [mm]")
        dress(lower, "", "from measured springs [mm]", "" if section else "simulated - measured [mm]")
        upper.plot(ends, ends, "--", color=INK, linewidth=1.0)
        lower.axhline(0.0, color=INK, linestyle="--", linewidth=1.0)
        chambers = slice(N_CHAMBERS_PER_SECTION * section, N_CHAMBERS_PER_SECTION * (section + 1))
        measured_mm = 1e3 * found.chamber_m[:, chambers].ravel()
        rms_mm = found.chamber_rms_mm[:, section]
        for (title, colour, _), simulated_m, rms in zip(PAIR, found.chamber_pair_m, rms_mm, strict=True):
            error_mm = 1e3 * simulated_m[:, chambers].ravel() - measured_mm
            label = f"{title.removeprefix('simulated, ')}: {rms:.1f} mm RMS"
            dots = {"color": colour, "markersize": 3.0, "alpha": 0.65, "linestyle": "none"}
            upper.plot(measured_mm, measured_mm + error_mm, "o", label=label, **dots)
            lower.plot(measured_mm, error_mm, "o", **dots)
        upper.legend(frameon=False, fontsize=8.5, loc="upper left", handletextpad=0.2)
    figure.suptitle(f"chambers of {name} at the measured pressures, {UNSEEN}", **_LEFT)
    return figure


def sensor_figure(found: Comparison, name: str, specified: Sensor, calibrated: Sensor) -> Figure:
    """Draw one spring's curve from frequency to length, its line from raw length, and all springs' errors."""
    figure = Figure(figsize=(10.5, 4.0), layout="constrained")
    curve, line, errors = figure.subplots(1, 3)
    read_mm = [1e3 * sensor.lengths(found.reading, np.nan).length_m for sensor in (specified, calibrated)]
    ruler_mm = 1e3 * found.ruler_m
    off_mm = [_spring_rms_mm(found, sensor) for sensor in (specified, calibrated)]
    k = int(np.nanargmax(off_mm[0]))
    unit, factor = _largest_unit(calibrated)
    dress(curve, f"spring {k}", f"{calibrated.reading_name} [{unit}]", "spring length L [mm]")
    dress(line, f"spring {k}: L = beta l + delta", "length by the circuit alone l [mm]", "")
    low, high = np.nanmin(found.reading[:, k]), np.nanmax(found.reading[:, k])
    reading = np.tile(np.linspace(low, high, 100)[:, None], found.reading.shape[1])
    raw_mm = 1e3 * calibrated.raw_length(reading)[0][:, k]
    for sensor, style, (_, colour, _) in zip((specified, calibrated), ("--", "-"), PAIR, strict=True):
        length_mm = 1e3 * sensor.lengths(reading, np.nan).length_m[:, k]
        beta, delta_mm = np.asarray(sensor.beta)[k], 1e3 * np.asarray(sensor.delta_m)[k]
        which = "as specified" if sensor is specified else "calibrated"
        curve.plot(reading[:, k] / factor, length_mm, style, color=colour, label=which)
        text = f"{which}: beta {beta:.3f}, delta {delta_mm:.2f} mm"
        line.plot(raw_mm, length_mm, style, color=colour, label=text)
    dots = {"color": INK, "markersize": 3.0, "linestyle": "none", "label": "measured"}
    curve.plot(found.reading[:, k] / factor, ruler_mm[:, k], "o", **dots)
    line.plot(1e3 * calibrated.raw_length(found.reading)[0][:, k], ruler_mm[:, k], "o", **dots)
    dress(errors, "all springs", "spring", "length read - measured [mm]")
    errors.axhline(0.0, color=GREY, linewidth=1.0)
    for shift, read, off, (_, colour, _) in zip((-0.15, 0.15), read_mm, off_mm, PAIR, strict=True):
        at = np.broadcast_to(np.arange(read.shape[1]) + shift, read.shape)
        label = f"{np.sqrt(np.mean(off**2)):.2f} mm RMS"
        errors.plot(at.ravel(), (read - ruler_mm).ravel(), "_", color=colour, markersize=7.0, label=label)
    errors.set_xticks(np.arange(found.reading.shape[1]))
    for panel in (curve, line, errors):
        low, high = panel.get_ylim()
        panel.set_ylim(low, high + 0.3 * (high - low))  # room for the legend
        panel.legend(frameon=False, fontsize=8.5, loc="upper left")
    figure.suptitle(f"sensors of {name} {UNSEEN}", **_LEFT)
    return figure


def _largest_unit(sensor: Sensor) -> tuple[str, float]:
    """Return the largest unit of a sensor's readings, and how many of its smallest it has."""
    return max(sensor.units.items(), key=lambda item: item[1])
