"""The pictures of the experiments in confined spaces, in the paper's form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.paper.confined_measure import CALM_N, Operated, finger_tips
from benchmarks.paper.confined_stages import KINDS, Learned, Results, Trial, pipe_mm
from benchmarks.paper.confined_summary import SUCCESS
from benchmarks.paper.plots import RED, plot_around
from benchmarks.paper.stages import Case
from mjx_softarm.mechanics.pipe import PIPES_MM, CrossPipe
from mjx_softarm.spec import ArmSpec
from train.runs.plots import BLUE, GREY, INK, ORANGE, STEPS, dress

GREEN = "#2a9d6f"
LEAST_N = 0.1  # where the scale of forces ends
SEEN_Z_MM = (-880.0, -330.0)  # of the pipe, around its crossing
LOSSES = ("tqc/critic_loss", "tqc/actor_loss", "gail/discriminator_loss")


def outline_mm(pipe: CrossPipe) -> list[np.ndarray]:
    """The cross as seen from the front: lines (k, 2) of x and z [mm]."""
    r, far = pipe.radius_m, pipe.branch_m
    top, up, down, bottom = (
        pipe.top_z_m,
        pipe.centre_z_m + r,
        pipe.centre_z_m - r,
        pipe.centre_z_m - pipe.branch_m,
    )
    lines = []
    for side in (-1.0, 1.0):
        lines.append([(side * r, top), (side * r, up), (side * far, up)])
        lines.append([(side * far, down), (side * r, down), (side * r, bottom)])
    return [1e3 * np.array(line) for line in lines]


def positions_figure(results: Results, shown: Sequence[Trial]) -> Figure:
    """The finger tips from the front in the pipe: as demonstrated, on their way, and where they arrived."""
    figure = Figure(figsize=(4.0 * len(shown) + 0.4, 4.2), layout="constrained")
    panels = figure.subplots(1, len(shown), squeeze=False, sharex=True, sharey=True)[0]
    for panel, trial in zip(panels, shown, strict=True):
        diameter_mm = PIPES_MM[KINDS[trial.kind].task]
        dress(panel, f"{diameter_mm} mm pipe, {trial.objects}, from the front", "x [mm]", "z [mm]")
        _positions(panel, results.trials[trial], CrossPipe.of_mm(diameter_mm))
        panel.set_aspect("equal")
        panel.set_ylim(*SEEN_Z_MM)
    figure.legend(*panels[0].get_legend_handles_labels(), frameon=False, loc="outside lower center", ncols=5)
    return figure


def _positions(panel: Any, run: Operated, pipe: CrossPipe) -> None:
    gripper_m = ArmSpec.default().mass.gripper_length_m
    for line in outline_mm(pipe):
        panel.plot(*line.T, color=GREY, linewidth=2.0)
    asked, arrived = (1e3 * finger_tips(pose, gripper_m) for pose in (run.goal, run.goal + run.error))
    panel.plot(*(1e3 * run.finger_m[:, [0, 2]]).T, color=BLUE, linewidth=0.7, alpha=0.6, label="path")
    style = {"linestyle": "none", "markersize": 7.0, "fillstyle": "none", "color": INK}
    panel.plot(asked[:, 0], asked[:, 2], "o", label="demonstrated", **style)
    panel.plot(arrived[:, 0], arrived[:, 2], "o", color=BLUE, markersize=3.5, label="reached")
    for mask, marker, colour, label in (
        (run.success, "s", GREEN, "picked or placed"),
        (run.operation & ~run.success, "x", RED, "not picked or placed"),
    ):
        style = {"linestyle": "none", "markersize": 14.0, "fillstyle": "none", "color": colour}
        panel.plot(asked[mask, 0], asked[mask, 2], marker, label=label, **style)


def errors_figure(results: Results, kind: str, objects: str) -> Figure:
    """Absolute errors in X, Y, Z at each position: mean and range over the runs, and the mean of all.

    Operations are marked by a line each.
    """
    runs = [run for trial, run in results.trials.items() if (trial.kind, trial.objects) == (kind, objects)]
    size = np.abs([run.error[:, :3] for run in runs])  # (runs, p, 3)
    figure = Figure(figsize=(11, 6.4), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    for k, (panel, axis) in enumerate(zip(panels, "XYZ", strict=True)):
        dress(panel, f"absolute error in {axis}", "position" if k == 2 else "", "mm")
        for at in np.flatnonzero(runs[0].operation):
            panel.axvline(at, color=GREY, linestyle=":", linewidth=1.0)
            if k == 0:
                panel.annotate(str(runs[0].name[at]), (at, 1.0), **_ABOVE)
        lines = size[..., k]
        panel.fill_between(
            np.arange(lines.shape[1]), *_range(lines), color=BLUE, alpha=0.15, label="range of the runs"
        )
        panel.plot(_mean(lines), "o-", color=BLUE, linewidth=1.5, markersize=3.0, label="mean of the runs")
        mean = np.nanmean(lines) if np.isfinite(lines).any() else np.nan
        panel.axhline(mean, color=ORANGE, linestyle="--", label=f"mean of all: {mean:.2f} mm")
        panel.set_ylim(0, 1.25 * panel.get_ylim()[1])
        panel.legend(frameon=False, fontsize=8, loc="upper left", ncols=3)
    panels[0].set_title(panels[0].get_title(loc="left"), loc="left", fontsize=10, color=INK, pad=14)
    return figure


_ABOVE = {
    "xycoords": ("data", "axes fraction"),
    "xytext": (0, 2),
    "textcoords": "offset points",
    "ha": "center",
    "fontsize": 7,
    "color": GREY,
}


def success_figure(results: Results, kinds: Sequence[str]) -> Figure:
    """Success over environment steps in each run's own simulation: mean, standard deviation, every run."""
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    panel = figure.subplots()
    dress(panel, "demonstrated positions with success, in simulation", STEPS, "%")
    for kind, colour in zip(kinds, (BLUE, ORANGE), strict=True):
        runs = _runs(results, kind)
        steps, share = _series(runs, "evaluation/success_share")
        for line in share:
            panel.plot(steps, 100 * line, color=colour, linewidth=0.5, alpha=0.4)
        _mean_and_spread(panel, steps, 100 * share, colour, f"{KINDS[kind].title}: {len(runs)} runs")
    panel.axhline(100 * SUCCESS, color=GREY, linestyle=":", linewidth=1.0)
    panel.set_ylim(0, 105)
    panel.legend(frameon=False, loc="lower right")
    return figure


