"""Picture of the circle on twins, in the paper's form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.paper.kinds import KINDS, Trial
from benchmarks.paper.measure import TrialOutcome
from train.runs.plots import BLUE, INK, ORANGE, dress

GREEN, RED = "#2a9d6f", "#c43333"
COLOURS = {"without": ORANGE, "with": BLUE, "gradient": GREEN}  # of the kinds that are drawn


def circle_figure(outcomes: Mapping[Trial, TrialOutcome], arm: str) -> Figure:
    """Draw the circle from above, reference and path of each kind: a panel for each arm, its first seed.

    Points at which a chamber is saturated are ringed.
    """
    # Choose the unloaded trials of the first seed, and lay out a panel for each arm.
    chosen = {t: outcome for t, outcome in outcomes.items() if not t.load_g and t.kind in COLOURS}
    twins, seed = sorted({trial.twin for trial in chosen}), min(trial.seed for trial in chosen)
    n_legend_columns, height = (2, 5.8) if len(twins) == 1 else (5, 5.1)
    figure = Figure(figsize=(4.0 * len(twins) + 0.6, height), layout="constrained")
    panels = figure.subplots(1, len(twins), squeeze=False, sharex=True, sharey=True)[0]
    for panel, twin in zip(panels, twins, strict=True):
        # Draw the reference and the path of each kind.
        dress(panel, f"{arm} {twin}, from above", "x [mm]", "y [mm]")
        panel.set_aspect("equal")
        here = {trial.kind: outcome for trial, outcome in chosen.items() if trial[1:3] == (twin, seed)}
        goal = next(iter(here.values())).goal
        panel.plot(*_closed(goal), "--", color=INK, linewidth=1.2, label="reference")
        for kind, colour in COLOURS.items():
            tip, style = here[kind].goal + here[kind].error, {"linewidth": 1.0, "markersize": 3.0}
            panel.plot(*_closed(tip), "o-", color=colour, label=KINDS[kind].title, **style)
        # Ring the saturated points.
        hit = np.concatenate([(run.goal + run.error)[run.saturated.any(axis=1)] for run in here.values()])
        ring = {"color": RED, "markersize": 7.0, "fillstyle": "none", "linestyle": "none"}
        panel.plot(hit[:, 0], hit[:, 1], "o", label="a chamber saturated", **ring)
    _make_square(panels[0])  # the layout is then the same for all paths
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, loc="outside lower center", ncols=n_legend_columns)
    return figure


def _make_square(panel: Any) -> None:
    """Give x and y of a panel, and of panels with shared axes, ranges of one length about their middles."""
    limits = np.array([panel.get_xlim(), panel.get_ylim()])
    half = 0.5 * np.ptp(limits, axis=1).max() * np.array([-1.0, 1.0])
    x, y = limits.mean(axis=1, keepdims=True) + half
    panel.set(xlim=x, ylim=y)


def _closed(pose: np.ndarray) -> np.ndarray:
    """Return x and y (2, p + 1) of poses (p, 6), the last joined with the first."""
    return np.vstack([pose, pose[:1]])[:, :2].T
