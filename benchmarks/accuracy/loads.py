"""Policies on the circle with payloads that the loop is not given, on twins and rods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from benchmarks.accuracy.correction import chosen, on_circle
from benchmarks.accuracy.path import means_over
from benchmarks.harness.common import RESULTS, grouped
from benchmarks.paper.summary import HEAVY_G, LIGHT_G, PAPER_HEAVY_MAX_MM, PAPER_LOADS_MM
from mjx_softarm._support import cli
from train.runs.plots import DPI, GREY, dress

PICTURE = "loads.png"
KEYS = ("policy", "on", "load [g]")
MEANS = {
    "mean [mm]": "translation_mm",
    "RMSE [mm]": "rmse_mm",
    "saturated points": "saturated_points",
    "payload told [g]": "load_estimate_g",
}


def measure(
    policies: tuple[str, ...],
    loads: cli.Integers = (0, 35, 100, 200, 300, 500, 1000),
    points: int = 8,
) -> dict[str, Any]:
    """How far is the tip off the circle, with payloads that the loop is not given?

    The picture is `docs/results/loads.png`.

    Args:
        policies: NAME=ARM=FILE of each, such as payload=twin:0=runs/mine/policy.npz; means are over a name
        loads: payloads [g]
        points: of the circle

    Raises:
        InputError: there are no policies, one has another form, or a goal was not measured.
    """
    rows = []
    for name, arm, policy in chosen(policies):
        for load_g in loads:
            found = on_circle(policy, f"{arm}:{load_g}g" if load_g else arm, points)
            row = {"policy": name, "on": "rods" if ":rod:" in arm else "twins", "load [g]": load_g}
            row |= {"arm": arm, **{title: found[key] for title, key in MEANS.items()}}
            rows.append(row | {"largest [mm]": found["max_mm"]})
            print(rows[-1], flush=True)
    means = means_over(rows, KEYS, MEANS)
    for mean, group in zip(means, grouped(rows, KEYS).values(), strict=True):
        mean["largest [mm]"] = max(row["largest [mm]"] for row in group)
    loads_figure(rows).savefig(RESULTS / PICTURE, dpi=DPI)
    return {"points": points, "means": means, "runs": rows}


def loads_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the mean error over the payload: a panel for twins and one for rods, a line for each policy.

    Dots are single runs, bars end at the largest error of a policy's runs.
    """
    kinds, names = (list(dict.fromkeys(row[key] for row in rows)) for key in ("on", "policy"))
    figure = Figure(figsize=(5.2 * len(kinds) + 0.4, 4.2), layout="constrained")
    panels = figure.subplots(1, len(kinds), squeeze=False, sharex=True, sharey=True)[0]
    for panel, kind in zip(panels, kinds, strict=True):
        # The errors of each policy
        dress(panel, f"circle, {kind}", "payload [g]", "tip error [mm]")
        for (name, on), own in grouped(rows, ("policy", "on")).items():
            if on != kind:
                continue
            colour = colormaps["tab10"](names.index(name))
            at = {load: group for (load,), group in grouped(own, ("load [g]",)).items()}
            mean = [np.mean([row["mean [mm]"] for row in group]) for group in at.values()]
            largest = [max(row["largest [mm]"] for row in group) for group in at.values()]
            panel.plot([row["load [g]"] for row in own], [row["mean [mm]"] for row in own], ".", color=colour)
            panel.plot(list(at), mean, color=colour, label=name)
            panel.vlines(list(at), mean, largest, color=colour, alpha=0.35)
        # The paper's arm
        panel.plot([35, LIGHT_G], [PAPER_LOADS_MM] * 2, "--", color=GREY, label="the paper's arm, mean")
        panel.plot([HEAVY_G], [PAPER_HEAVY_MAX_MM], "x", color=GREY, label="the paper's arm, largest")
    panels[0].legend(frameon=False, fontsize=8)
    return figure