def losses_figure(results: Results, kinds: Sequence[str]) -> Figure:
    """Losses over environment steps, of the twins that have all kinds: mean and standard deviation."""
    twins = set.intersection(*({twin for of, twin, _ in results.learned if of == kind} for kind in kinds))
    figure = Figure(figsize=(13, 3.8), layout="constrained")
    panels = figure.subplots(1, len(LOSSES))
    for panel, name in zip(panels, LOSSES, strict=True):
        dress(panel, name.split("/")[1].replace("_", " "), STEPS, "")
        for kind, colour, label in zip(
            kinds, (BLUE, ORANGE), ("with gradient penalty", "without"), strict=True
        ):
            steps, loss = _series(_runs(results, kind, twins), name)
            _mean_and_spread(panel, steps, loss, colour, label)
    panels[-1].legend(frameon=False)
    return figure


def force_figure(results: Results, shown: Sequence[Trial]) -> Figure:
    """Contact forces over time, with what was picked and placed when."""
    figure = Figure(figsize=(11, 2.5 * len(shown) + 0.6), layout="constrained")
    panels = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for panel, trial in zip(panels, shown, strict=True):
        run = results.trials[trial]
        title = f"{pipe_mm(KINDS[trial.kind].task)} mm pipe, {trial.objects}"
        dress(panel, title, "time [s]" if trial == shown[-1] else "", "contact force [N]")
        for force_n, colour, label in ((run.container_n, GREEN, "containers"), (run.wall_n, BLUE, "walls")):
            panel.plot(run.time_s, np.maximum(force_n, LEAST_N), color=colour, linewidth=0.8, label=label)
        panel.axhline(CALM_N, color=RED, linestyle="--", linewidth=1.0, label=f"{CALM_N:g} N")
        for at in np.flatnonzero(run.operation & np.isfinite(run.arrival_s)):
            panel.axvline(run.arrival_s[at], color=GREY, linestyle=":", linewidth=1.0)
            panel.annotate(str(run.name[at]), (run.arrival_s[at], 1.0), **_ABOVE)
        panel.set_yscale("log")
        panel.set_ylim(LEAST_N, max(10.0, 2.0 * float(max(run.wall_n.max(), run.container_n.max()))))
        panel.set_title(title, loc="left", fontsize=10, color=INK, pad=14)
    panels[0].legend(frameon=False, fontsize=8, loc="upper right", ncols=3)
    return figure


