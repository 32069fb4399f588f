"""Pictures of the paper's experiments: the circle, errors over payloads, traces over time, and a film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from benchmarks.harness.common import grouped
from benchmarks.paper.jobs import Scene
from benchmarks.paper.trial import TrialOutcome, WatchedTwin, below_tips, finger_tips, operate
from benchmarks.paper.trials import KINDS, Trial
from mjx_softarm._support.files import replacing
from mjx_softarm.control import Gains
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.pipe import PIPES, CrossPipe
from mjx_softarm.spec import ArmSpec
from train.runs.plots import BLUE, GREY, INK, ORANGE, dress

GREEN, RED = "#2a9d6f", "#c43333"
COLOURS = {"without": ORANGE, "with": BLUE, "gradient": GREEN}  # of the kinds on the circle
SHADES = ("Blues", "Oranges", "Greens", "Purples")  # of the sections' springs and chambers, in turn
WIDTH, HEIGHT = 240, 320  # of a picture of a film [px]
PERIOD_S = 1.0  # simulated time between two pictures
MAX_FRAMES, FRAME_MS, N_COLOURS = 120, 80, 128

Row = Mapping[str, Any]


def circle_figure(outcomes: Mapping[Trial, TrialOutcome], arm: str) -> Figure:
    """Draw the circle from above, reference and path of each kind: a panel for each arm, its first seed.

    Points at which a chamber is saturated are ringed.
    """
    # Choose the unloaded trials of the first seed, and lay out a panel for each arm.
    chosen = {t: run for t, run in outcomes.items() if t.kind in COLOURS and t.variant == "0 g"}
    twins, seed = sorted({trial.twin for trial in chosen}), min(trial.seed for trial in chosen)
    n_legend_columns, height = (2, 5.8) if len(twins) == 1 else (5, 5.1)
    figure = Figure(figsize=(4.0 * len(twins) + 0.6, height), layout="constrained")
    panels = figure.subplots(1, len(twins), squeeze=False, sharex=True, sharey=True)[0]
    for panel, twin in zip(panels, twins, strict=True):
        # Draw the reference and the path of each kind.
        dress(panel, f"{arm} {twin}, from above", "x [mm]", "y [mm]")
        panel.set_aspect("equal")
        shown = {trial.kind: outcome for trial, outcome in chosen.items() if trial[1:3] == (twin, seed)}
        goal = next(iter(shown.values())).goal
        panel.plot(*_closed(goal), "--", color=INK, linewidth=1.2, label="reference")
        for kind, colour in COLOURS.items():
            tip, style = shown[kind].goal + shown[kind].error, {"linewidth": 1.0, "markersize": 3.0}
            panel.plot(*_closed(tip), "o-", color=colour, label=KINDS[kind].title, **style)
        # Ring the saturated points.
        hit = np.concatenate([(run.goal + run.error)[run.saturated.any(axis=1)] for run in shown.values()])
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


def loads_figure(rows: Sequence[Row], arm: str, paper_mm: Sequence[tuple[float, float]]) -> Figure:
    """Draw the mean error on the circle over the payload, a line for each policy that carries payloads.

    Dots are single runs, bars end at the largest error of a policy's runs.

    Args:
        rows: a row of figures for each trial.
        arm: stand-in.
        paper_mm: payload [g] and error [mm] of the paper's arm.
    """
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    panel = figure.subplots()
    dress(panel, f"circle, {arm}s", "payload [g]", "tip error [mm]")
    kinds = dict.fromkeys(row["kind"] for row in rows if row["load_g"] and row["kind"] != "gradient")
    for k, kind in enumerate(kinds):
        own = sorted((r for r in rows if r["kind"] == kind and not r["lap_s"]), key=lambda r: r["load_g"])
        by_load = {load_g: group for (load_g,), group in grouped(own, ("load_g",)).items()}
        mean = [np.mean([row["translation_mm"] for row in group]) for group in by_load.values()]
        largest = [max(row["max_mm"] for row in group) for group in by_load.values()]
        colour = colormaps["tab10"](k)
        panel.plot([r["load_g"] for r in own], [r["translation_mm"] for r in own], ".", color=colour)
        panel.plot(list(by_load), mean, color=colour, label=KINDS[kind].title)
        panel.vlines(list(by_load), mean, largest, color=colour, alpha=0.35)
    panel.plot(*np.transpose(paper_mm), "x--", color=GREY, label="the paper's arm: mean; at 1 kg largest")
    panel.legend(frameon=False, fontsize=8)
    return figure


def at_limits(log: Log, spec: ArmSpec) -> dict[str, Any]:
    """Return the share of time with a chamber at a limit, which chambers, and the springs' mean deviation."""
    gains = Gains.from_spec(spec).measured()
    pressure_kpa = np.asarray(log.pressure_kpa)
    at_limit = (pressure_kpa < gains.pressure_min_kpa) | (pressure_kpa > gains.pressure_max_kpa)
    off_mm = 1e3 * np.abs(np.asarray(log.spring_m) - np.asarray(log.reference_m))
    return {
        "time with a chamber at a limit [%]": round(100 * float(at_limit.any(axis=1).mean()), 1),
        "chambers at a limit": " ".join(map(str, np.flatnonzero(at_limit.any(axis=0)))) or "none",
        "springs off their references, mean [mm]": round(float(np.nanmean(off_mm)), 2),
    }


