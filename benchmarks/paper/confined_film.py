"""A film of the pipe task: the pipe cut open, what is carried drawn, beside the finger tips' path."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.paper.confined_measure import finger_tips, finger_tips_seen, operate
from benchmarks.paper.confined_plots import outline_mm
from benchmarks.paper.confined_stages import KINDS, Trial, scene_of
from benchmarks.paper.film import HEIGHT, WIDTH, Film, Side, frames, write_gif
from benchmarks.paper.measure import Driven
from benchmarks.paper.stages import Settings

FILM_FILE = "pipe.gif"


def film_pipe(folder: Path, settings: Settings) -> str:
    """Write `pipe.gif`, the pipe task on the first twin; returns why it cannot be drawn, or ""."""
    from mjx_softarm.mechanics.pipe import PIPES_MM, CrossPipe
    from mjx_softarm.mechanics.render import RenderError

    path = folder / FILM_FILE
    if path.exists():
        return ""
    trial = Trial("pipe", settings.twins[0], settings.seeds[0])
    scene = scene_of(folder, settings, trial)
    try:
        with scene.twin.renderer(WIDTH, HEIGHT) as renderer:
            film = Film(scene.twin, renderer)
            operate(Driven(scene.twin, film.take), *scene[1:], trial.objects)
    except RenderError as error:
        return str(error)
    gripper_m = scene.controller.policy.spec.mass.gripper_length_m
    path_mm = 1e3 * np.array(
        [finger_tips_seen(seen.tip_m, seen.tip_quaternion, gripper_m) for seen in film.seen]
    )
    diameter_mm = PIPES_MM[KINDS[trial.kind].task]
    side = Side(
        title=f"twin {trial.twin}, {diameter_mm} mm pipe",
        text="demonstrated (grey), finger tips",
        axes=(0, 2),
        goals_mm=1e3 * finger_tips(scene.goals, gripper_m),
        lines_mm=tuple(outline_mm(CrossPipe.of_mm(diameter_mm))),
    )
    write_gif(path, frames(film.pictures, path_mm, side))
    return ""