def circle_figure(results: Results) -> Figure:
    """The circle from above, with and without demonstrations: a panel for each twin, its first seed."""
    twins = sorted({case.twin for case in results.circles})
    seed = min(case.seed for case in results.circles)
    figure = Figure(figsize=(4.0 * len(twins) + 0.4, 3.9), layout="constrained")
    panels = figure.subplots(1, len(twins), squeeze=False, sharex=True, sharey=True)[0]
    for panel, twin in zip(panels, twins, strict=True):
        dress(panel, f"twin {twin}, from above", "x [mm]", "y [mm]")
        without, shown = (
            results.circles[Case("with", twin, seed)],
            results.trials[Trial("circle", twin, seed)],
        )
        plot_around(panel, shown.goal, "--", color=INK, linewidth=1.2, label="reference")
        for run, colour, label in (
            (without, ORANGE, "without demonstrations"),
            (shown, BLUE, KINDS["circle"].title),
        ):
            tip, style = run.goal + run.error, {"linewidth": 1.0, "markersize": 3.0}
            plot_around(panel, tip, "o-", color=colour, label=label, **style)
        panel.set_aspect("equal")
    panels[0].legend(frameon=False, loc="center", fontsize=8)
    return figure


def _runs(results: Results, kind: str, twins: set[int] | None = None) -> list[Learned]:
    return [
        learned
        for (of, twin, _), learned in results.learned.items()
        if of == kind and (twins is None or twin in twins)
    ]


def _series(runs: Sequence[Learned], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Environment steps (k,) and a metric's values (runs, k), from the first update on."""
    lines = [
        [(row["env_steps"], row[name]) for row in run.rows if name in row and row["updates"]] for run in runs
    ]
    steps, values = np.moveaxis(np.array(lines, float), -1, 0)
    return steps[0], values


def _mean_and_spread(panel: Any, steps: np.ndarray, lines: np.ndarray, colour: str, label: str) -> None:
    mean, deviation = lines.mean(axis=0), lines.std(axis=0)
    panel.fill_between(steps, mean - deviation, mean + deviation, color=colour, alpha=0.2, linewidth=0)
    panel.plot(steps, mean, color=colour, label=label, linewidth=1.5)


def _mean(lines: np.ndarray) -> np.ndarray:
    """Over the runs (runs, p) that reached a position; NaN where none did."""
    n = np.isfinite(lines).sum(axis=0)
    return np.where(n, np.nansum(lines, axis=0), np.nan) / np.maximum(n, 1)


def _range(lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = np.isfinite(lines)
    low = np.where(known, lines, np.inf).min(axis=0)
    high = np.where(known, lines, -np.inf).max(axis=0)
    some = known.any(axis=0)
    return np.where(some, low, np.nan), np.where(some, high, np.nan)
