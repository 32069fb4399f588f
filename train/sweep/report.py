"""Results of several runs: their figures, and mean and range over the seeds of the same settings."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from mjx_softarm._support.provenance import provenance, write_json
from train.runs import plots
from train.runs.checkpoint import RunError
from train.runs.evaluate import Summary
from train.runs.folder import EVALUATION_FILE, Run
from train.sweep.job import setting
from train.sweep.run import Sweep

FIGURES = [field.name for field in dataclasses.fields(Summary) if field.name != "unsettled"]
RESULTS_FILE, CURVES_FILE = "results.json", "learning_curves.png"

# Columns of the table: figure, its heading, factor to the unit there, decimals.
_COLUMNS = (
    ("median_mm", "tip error,\nmedian [mm]", 1, 2),
    ("p95_mm", "95 % [mm]", 1, 2),
    ("reached_share", "goals\nreached [%]", 100, 1),
    ("saturated_share", "saturated [%]", 100, 1),
    ("even_median_mm", "uniform in\nvolume [mm]", 1, 2),
    ("circle_mean_mm", "circle,\nmean [mm]", 1, 2),
)


def by_settings(runs: Sequence[Run], settings_of: Callable[[Run], dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures of finished runs, grouped by settings.

    Args:
        runs: runs that were trained to their end.
        settings_of: returns the settings by which a run is grouped.

    Returns:
        For each group `settings`, `runs` with their figures, and `over_seeds`: mean, least and greatest.
        Further evaluations that all runs of a group have follow as `NAME_over_seeds`, by the names of their
        files.

    Raises:
        RunError: a run is not finished.
    """
    # Group the figures of the runs.
    groups: dict[str, dict[str, Any]] = {}
    for run in runs:
        settings = settings_of(run)
        group = groups.setdefault(json.dumps(settings, sort_keys=True), {"settings": settings, "runs": []})
        group["runs"].append(_figures(run))
    # Add means and ranges, of the further evaluations, too.
    for group in groups.values():
        rows = group["runs"]
        group["over_seeds"] = _spread(rows)
        for name, value in rows[0].items():
            if isinstance(value, dict) and all(name in row for row in rows):
                group[f"{name}_over_seeds"] = _spread([row[name] for row in rows])
    return list(groups.values())


def _figures(run: Run) -> dict[str, Any]:
    figures = run.evaluation()
    if figures is None:
        raise RunError(f"{run.path}: got no {EVALUATION_FILE}, expected a finished run")
    rows = run.metrics()
    further = sorted(run.path.glob("evaluation-*.json"))
    return {
        "seed": run.config.seed,
        "env_steps": rows[-1]["env_steps"],
        "updates": rows[-1]["updates"],
        **figures,
        **{file.stem: json.loads(file.read_text("utf-8")) for file in further},
    }


def _spread(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return mean, least and greatest of the figures that all rows have."""
    names = [name for name in FIGURES if all(row.get(name) is not None for row in rows)]
    values = {name: np.array([row[name] for row in rows]) for name in names}
    return {
        name: {"mean": float(x.mean()), "min": float(x.min()), "max": float(x.max())}
        for name, x in values.items()
    }


def report(sweep: Sweep) -> Table:
    """Write a sweep's results and plot into its folder; returns the table.

    Raises:
        RunError: a member is not finished.
    """
    groups = by_settings(sweep.runs, lambda run: _varied(sweep, run))
    write_json(sweep.path / RESULTS_FILE, {"groups": groups, "provenance": provenance("train")})
    plots.save(sweep.path, {CURVES_FILE: curves(sweep)})
    return table(groups)


def _varied(sweep: Sweep, run: Run) -> dict[str, Any]:
    return {path: setting(run.config, path) for path in sweep.varied}


def _name(settings: dict[str, Any], between: str = ", ") -> str:
    return between.join(f"{path}={value:g}" for path, value in settings.items())


def table(groups: Sequence[dict[str, Any]]) -> Table:
    """Return a table with, for each setting, the mean over the seeds and their range."""
    n_seeds = len(groups[0]["runs"])
    spread = f"mean of {n_seeds} seeds (least to greatest)" if n_seeds > 1 else "one seed"
    shown = Table(title=f"held-out figures, {spread}", title_justify="left")
    if groups[0]["settings"]:
        shown.add_column("setting", overflow="fold")
    for _, heading, _, _ in _COLUMNS:
        shown.add_column(Text(heading), justify="right")  # not markup: "[mm]"
    for group in groups:
        cells = [_name(group["settings"], "\n")] if group["settings"] else []
        for name, _, factor, decimals in _COLUMNS:
            mean, low, high = (
                f"{factor * group['over_seeds'][name][which]:.{decimals}f}"
                for which in ("mean", "min", "max")
            )
            cells.append(f"{mean}\n({low} to {high})" if n_seeds > 1 else mean)
        shown.add_row(*cells)
    return shown


def curves(sweep: Sweep) -> Figure:
    """Draw the held-out median over environment steps: a line for each setting, a band over its seeds."""
    # Collect the evaluations of each run, by its settings.
    lines: dict[str, list[list[tuple[int, float]]]] = {}
    for run in sweep.runs:
        points = [
            (row["env_steps"], row["evaluation/median_mm"])
            for row in run.metrics()
            if "evaluation/median_mm" in row
        ]
        lines.setdefault(_name(_varied(sweep, run)), []).append(points)
    # Draw a line and a band for each setting; dashes tell more than ten of them apart.
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot()
    plots.dress(axes, "tip error on held-out goals, median", plots.STEPS, "mm")
    for k, (name, seeds) in enumerate(lines.items()):
        colour = colormaps["tab10"](k % 10)
        values = np.array(seeds)  # (seeds, evaluations, 2)
        steps, medians = values[0, :, 0], values[:, :, 1]
        axes.plot(
            steps, medians.mean(axis=0), color=colour, label=name, linestyle=("-", "--", ":")[k // 10 % 3]
        )
        axes.fill_between(
            steps, medians.min(axis=0), medians.max(axis=0), color=colour, alpha=0.2, linewidth=0
        )
    plots.logarithmic(axes)
    if sweep.varied:
        axes.legend(frameon=False, loc="upper right")
    return figure
