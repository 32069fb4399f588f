"""Pictures of the experiments, in the paper's form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.paper.kinds import KINDS, Trial
from benchmarks.paper.measure import Outcome
from benchmarks.paper.summary import PAPER_LOADS_MM, SUCCESS, Results, Row, Training
from train.runs.plots import BLUE, GREY, INK, ORANGE, STEPS, dress

GREEN, RED = "#2a9d6f", "#c43333"
LOSSES = ("tqc/critic_loss", "tqc/actor_loss", "gail/discriminator_loss")

COLOURS = {"without": ORANGE, "with": BLUE, "gradient": GREEN}  # of the kinds that are drawn

Style = tuple[str, str]  # label and colour


def _band(panel: Any, steps: np.ndarray, lines: np.ndarray, style: Style) -> None:
    """Draw mean and standard deviation over runs (runs, k)."""
    label, colour = style
    mean, deviation = lines.mean(axis=0), lines.std(axis=0)
    panel.fill_between(steps, mean - deviation, mean + deviation, color=colour, alpha=0.2, linewidth=0)
    panel.plot(steps, mean, color=colour, label=label, linewidth=1.5)


def circle_figure(outcomes: Mapping[Trial, Outcome], arm: str) -> Figure:
    """Draw the circle from above, reference and path of each kind: a panel for each arm, its first seed.

    Points at which a chamber is saturated are ringed.
    """
    chosen = {t: outcome for t, outcome in outcomes.items() if not t.load_g and t.kind in COLOURS}
    twins, seed = sorted({trial.twin for trial in chosen}), min(trial.seed for trial in chosen)
    n_legend_columns, height = (2, 5.8) if len(twins) == 1 else (5, 5.1)
    figure = Figure(figsize=(4.0 * len(twins) + 0.6, height), layout="constrained")
    panels = figure.subplots(1, len(twins), squeeze=False, sharex=True, sharey=True)[0]
    for panel, twin in zip(panels, twins, strict=True):
        dress(panel, f"{arm} {twin}, from above", "x [mm]", "y [mm]")
        panel.set_aspect("equal")
        here = {trial.kind: outcome for trial, outcome in chosen.items() if trial[1:3] == (twin, seed)}
        goal = next(iter(here.values())).goal
        panel.plot(*_closed(goal), "--", color=INK, linewidth=1.2, label="reference")
        for kind, colour in COLOURS.items():
            tip, style = here[kind].goal + here[kind].error, {"linewidth": 1.0, "markersize": 3.0}
            panel.plot(*_closed(tip), "o-", color=colour, label=KINDS[kind].title, **style)
        hit = np.concatenate([(run.goal + run.error)[run.saturated.any(axis=1)] for run in here.values()])
        ring = {"color": RED, "markersize": 7.0, "fillstyle": "none", "linestyle": "none"}
        panel.plot(hit[:, 0], hit[:, 1], "o", label="a chamber saturated", **ring)
    _make_square(panels[0])  # whatever the paths, the layout is the same
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, loc="outside lower center", ncols=n_legend_columns)
    return figure


def _make_square(panel: Any) -> None:
    """Give x and y of a panel, and of those that share them, ranges of one length about their middles."""
    limits = np.array([panel.get_xlim(), panel.get_ylim()])
    half = 0.5 * np.ptp(limits, axis=1).max() * np.array([-1.0, 1.0])
    x, y = limits.mean(axis=1, keepdims=True) + half
    panel.set(xlim=x, ylim=y)


def _closed(pose: np.ndarray) -> np.ndarray:
    """Return x and y (2, p + 1) of poses (p, 6), the last joined with the first."""
    return np.vstack([pose, pose[:1]])[:, :2].T


def loads_figure(table: Sequence[Row]) -> Figure:
    """Draw each run's mean and largest translation error over the load, with S2R, and saturated points.

    Policies that observe the payload are beside those that do not, if there are any.
    """
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    dress(left, "translation error with S2R", "load [g]", "mm")
    dress(right, "saturated chambers", "load [g]", "points of the circle")
    for kind, how, line in (("with", "", "-"), ("payload", ", payload observed", "--")):
        if rows := [row for row in table if row["kind"] == kind]:
            _dots(left, rows, "translation_mm", (f"mean of the circle{how}", BLUE), line)
            _dots(left, rows, "max_mm", (f"largest{how}", GREY), line)
            _dots(right, rows, "saturated_points", (f"a chamber saturated{how}", RED), line)
    left.axhline(PAPER_LOADS_MM, color=INK, linestyle=":", linewidth=1, label="paper's arm, 35 to 500 g")
    right.yaxis.get_major_locator().set_params(integer=True)
    for panel in (left, right):
        panel.set_xticks(sorted({row["load_g"] for row in table if row["kind"] == "with"}))
        panel.tick_params("x", rotation=60)
        panel.set_ylim(0, 1.45 * panel.get_ylim()[1])  # room for the legend
        panel.legend(frameon=False, fontsize=8, loc="upper left")
    return figure


def _dots(panel: Any, rows: Sequence[Row], name: str, style: Style, line: str) -> None:
    """Draw every run as a dot at its load, and a line through the means."""
    label, colour = style
    loads = sorted({row["load_g"] for row in rows})
    means = [np.mean([row[name] for row in rows if row["load_g"] == load]) for load in loads]
    at, values = [row["load_g"] for row in rows], [row[name] for row in rows]
    panel.plot(at, values, "o", color=colour, markersize=3, alpha=0.5)
    panel.plot(loads, means, line, color=colour, label=label)


def success_figure(results: Results) -> Figure:
    """Draw success over environment steps in each run's own simulation: mean, deviation, every run."""
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    panel = figure.subplots()
    dress(panel, "demonstrated poses with success, in simulation", STEPS, "%")
    for kind, colour in (("pipe", BLUE), ("hand-made", ORANGE)):
        runs = [run for (of, *_), run in results.trainings.items() if of == kind]
        steps, share = _series(runs, "evaluation/success_share")
        panel.plot(steps, 100 * share.T, color=colour, linewidth=0.5, alpha=0.4)
        _band(panel, steps, 100 * share, (f"{KINDS[kind].title}: {len(runs)} runs", colour))
    panel.axhline(100 * SUCCESS, color=GREY, linestyle=":", linewidth=1.0)
    panel.set_ylim(0, 105)
    panel.legend(frameon=False, loc="lower right")
    return figure


def losses_figure(results: Results) -> Figure:
    """Draw losses over environment steps with and without gradient penalty, on the twins that have both."""
    twins = {twin for kind, twin, _ in results.trainings if kind == "no-penalty"}
    figure = Figure(figsize=(13, 3.8), layout="constrained")
    panels = figure.subplots(1, len(LOSSES))
    for panel, name in zip(panels, LOSSES, strict=True):
        dress(panel, name.split("/")[1].replace("_", " "), STEPS, "")
        for kind, style in (("pipe", ("with gradient penalty", BLUE)), ("no-penalty", ("without", ORANGE))):
            runs = [run for (of, twin, _), run in results.trainings.items() if of == kind and twin in twins]
            _band(panel, *_series(runs, name), style)
    panels[0].legend(frameon=False, loc="upper left")
    return figure


def _series(runs: Sequence[Training], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return environment steps (k,) and a metric's values (runs, k), from the first update on."""
    lines = [
        [(row["env_steps"], row[name]) for row in run.rows if name in row and row["updates"]] for run in runs
    ]
    steps, values = np.moveaxis(np.array(lines, float), -1, 0)
    return steps[0], values
