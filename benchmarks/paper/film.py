"""Film of a trial: the twin's model, drawn without a display, beside its path seen from one side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.paper.kinds import KINDS, Trial
from benchmarks.paper.measure import WatchedTwin, below_tips, finger_tips, operate
from benchmarks.paper.scene import Scene
from mjx_softarm._support.files import replacing
from mjx_softarm.mechanics.pipe import PIPES, CrossPipe

WIDTH, HEIGHT = 240, 320  # of a picture [px]
PERIOD_S = 1.0  # simulated time between two pictures
MAX_FRAMES, FRAME_MS, N_COLOURS = 120, 80, 128
INK, GREY, BLUE, ORANGE = (34, 34, 34), (154, 160, 166), (31, 111, 180), (224, 123, 40)


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

        operate(WatchedTwin(scene.twin, shoot), *scene[1:], trial.objects)
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
