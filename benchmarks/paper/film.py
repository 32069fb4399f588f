"""Films of a trial: the twin's model, drawn without a display, beside its path seen from one side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.paper.kinds import KINDS, Trial
from benchmarks.paper.measure import WatchedTwin, captured_finger_tips, finger_tips, operate
from benchmarks.paper.scene import Scene
from mjx_softarm.mechanics.pipe import PIPES_MM, CrossPipe

WIDTH, HEIGHT = 240, 320  # of each half [px]
LABEL_HEIGHT = 32  # of the text above a square side view [px]
PERIOD_S = 1.0  # simulated time between two pictures
MAX_FRAMES = 120
FRAME_MS = 80
N_LOAD_FRAMES, LOAD_FRAME_MS = 70, 110  # of the film that has a column for each load
N_COLOURS = 128
INK, GREY, BLUE, ORANGE = (34, 34, 34), (154, 160, 166), (31, 111, 180), (224, 123, 40)


class SideView(NamedTuple):
    """Drawing beside the pictures."""

    title: str
    text: str
    axes: tuple[int, int]  # of x, y, z: the one to the right, and the one upwards
    goals_mm: np.ndarray  # (p, 3)
    lines_mm: tuple[np.ndarray, ...] = ()  # (k, 2) each, along these axes


class TwinCamera:
    """Pictures of a twin at equal times as it is driven, with what motion capture saw then."""

    def __init__(self, twin: Any, renderer: Any):
        self._twin, self._renderer, self._next_s = twin, renderer, 0.0
        self.pictures: list[np.ndarray] = []
        self.seen: list[Any] = []

    def shoot(self) -> None:
        """Take a picture, if it is time to."""
        if self._twin.time_s >= self._next_s:
            self._next_s += PERIOD_S
            self.pictures.append(self._twin.draw(self._renderer))
            self.seen.append(self._twin.motion_capture())


def film_scene(path: Path, scene: Scene, trial: Trial) -> None:
    """Write the film of a trial: its pipe cut open from the front, or the circle from above."""
    camera = _filmed(scene, trial)
    diameter_mm = PIPES_MM.get(KINDS[trial.kind].task)
    gripper_m = scene.controller.policy.spec.mass.gripper_length_m if diameter_mm else 0.0
    path_mm = 1e3 * np.array(
        [captured_finger_tips(seen.tip_m, seen.tip_quaternion, gripper_m) for seen in camera.seen]
    )
    goals_mm = 1e3 * finger_tips(scene.goals, gripper_m)
    if diameter_mm:
        lines, title = outline_mm(CrossPipe.of_mm(diameter_mm)), f"twin {trial.twin}, {diameter_mm} mm pipe"
        side = SideView(title, "demonstrated (grey), finger tips", (0, 2), goals_mm, tuple(lines))
    else:
        title = f"twin {trial.twin}, {KINDS[trial.kind].title}"
        side = SideView(title, "reference (grey) and tip, from above", (0, 1), goals_mm)
    write_gif(path, frames(camera.pictures, path_mm, side))


def film_side_by_side(path: Path, scenes: Sequence[tuple[Scene, Trial]]) -> None:
    """Write the film of trials on the circle, at equal times: one column for each, titled by its load."""
    columns = []
    for scene, trial in scenes:
        camera = _filmed(scene, trial)
        path_mm = 1e3 * np.array([seen.tip_m for seen in camera.seen])
        title = f"{trial.load_g:,} g" if trial.load_g else "no load"
        side = SideView(title, "reference (grey) and tip, from above", (0, 1), scene.goals[:, :3])
        columns.append((camera.pictures, path_mm, side))
    write_gif(path, side_by_side(columns), LOAD_FRAME_MS)


def _filmed(scene: Scene, trial: Trial) -> TwinCamera:
    """Run a trial; returns the camera that filmed it."""
    with scene.twin.renderer(WIDTH, HEIGHT) as renderer:
        camera = TwinCamera(scene.twin, renderer)
        operate(WatchedTwin(scene.twin, camera.shoot), *scene[1:], trial.objects)
    return camera


def outline_mm(pipe: CrossPipe) -> list[np.ndarray]:
    """Return the cross from the front: lines (k, 2) of x and z [mm]."""
    r, far, z = pipe.radius_m, pipe.branch_m, pipe.centre_z_m
    lines = []
    for side in (-1.0, 1.0):
        lines.append([(side * r, pipe.top_z_m), (side * r, z + r), (side * far, z + r)])
        lines.append([(side * far, z - r), (side * r, z - r), (side * r, z - far)])
    return [1e3 * np.array(line) for line in lines]


def frames(pictures: list[np.ndarray], path_mm: np.ndarray, side: SideView) -> list[Image.Image]:
    """Return at most `MAX_FRAMES` pictures, evenly spread, each beside the path (n, 3) up to its time."""
    images = []
    for k in _spread(len(pictures), MAX_FRAMES):
        height, width, _ = pictures[k].shape
        images.append(Image.new("RGB", (2 * width, height)))
        images[-1].paste(Image.fromarray(pictures[k]), (0, 0))
        images[-1].paste(_side_view((width, height), path_mm[: k + 1], side), (width, 0))
    return images


def side_by_side(
    columns: Sequence[tuple[list[np.ndarray], np.ndarray, SideView]],
) -> list[Image.Image]:
    """Return frames with a column for each trial: its picture above its path (n, 3) up to the same time.

    A trial that ended before the others shows its last picture from then on.
    """
    images = []
    for k in _spread(max(len(pictures) for pictures, _, _ in columns), N_LOAD_FRAMES):
        height, width, _ = columns[0][0][0].shape
        size = (width, width + LABEL_HEIGHT)
        images.append(Image.new("RGB", (width * len(columns), height + size[1])))
        for left, (pictures, path_mm, side) in zip(range(0, images[-1].width, width), columns, strict=True):
            images[-1].paste(Image.fromarray(pictures[min(k, len(pictures) - 1)]), (left, 0))
            images[-1].paste(_side_view(size, path_mm[: k + 1], side), (left, height))
    return images


def _spread(n: int, n_most: int) -> list[int]:
    """Return at most `n_most` of n indices, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, n - 1, min(n_most, n)).round().astype(int)).tolist()


