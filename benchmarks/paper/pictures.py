"""Pictures of the paper's experiments: the circle, errors over payloads, traces over time, and a film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from benchmarks.harness.common import Row, grouped, labels_once
from benchmarks.paper.trial import finger_tips, operate, watch
from benchmarks.paper.trials import KINDS, Settings, Trial
from mjx_softarm.control import Gains
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.pipe import PIPES, CrossPipe
from mjx_softarm.sensing.pose import frame_from_pose
from mjx_softarm.spec import ArmSpec
from train.runs.plots import BLUE, GREY, INK, ORANGE, dress

GREEN, RED = "#2a9d6f", "#c43333"
COLOURS = {"without": ORANGE, "with": BLUE, "gradient": GREEN}  # of the kinds on the circle
PAPER_MEANS, PAPER_LARGEST = ((35, 500), (9.0, 9.0)), (1000, 23.76)  # [g], [mm] of the paper's arm
WIDTH, HEIGHT = 240, 320  # of a picture of a film [px]
PERIOD_S = 1.0  # simulated time between two pictures
MAX_FRAMES, FRAME_MS, N_COLOURS = 120, 80, 128


def circle_figure(rows: Sequence[Row], at_stops: Sequence[Row], settings: Settings) -> Figure:
    """Draw the circle from above, a panel for each arm, its first seed; saturated points are ringed."""
    n_twins = len(settings.twins)
    figure = Figure(figsize=(4.0 * n_twins + 0.6, 5.8 if n_twins == 1 else 5.1), layout="constrained")
    panels = figure.subplots(1, n_twins, squeeze=False, sharex=True, sharey=True)[0]
    for panel, twin in zip(panels, settings.twins, strict=True):
        dress(panel, f"{settings.arm} {twin}, from above", "x [mm]", "y [mm]")
        panel.set_aspect("equal")
        ring = {"color": RED, "markersize": 7.0, "fillstyle": "none", "linestyle": "none"}
        for row, stops in zip(rows, at_stops, strict=True):
            chosen = (row["twin"], row["seed"], row["variant"]) == (twin, settings.seeds[0], "0 g")
            if not chosen or row["kind"] not in COLOURS:
                continue
            goal = np.array(stops["goal"])[:, :2]
            tip = goal + np.array(stops["error"])[:, :2]
            hit = tip[np.any(stops["saturated"], axis=1)]
            colour, style = COLOURS[row["kind"]], {"linewidth": 1.0, "markersize": 3.0}
            panel.plot(*_closed(goal), "--", color=INK, linewidth=1.2, label="reference")
            panel.plot(*_closed(tip), "o-", color=colour, label=KINDS[row["kind"]].title, **style)
            panel.plot(hit[:, 0], hit[:, 1], "o", label="a chamber saturated", **ring)
    place = {"loc": "outside lower center", "ncols": 2 if n_twins == 1 else 5, "frameon": False}
    figure.legend(*labels_once(panels[0]), **place)
    return figure


def _closed(points: np.ndarray) -> np.ndarray:
    """Return x and y (2, p + 1) of points (p, 2), the last joined with the first."""
    return np.vstack([points, points[:1]]).T


def loads_figure(rows: Sequence[Row], arm: str) -> Figure:
    """Draw errors over the payload: dots of runs, a line of means, bars to the largest error."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    panel = figure.subplots()
    dress(panel, f"circle, {arm}s", "payload [g]", "tip error [mm]")
    kinds = dict.fromkeys(row["kind"] for row in rows if row["load_g"] and row["kind"] != "gradient")
    for k, kind in enumerate(kinds):
        runs = sorted((r for r in rows if r["kind"] == kind and not r["lap_s"]), key=lambda r: r["load_g"])
        by_load = {load_g: group for (load_g,), group in grouped(runs, ("load_g",)).items()}
        mean = [np.mean([row["translation_mm"] for row in group]) for group in by_load.values()]
        largest = [max(row["max_mm"] for row in group) for group in by_load.values()]
        panel.plot([r["load_g"] for r in runs], [r["translation_mm"] for r in runs], ".", color=f"C{k}")
        panel.plot(list(by_load), mean, color=f"C{k}", label=KINDS[kind].title)
        panel.vlines(list(by_load), mean, largest, color=f"C{k}", alpha=0.35)
    panel.plot(*PAPER_MEANS, "x--", color=GREY, label="the paper's arm: mean")
    panel.plot(*PAPER_LARGEST, "^", color=GREY, label="the paper's arm: largest error")
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
    titles = (
        f"{spec.sensor.reading_name} [{spec.sensor.unit}]",
        "spring lengths [mm]; dashed: references",
        "pressures [kPa]; red: limits",
    )
    figure = Figure(figsize=(4.2 * len(logs) + 0.6, 8.6), layout="constrained")
    panels = figure.subplots(len(titles), len(logs), squeeze=False, sharex="col", sharey="row")
    for column, (load, log) in zip(panels.T, logs.items(), strict=True):
        for panel, title in zip(column, titles, strict=True):
            dress(panel, f"{load} g: {title}" if panel is column[0] else title, "", "")
        time_s, (readings, springs, pressures) = log.time_s - log.time_s[0], column
        readings.plot(time_s, log.readings, linewidth=0.9)
        springs.plot(time_s, 1e3 * np.asarray(log.spring_m), linewidth=0.9)
        springs.set_prop_cycle(None)  # the colours of the springs once more
        springs.plot(time_s, 1e3 * np.asarray(log.reference_m), "--", linewidth=0.6)
        pressures.plot(time_s, log.pressure_kpa, linewidth=0.9)
        for kpa in np.unique([spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa]):
            pressures.axhline(kpa, color=RED, linestyle="--", linewidth=1.0)
        pressures.set_xlabel("time [s]")
    return figure


