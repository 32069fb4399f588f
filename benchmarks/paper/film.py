"""Films of trials: the twin's model, drawn without a display, above its path from one side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.paper.kinds import KINDS, Trial
from benchmarks.paper.measure import WatchedTwin, captured_finger_tips, finger_tips, operate
from benchmarks.paper.scene import Scene
from mjx_softarm.mechanics.pipe import PIPES_MM, CrossPipe

WIDTH, HEIGHT = 240, 320  # of a picture [px]
LABEL_HEIGHT = 32  # of the text above a square side view [px]
PERIOD_S = 1.0  # simulated time between two pictures
MAX_FRAMES, FRAME_MS, N_COLOURS = 100, 90, 128
INK, GREY, BLUE, ORANGE = (34, 34, 34), (154, 160, 166), (31, 111, 180), (224, 123, 40)
FROM_ABOVE, FROM_FRONT = [0, 1], [0, 2]  # axes: to the right, upwards


class SideView(NamedTuple):
    """Text, goals and outlines of the drawing of a path."""

    title: str
    text: str
    axes: list[int]
    goals_mm: np.ndarray  # (p, 3)
    lines_mm: tuple[np.ndarray, ...] = ()  # (k, 2) each, along the axes


class Column(NamedTuple):
    """A filmed trial: pictures at equal times, the path (n, 3) [mm] at these times, and its side view."""

    pictures: list[np.ndarray]
    path_mm: np.ndarray
    side: SideView


def film(path: Path, scenes: Sequence[tuple[Scene, Trial]]) -> None:
    """Write the film of trials at equal times: one column for each."""
    write_gif(path, frames([_filmed(*scene) for scene in scenes]))


def _filmed(scene: Scene, trial: Trial) -> Column:
    """Run a trial, and take a picture of the twin in each period."""
    # The drawing: the pipe cut open from the front, or the circle from above.
    load = f"{trial.load_g:,} g" if trial.load_g else "no load"
    title, text = f"twin {trial.twin}, {load}", "reference (grey) and tip, from above"
    lines, gripper_m, axes = (), 0.0, FROM_ABOVE
    if diameter_mm := PIPES_MM.get(KINDS[trial.kind].task):
        title, text = f"twin {trial.twin}, {diameter_mm} mm pipe", "demonstrated (grey), finger tips"
        lines, axes = outline_mm(CrossPipe.of_mm(diameter_mm)), FROM_FRONT
        gripper_m = scene.controller.policy.spec.mass.gripper_length_m
    side = SideView(title, text, axes, 1e3 * finger_tips(scene.goals, gripper_m), lines)
    # The pictures, and the path by motion capture.
    pictures, tips_m = [], []
    with scene.twin.renderer(WIDTH, HEIGHT) as renderer:

        def shoot() -> None:
            if scene.twin.time_s >= PERIOD_S * len(pictures):
                pictures.append(scene.twin.draw(renderer))
                seen = scene.twin.motion_capture()
                tips_m.append(captured_finger_tips(seen.tip_m, seen.tip_quaternion, gripper_m))

        operate(WatchedTwin(scene.twin, shoot), *scene[1:], trial.objects)
    return Column(pictures, 1e3 * np.array(tips_m), side)


def outline_mm(pipe: CrossPipe) -> tuple[np.ndarray, ...]:
    """Return the cross from the front: lines (k, 2) of x and z [mm]."""
    r, far, z = pipe.radius_m, pipe.branch_m, pipe.centre_z_m
    lines = []
    for side in (-1.0, 1.0):
        lines.append([(side * r, pipe.top_z_m), (side * r, z + r), (side * far, z + r)])
        lines.append([(side * far, z - r), (side * r, z - r), (side * r, z - far)])
    return tuple(1e3 * np.array(line) for line in lines)


def frames(columns: Sequence[Column]) -> list[Image.Image]:
    """Return at most `MAX_FRAMES` frames, evenly spread: each column's picture above its path until then.

    A trial that ended before the others shows its last picture from then on.
    """
    n, images = max(len(column.pictures) for column in columns), []
    for k in np.unique(np.linspace(0, n - 1, min(MAX_FRAMES, n)).round().astype(int)).tolist():
        height, width, _ = columns[0].pictures[0].shape
        size = (width, width + LABEL_HEIGHT)
        images.append(Image.new("RGB", (width * len(columns), height + size[1])))
        for left, (pictures, path_mm, side) in zip(range(0, images[-1].width, width), columns, strict=True):
            images[-1].paste(Image.fromarray(pictures[min(k, len(pictures) - 1)]), (left, 0))
            images[-1].paste(_side_view(size, path_mm[: k + 1], side), (left, height))
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
    part = path.with_name(path.name + ".part")
    first.save(
        part, format="GIF", save_all=True, append_images=others, duration=FRAME_MS, loop=0, optimize=True
    )
    part.replace(path)
