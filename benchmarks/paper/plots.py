"""The pictures of the open-space experiments, in the paper's form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from benchmarks.paper.measure import Followed
from benchmarks.paper.stages import METHODS, Case
from benchmarks.paper.summary import PAPER_LOADS_MM
from train.runs.plots import BLUE, GREY, INK, ORANGE, dress

COLOURS = {"without": ORANGE, "with": BLUE, "gradient": "#2a9d6f"}
RED = "#c43333"
N_PER_SECTION = 3

Results = Mapping[Case, Followed]


def circle_figure(results: Results) -> Figure:
    """The circle from above, reference and paths of each method: a panel for each twin, its first seed.

    Points at which a chamber is saturated are ringed.
    """
    twins = sorted({case.twin for case in results})
    seed = min(case.seed for case in results)
    figure = Figure(figsize=(4.0 * len(twins) + 0.4, 3.9), layout="constrained")
    panels = figure.subplots(1, len(twins), squeeze=False, sharex=True, sharey=True)[0]
    for panel, twin in zip(panels, twins, strict=True):
        dress(panel, f"twin {twin}, from above", "x [mm]", "y [mm]")
        for method, name in METHODS.items():
            followed = results[Case(method, twin, seed)]
            tip = followed.goal + followed.error
            if method == "without":
                plot_around(panel, followed.goal, "--", color=INK, linewidth=1.2, label="reference")
            plot_around(panel, tip, "o-", color=COLOURS[method], linewidth=1.0, markersize=3.0, label=name)
            hit = tip[followed.saturated.any(axis=1)]
            ring = {"color": RED, "markersize": 7.0, "fillstyle": "none", "linestyle": "none"}
            label = "a chamber saturated" if method == list(METHODS)[-1] else None
            panel.plot(hit[:, 0], hit[:, 1], "o", label=label, **ring)
        panel.set_aspect("equal")
    panels[0].legend(frameon=False, loc="center", fontsize=8)
    return figure


def plot_around(panel: Any, pose: np.ndarray, line: str, **style: Any) -> None:
    """Poses (p, 6) [mm, deg] from above, the last joined with the first."""
    closed = np.vstack([pose, pose[:1]])
    panel.plot(closed[:, 0], closed[:, 1], line, **style)


def error_figure(results: Results) -> Figure:
    """Errors at each point of the unloaded circle: mean over the runs, and their range."""
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    titles = ("translation", "yaw", "pitch", "roll")
    for k, (panel, title) in enumerate(zip(panels, titles, strict=True)):
        dress(panel, f"{title} error", "point", "deg" if k else "mm")
        for method, name in METHODS.items():
            runs = [item for case, item in results.items() if case.method == method and case.load_g == 0]
            error = np.array([run.error for run in runs])  # (runs, p, 6)
            size = np.abs(error[..., 2 + k]) if k else np.linalg.norm(error[..., :3], axis=-1)
            at = np.arange(size.shape[1])
            panel.fill_between(at, size.min(axis=0), size.max(axis=0), color=COLOURS[method], alpha=0.15)
            panel.plot(at, size.mean(axis=0), color=COLOURS[method], label=name, linewidth=1.5)
        panel.set_ylim(bottom=0)
    panels[0].legend(frameon=False, fontsize=8)
    return figure


def loads_figure(table: Sequence[Mapping[str, Any]]) -> Figure:
    """Translation error over the load, with S2R: each run's mean and largest; saturated points beside it."""
    rows = [row for row in table if row["method"] == "with"]
    loads = sorted({row["load_g"] for row in rows})
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    dress(left, "translation error with S2R", "load [g]", "mm")
    dress(right, "saturated chambers", "load [g]", "points of the circle")
    for name, colour, label in (
        ("translation_mm", BLUE, "mean of the circle"),
        ("max_mm", GREY, "largest"),
    ):
        _dots(left, rows, loads, name, colour, label)
    _dots(right, rows, loads, "saturated_points", RED, "a chamber saturated")
    left.axhline(PAPER_LOADS_MM, color=INK, linestyle=":", linewidth=1, label="paper's arm, 35 to 500 g")
    for panel in (left, right):
        panel.set_xticks(loads, [str(load) for load in loads], rotation=60)
        panel.set_ylim(bottom=0)
        panel.legend(frameon=False, fontsize=8)
    return figure


def _dots(panel: Any, rows, loads: Sequence[int], name: str, colour: str, label: str) -> None:
    """Every run as a dot, and a line through the means."""
    values = [[row[name] for row in rows if row["load_g"] == load] for load in loads]
    for load, runs in zip(loads, values, strict=True):
        panel.plot([load] * len(runs), runs, "o", color=colour, markersize=3, alpha=0.5)
    panel.plot(loads, [np.mean(runs) for runs in values], color=colour, label=label)


def trace_figure(followed: Followed, limits_kpa: tuple[float, float]) -> Figure:
    """Spring lengths against their references, and pressures with their limits, section by section.

    Where a chamber is saturated at an arrival, its point is shaded.
    """
    n_sections = followed.spring_m.shape[1] // N_PER_SECTION
    figure = Figure(figsize=(12, 5.6), layout="constrained")
    panels = figure.subplots(2, n_sections, sharex=True, squeeze=False)
    for section in range(n_sections):
        upper, lower = panels[:, section]
        dress(upper, f"section {section + 1}: springs, dashed as asked", "", "mm")
        dress(lower, "pressures, limits dashed", "time [s]", "kPa")
        for k in range(N_PER_SECTION):
            chamber = section * N_PER_SECTION + k
            colour = colormaps["tab10"](chamber)
            reference_mm, spring_mm = 1e3 * followed.reference_m, 1e3 * followed.spring_m
            upper.plot(followed.time_s, reference_mm[:, chamber], "--", color=colour, linewidth=1.0)
            upper.plot(followed.time_s, spring_mm[:, chamber], color=colour, linewidth=1.0, alpha=0.7)
            label = f"chamber {chamber}"
            lower.plot(
                followed.time_s, followed.pressure_kpa[:, chamber], color=colour, linewidth=1.0, label=label
            )
            for panel in (upper, lower):
                _shade(panel, followed, np.flatnonzero(followed.saturated[:, chamber]), colour)
        for limit_kpa in limits_kpa:
            lower.axhline(limit_kpa, color=RED, linestyle="--", linewidth=1.0)
        lower.set_ylim(limits_kpa[0] - 12.0, limits_kpa[1] + 4.0)
        lower.legend(frameon=False, fontsize=7, ncols=3, loc="lower left")
    return figure


def _shade(panel: Any, followed: Followed, points: np.ndarray, colour: Any) -> None:
    for point in points:
        during = followed.time_s[followed.point == point]
        if len(during):
            panel.axvspan(during[0], during[-1], color=colour, alpha=0.12, linewidth=0)
