"""Pictures of a run: learning curve, circle, map of the error over the workspace."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

from train.runs.evaluate import Figures, PositionSummary, Reached

INK, BLUE, ORANGE, GREY = "#222222", "#1f6fb4", "#e07b28", "#9aa0a6"
DPI = 150
STEPS = "environment steps"


def save(
    folder: Path, rows: list[dict[str, Any]], figures: Figures, result: Reached, *circle: Reached
) -> None:
    """Write the pictures of a run into its folder, from its metrics and its evaluation."""
    pictures = {"learning_curve.png": learning_curve(rows)}
    if isinstance(figures, PositionSummary):
        pictures["positions.png"] = positions_figure(result, figures.success)
    else:
        pictures |= {"circle.png": circle_figure(*circle), "workspace_error.png": workspace_figure(result)}
    for name, figure in pictures.items():
        figure.savefig(folder / name, dpi=DPI)


def dress(axes: Any, title: str, x: str, y: str) -> None:
    """Give axes the title, labels and grid of all pictures of the project."""
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if x == STEPS:
        axes.xaxis.set_major_formatter(EngFormatter())


def _figure(width: float, *panels: tuple[str, str, str], height: float = 4.0) -> tuple[Figure, Any]:
    """Return a figure of panels side by side, each with title and labels of x and y, and their axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    for k, panel in enumerate(panels):
        dress(figure.add_subplot(1, len(panels), k + 1), *panel)
    return figure, figure.axes


def _plain_numbers(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _evaluations(
    axes: Any, rows: list[dict[str, Any]], factor: float, lines: dict[str, tuple[str, str]]
) -> None:
    """Draw figures of the evaluations over environment steps, where they have them: name -> colour, label."""
    evaluated = [row for row in rows if "evaluation/median_mm" in row]
    steps = [row["env_steps"] for row in evaluated]
    for name, (colour, label) in lines.items():
        if all(f"evaluation/{name}" in row for row in evaluated):
            values = [factor * row[f"evaluation/{name}"] for row in evaluated]
            axes.plot(steps, values, "o-", markersize=3, color=colour, label=label)
    axes.legend(frameon=False)


def learning_curve(rows: list[dict[str, Any]]) -> Figure:
    """Draw tip error and success at held-out goals, or demonstrated positions, over environment steps."""
    figure, (left, right) = _figure(
        10,
        ("tip error at the goals", STEPS, "mm"),
        ("goals reached, chambers saturated", STEPS, "%"),
    )
    errors = {
        "median_mm": (BLUE, "median"),
        "p95_mm": (ORANGE, "95 %"),
        "max_mm": (ORANGE, "largest"),
        "circle_mean_mm": (GREY, "circle, mean"),
    }
    _evaluations(left, rows, 1, errors)
    left.set_yscale("log")
    _plain_numbers(left.yaxis)
    shares = {
        "reached_share": (BLUE, "goals reached"),
        "saturated_share": (ORANGE, "goals with a saturated chamber"),
        "success_share": (GREY, "reached, unsaturated, inside the pipe"),
    }
    _evaluations(right, rows, 100, shares)
    right.set_ylim(0, 105)
    return figure


def circle_figure(circle: Reached) -> Figure:
    """Draw the circle from above, and the error and the pressures along it."""
    goal, pose = np.asarray(circle.goal), np.asarray(circle.pose)
    error, n_saturated = circle.tip_error_mm, int(np.sum(circle.saturated_chambers))
    figure, (left, middle, right) = _figure(
        12,
        ("circle from above", "x [mm]", "y [mm]"),
        (f"tip error: mean {error.mean():.2f} mm, largest {error.max():.2f} mm", "point", "mm"),
        (f"pressures; {n_saturated} saturated chambers", "point", "kPa"),
    )
    left.plot(*np.vstack([goal, goal[:1]])[:, :2].T, color=GREY, label="goal")
    left.plot(pose[:, 0], pose[:, 1], "o", markersize=3.5, color=BLUE, label="reached")
    left.set_aspect("equal")
    left.legend(frameon=False, loc="center")
    middle.bar(np.arange(len(error)), error, color=BLUE)
    for k, line in enumerate(np.asarray(circle.pressure_kpa).T):
        right.plot(line, color=colormaps["tab10"](k % 10), label=f"chamber {k}", linewidth=1.2)
    right.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def workspace_figure(workspace: Reached) -> Figure:
    """Draw the tip error over the workspace, and its distribution."""
    goal, error = np.asarray(workspace.goal), workspace.tip_error_mm
    figure, (side, above, axes) = _figure(
        13,
        ("tip error at the goals, side view", "y [mm]", "z [mm]"),
        ("tip error at the goals, from above", "x [mm]", "y [mm]"),
        (f"distribution over {len(error)} held-out goals", "tip error [mm]", "share of goals [%]"),
    )
    # Maps of the error from the side and from above, the largest errors on top.
    order = np.argsort(error)
    top = max(1.0, float(np.quantile(error, 0.98)))
    colours: dict[str, Any] = {"c": error[order], "s": 5, "cmap": "viridis", "vmin": 0, "vmax": top}
    for panel, x, y in ((side, 1, 2), (above, 0, 1)):
        points = panel.scatter(goal[order, x], goal[order, y], **colours)
        panel.set_aspect("equal")
    figure.colorbar(points, ax=above, label="mm", extend="max")
    # Distribution, with its median and 95 %, over a decade at least; the smallest 2 % are drawn at its rim.
    high = max(1.2 * float(error.max()), 0.1)
    low = float(np.clip(np.quantile(error, 0.02), max(high / 1e3, 0.01), high / 10))
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    _plain_numbers(axes.xaxis)
    share = 100 * np.arange(1, len(error) + 1) / len(error)
    axes.plot(np.maximum(np.sort(error), low), share, color=BLUE)
    for percent, colour in ((50, GREY), (95, ORANGE)):
        quantile = float(np.quantile(error, percent / 100))
        label = f"{percent} %: {quantile:.2f} mm"
        axes.plot(np.maximum([quantile, quantile], low), [0, percent], color=colour, linewidth=1, label=label)
    axes.set_ylim(0, 100)
    axes.legend(frameon=False, loc="upper left")
    return figure


def positions_figure(reached: Reached, success: Sequence[bool]) -> Figure:
    """Draw demonstrated and reached poses from the front, and errors and clearances along them."""
    goal, pose, error = np.asarray(reached.goal), np.asarray(reached.pose), reached.tip_error_mm
    figure, (left, middle, right) = _figure(
        12,
        ("poses from the front", "x [mm]", "z [mm]"),
        (f"tip error: mean {error.mean():.2f} mm", "position", "mm"),
        ("clearance of the body to the pipe", "position", "mm"),
    )
    left.plot(goal[:, 0], goal[:, 2], color=GREY, marker="o", markerfacecolor="none", label="demonstrated")
    left.plot(pose[:, 0], pose[:, 2], "o", markersize=3.5, color=BLUE, label="reached")
    left.set_aspect("equal")
    left.legend(frameon=False, loc="upper right")
    position = np.arange(len(error))
    middle.bar(position, error, color=np.where(success, BLUE, ORANGE))
    if np.isfinite(reached.clearance_mm).all():
        right.bar(position, reached.clearance_mm, color=BLUE)
    else:
        right.text(0.5, 0.5, "no pipe", ha="center", transform=right.transAxes, color=GREY)
    return figure
