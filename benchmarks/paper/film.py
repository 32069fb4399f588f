"""Films of a twin: its own model, drawn without a display, beside its path seen from one side."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.paper.measure import Driven
from benchmarks.paper.stages import Case, Settings, controller

WIDTH, HEIGHT = 240, 320  # of each half [px]
EVERY_S = 1.0  # of the twin's time between two pictures
MAX_FRAMES = 120
FRAME_MS = 80
N_COLOURS = 128
INK, GREY, BLUE, ORANGE = (34, 34, 34), (154, 160, 166), (31, 111, 180), (224, 123, 40)


class Side(NamedTuple):
    """What is drawn beside the pictures."""

    title: str
    text: str
    axes: tuple[int, int]  # of x, y, z: which is to the right, and which upwards
    goals_mm: np.ndarray  # (p, 3)
    lines_mm: tuple[np.ndarray, ...] = ()  # (k, 2) each, along these axes


class Film:
    """Pictures of a twin, taken now and then as it is driven, and where motion capture saw it then."""

    def __init__(self, twin: Any, renderer: Any):
        self._twin, self._renderer, self._next_s = twin, renderer, 0.0
        self.pictures: list[np.ndarray] = []
        self.seen: list[Any] = []

    def take(self) -> None:
        """Take one, if it is time to."""
        if self._twin.time_s >= self._next_s:
            self._next_s += EVERY_S
            self.pictures.append(self._twin.draw(self._renderer))
            self.seen.append(self._twin.motion_capture())


def film_circle(folder: Path, settings: Settings) -> str:
    """Write `circle.gif`, once around with S2R on the first twin; returns why it cannot be drawn, or ""."""
    from mjx_softarm.deploy.session import follow
    from mjx_softarm.mechanics.render import RenderError
    from mjx_softarm.mechanics.workspace import circle_poses
    from mjx_softarm.twin.arm import EVALUATION_SESSION, Twin

    path = folder / "circle.gif"
    if path.exists():
        return ""
    case = Case("with", settings.twins[0], settings.seeds[0])
    goals = circle_poses(settings.n_points).astype(float)
    twin = Twin(case.twin, session=EVALUATION_SESSION)
    try:
        with twin.renderer(WIDTH, HEIGHT) as renderer:
            film = Film(twin, renderer)
            follow(Driven(twin, film.take), controller(folder, case), goals)
    except RenderError as error:
        return str(error)
    text = "reference (grey) and tip, from above"
    side = Side(f"twin {case.twin}, with S2R", text, (0, 1), goals[:, :3])
    write_gif(path, frames(film.pictures, 1e3 * np.array([seen.tip_m for seen in film.seen]), side))
    return ""


def frames(pictures: list[np.ndarray], path_mm: np.ndarray, side: Side) -> list[Image.Image]:
    """At most `MAX_FRAMES` of the pictures, spread evenly, each beside the path (n, 3) up to then."""
    chosen = np.unique(np.linspace(0, len(pictures) - 1, min(MAX_FRAMES, len(pictures))).round().astype(int))
    return [_frame(pictures[k], path_mm[: k + 1], side) for k in chosen]


def _frame(picture: np.ndarray, path_mm: np.ndarray, side: Side) -> Image.Image:
    height, width, _ = picture.shape
    frame = Image.new("RGB", (2 * width, height), (255, 255, 255))
    frame.paste(Image.fromarray(picture), (0, 0))
    pen = ImageDraw.Draw(frame)
    axes = list(side.axes)
    shown = np.concatenate([side.goals_mm[:, axes], *side.lines_mm])
    low, high = shown.min(axis=0), shown.max(axis=0)
    scale = 0.8 * min(np.array([width, height]) / np.maximum(high - low, 1.0))

    def at(point_mm: np.ndarray) -> tuple[float, float]:
        right, up = scale * (point_mm - 0.5 * (low + high))
        return 1.5 * width + right, 0.53 * height - up

    for line in side.lines_mm:
        pen.line([at(point) for point in line], fill=GREY, width=2)
    pen.text((width + 8, 8), side.title, fill=INK)
    pen.text((width + 8, 22), side.text, fill=GREY)
    for goal in side.goals_mm[:, axes]:
        _dot(pen, at(goal), 2, GREY)
    pen.line([at(point) for point in path_mm[:, axes]], fill=BLUE, width=1)
    _dot(pen, at(path_mm[-1, axes]), 4, ORANGE)
    return frame


def _dot(pen: ImageDraw.ImageDraw, centre: tuple[float, float], radius: float, colour: Any) -> None:
    x, y = centre
    pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)


def write_gif(path: Path, images: list[Image.Image]) -> None:
    """Write a film that repeats, in one palette for all of its frames."""
    palette = images[len(images) // 2].quantize(N_COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    part = path.with_name(path.name + ".part")
    first.save(
        part, format="GIF", save_all=True, append_images=others, duration=FRAME_MS, loop=0, optimize=True
    )
    part.replace(path)