def traces_figure(logs: Mapping[int, Log], spec: ArmSpec) -> Figure:
    """Draw readings, spring lengths with their references, and pressures: a column for each payload [g]."""
    # Panels, with shared axes along time and for each quantity
    titles = (
        f"{spec.sensor.reading_name} [{spec.sensor.unit}]",
        "spring lengths [mm]; dashed: references",
        "pressures [kPa]; red: limits",
    )
    figure = Figure(figsize=(4.2 * len(logs) + 0.6, 8.6), layout="constrained")
    panels = figure.subplots(len(titles), len(logs), squeeze=False, sharex="col", sharey="row")
    for column, (load, log) in zip(panels.T, logs.items(), strict=True):
        # Lines of all springs and chambers
        readings, spring_m, reference_m, pressure_kpa = map(
            np.asarray, (log.readings, log.spring_m, log.reference_m, log.pressure_kpa)
        )
        time_s, references = log.time_s - log.time_s[0], {"linestyle": "--", "linewidth": 0.6}
        lines = ((0, readings, {}), (1, 1e3 * spring_m, {}), (1, 1e3 * reference_m, references))
        for row, values, style in (*lines, (2, pressure_kpa, {})):
            for k, colour in enumerate(_colours(spec, values.shape[1])):
                column[row].plot(time_s, values[:, k], color=colour, **{"linewidth": 0.9, **style})
        # Titles, and the limits of pressure
        for panel, title in zip(column, titles, strict=True):
            dress(panel, f"{load} g: {title}" if panel is column[0] else title, "", "")
        for kpa in np.unique([spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa]):
            column[2].axhline(kpa, color=RED, linestyle="--", linewidth=1.0)
        column[2].set_xlabel("time [s]")
    return figure


def _colours(spec: ArmSpec, n: int) -> list[Any]:
    """Return a colour for each of n springs or chambers: a hue for each section, a shade for each within."""
    n_each = n // spec.structure.n_sections
    return [
        colormaps[SHADES[section % len(SHADES)]](0.45 + 0.5 * k / max(1, n_each - 1))
        for section in range(spec.structure.n_sections)
        for k in range(n_each)
    ]


class SideView(NamedTuple):
    """Text, goals and outlines of the drawing of a path."""

    title: str
    text: str
    axes: list[int]  # of x, y, z: the one to the right, and the one upwards
    goals_mm: np.ndarray  # (p, 3)
    lines_mm: tuple[np.ndarray, ...] = ()  # (k, 2) each, along the axes


def film(path: Path, scene: Scene, trial: Trial) -> None:
    """Run a trial and write its film: the twin at equal times beside its path."""
    side, gripper_m = _side(scene, trial)
    pictures, tips_m = [], []
    with scene.twin.renderer(WIDTH, HEIGHT) as renderer:

        def shoot() -> None:
            if scene.twin.time_s >= PERIOD_S * len(pictures):
                pictures.append(scene.twin.draw(renderer))
                tip_m, rotation = scene.twin.tip()
                tips_m.append(below_tips(tip_m, rotation, gripper_m))

        operate(WatchedTwin(scene.twin, shoot), *scene[1:], trial)
    write_gif(path, frames(pictures, 1e3 * np.array(tips_m), side))