def _side_view(size: tuple[int, int], path_mm: np.ndarray, side: SideView) -> Image.Image:
    """Draw a path (k, 3) from one side into a picture of some width and height [px]."""
    width, height = size
    image = Image.new("RGB", size, (255, 255, 255))
    pen = ImageDraw.Draw(image)
    # Scale so that goals and lines fill 80 % of the picture.
    axes = list(side.axes)
    shown = np.concatenate([side.goals_mm[:, axes], *side.lines_mm])
    low, high = shown.min(axis=0), shown.max(axis=0)
    scale = 0.8 * min(np.array(size) / np.maximum(high - low, 1.0))

    def at(point_mm: np.ndarray) -> tuple[float, float]:
        right, up = scale * (point_mm - 0.5 * (low + high))
        return 0.5 * width + right, 0.53 * height - up

    for line in side.lines_mm:
        pen.line([at(point) for point in line], fill=GREY, width=2)
    pen.text((8, 8), side.title, fill=INK)
    pen.text((8, 22), side.text, fill=GREY)
    for goal in side.goals_mm[:, axes]:
        pen.circle(at(goal), 2, fill=GREY)
    pen.line([at(point) for point in path_mm[:, axes]], fill=BLUE, width=1)
    pen.circle(at(path_mm[-1, axes]), 4, fill=ORANGE)
    return image


def write_gif(path: Path, images: list[Image.Image], frame_ms: int = FRAME_MS) -> None:
    """Write a film that repeats, with one palette for all its frames."""
    palette = images[len(images) // 2].quantize(N_COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    part = path.with_name(path.name + ".part")
    first.save(
        part, format="GIF", save_all=True, append_images=others, duration=frame_ms, loop=0, optimize=True
    )
    part.replace(path)