def film(path: Path, scene: tuple[Any, Controller, np.ndarray, list[str]], trial: Trial) -> None:
    """Write a trial's film: the twin beside its tip from above, or its finger tips from a pipe's front."""
    twin, controller, goals, _ = scene
    pipe = PIPES.get(KINDS[trial.kind].task)
    gripper_m = controller.policy.spec.mass.gripper_length_m if pipe else 0.0
    pictures, tips_m = [], []
    with twin.renderer(WIDTH, HEIGHT) as renderer:

        def shoot() -> None:
            if twin.time_s >= PERIOD_S * len(pictures):
                pictures.append(twin.draw(renderer))
                tip_m, rotation = twin.tip()
                tips_m.append(finger_tips(tip_m, rotation, gripper_m))

        watch(twin, shoot)
        operate(*scene, trial)
    # Draw the goals, and the pipe cut open.
    figure = Figure(figsize=(4.8, 3.2), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    view, side = figure.subplots(1, 2)
    axes = [0, 2 if pipe else 1]
    path_mm = 1e3 * np.array(tips_m)[:, axes]
    goals_mm = 1e3 * finger_tips(*frame_from_pose(goals), gripper_m)[:, axes]
    dress(side, f"twin {trial.twin}, {KINDS[trial.kind].title}", "x [mm]", "z [mm]" if pipe else "y [mm]")
    side.set_aspect("equal")
    side.plot(*goals_mm.T, "o", color=GREY, markersize=3.0)
    for line in outline_mm(pipe) if pipe else ():
        side.plot(*line.T, color=GREY)
    # A frame shows the twin, and its path up to this time.
    view.axis("off")
    image = view.imshow(pictures[0])
    (line,) = side.plot(*path_mm.T, color=BLUE)
    (end,) = side.plot([], [], "o", color=ORANGE)

    images = []
    n = len(pictures)
    for k in np.unique(np.linspace(0, n - 1, min(MAX_FRAMES, n)).round().astype(int)).tolist():
        image.set_data(pictures[k])
        line.set_data(*path_mm[: k + 1].T)
        end.set_data(*path_mm[k : k + 1].T)
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    # One palette for all frames makes a small file.
    palette = images[len(images) // 2].quantize(N_COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in images)
    first.save(path, save_all=True, append_images=others, duration=FRAME_MS, loop=0, optimize=True)


def outline_mm(pipe: CrossPipe) -> list[np.ndarray]:
    """Return the cross from the front: lines (k, 2) of x and z [mm]."""
    r, far, z = pipe.radius_m, pipe.branch_m, pipe.centre_z_m
    upper = np.array([(r, pipe.top_z_m), (r, z + r), (far, z + r)])
    lower = np.array([(far, z - r), (r, z - r), (r, z - far)])
    return [1e3 * line * [side, 1.0] for line in (upper, lower) for side in (-1.0, 1.0)]