def _side(scene: Scene, trial: Trial) -> tuple[SideView, float]:
    """Return the pipe cut open from the front or the circle from above, and the gripper's length [m]."""
    if pipe := PIPES.get(KINDS[trial.kind].task):
        gripper_m = scene.controller.policy.spec.mass.gripper_length_m
        goals_mm, lines = 1e3 * finger_tips(scene.goals, gripper_m), outline_mm(pipe)
        title, text = (
            f"twin {trial.twin}, {1e3 * pipe.diameter_m:g} mm pipe",
            "demonstrated (grey), finger tips",
        )
        return SideView(title, text, [0, 2], goals_mm, lines), gripper_m
    title, text = f"twin {trial.twin}, {KINDS[trial.kind].title}", "reference (grey) and tip, from above"
    return SideView(title, text, [0, 1], scene.goals[:, :3]), 0.0


def outline_mm(pipe: CrossPipe) -> tuple[np.ndarray, ...]:
    """Return the cross from the front: lines (k, 2) of x and z [mm]."""
    r, far, z = pipe.radius_m, pipe.branch_m, pipe.centre_z_m
    lines = []
    for side in (-1.0, 1.0):
        lines.append([(side * r, pipe.top_z_m), (side * r, z + r), (side * far, z + r)])
        lines.append([(side * far, z - r), (side * r, z - r), (side * r, z - far)])
    return tuple(1e3 * np.array(line) for line in lines)


def frames(pictures: Sequence[np.ndarray], path_mm: np.ndarray, side: SideView) -> list[Image.Image]:
    """Return at most `MAX_FRAMES` pictures, evenly spread, each beside the path (n, 3) up to its time."""
    n, images = len(pictures), []
    for k in np.unique(np.linspace(0, n - 1, min(MAX_FRAMES, n)).round().astype(int)).tolist():
        height, width, _ = pictures[k].shape
        images.append(Image.new("RGB", (2 * width, height)))
        images[-1].paste(Image.fromarray(pictures[k]), (0, 0))
        images[-1].paste(_side_view((width, height), path_mm[: k + 1], side), (width, 0))
    return images


def _side_view(size: tuple[int, int], path_mm: np.ndarray, side: SideView) -> Image.Image:
    """Draw a path (k, 3) from one side into a picture of some width and height [px]."""
    # Scale so that goals and lines fill 80 % of the picture.
    (width, height), image = size, Image.new("RGB", size, (255, 255, 255))
    pen = ImageDraw.Draw(image)
    shown = np.concatenate([side.goals_mm[:, side.axes], *side.lines_mm])
    low, high = shown.min(axis=0), shown.max(axis=0)
    scale = 0.8 * min(np.array(size) / np.maximum(high - low, 1.0))

    def at(point_mm: np.ndarray) -> tuple[float, float]:
        right, up = scale * (point_mm - 0.5 * (low + high))
        return 0.5 * width + right, 0.53 * height - up

    # Outlines, text and goals, then the path with its end.
    for line in side.lines_mm:
        pen.line([at(point) for point in line], fill=GREY, width=2)
    pen.text((8, 8), side.title, fill=INK)
    pen.text((8, 22), side.text, fill=GREY)
    for goal in side.goals_mm[:, side.axes]:
        pen.circle(at(goal), 2, fill=GREY)
    pen.line([at(point) for point in path_mm[:, side.axes]], fill=BLUE, width=1)
    pen.circle(at(path_mm[-1, side.axes]), 4, fill=ORANGE)
    return image


def write_gif(path: Path, images: list[Image.Image]) -> None:
    """Write a film that repeats, with one palette for all its frames."""
    palette = images[len(images) // 2].quantize(N_COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    repeats = {"save_all": True, "append_images": others, "duration": FRAME_MS, "loop": 0}
    with replacing(path) as part:
        first.save(part, format="GIF", optimize=True, **repeats)
