"""Errors of poses in space, of a training run in progress or of a calibration."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import NoReturn

import numpy as np
import viser

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.files import read_json_lines
from mjx_softarm.logs.pose_pairs import POSES_FILE, PosePairs, read_pose_pairs
from mjx_softarm.spec import ARM_FILE, ArmSpec
from mjx_softarm.view.look import Limits, look_at
from mjx_softarm.view.panel import MUTED, add_box, css, plot
from mjx_softarm.view.stage import SATURATED, Stage, set_the_scene

CONFIG_FILE, METRICS_FILE = "config.json", "metrics.jsonl"  # files of a run
CURVES = {"evaluation/median_mm": ("median", "#1f6fb4"), "evaluation/circle_mean_mm": ("circle", "#e07b28")}
REFRESH_S = 1.0
SCALE_MM = np.array([1.0, 2.0, 5.0, 10.0, 20.0])  # errors of the colours in SCALE; colours between are mixed
SCALE = np.array([(33, 145, 80), (140, 190, 60), (240, 200, 60), (240, 130, 40), (200, 30, 60)])
_POINT_M, _LINE_M, _WARNED = 0.005, 0.0015, SATURATED


def spec_of(folder: Path) -> ArmSpec:
    """Return the arm of a run's or a calibration's folder.

    Raises:
        InputError: the folder is not of a run or a calibration.
        SpecError: its specification cannot be used.
    """
    if (folder / ARM_FILE).exists():
        return ArmSpec.from_toml(folder / ARM_FILE)
    try:
        return ArmSpec.from_dict(json.loads((folder / CONFIG_FILE).read_text("utf-8"))["spec"], str(folder))
    except (OSError, ValueError, KeyError, TypeError) as error:
        expected = f"the folder of a run, with {CONFIG_FILE}, or of a calibration, with {ARM_FILE}"
        raise InputError(f"{folder}: got {error}, expected {expected}") from error


def colours(error_mm: np.ndarray) -> np.ndarray:
    """Return colours (n, 3) of errors (n,) [mm], on a logarithmic scale."""
    place = np.log(np.maximum(error_mm, SCALE_MM[0]))
    return np.stack([np.interp(place, np.log(SCALE_MM), part) for part in SCALE.T], axis=-1).astype(np.uint8)


class Errors:
    """A page with poses coloured by their errors, lines to their targets, and learning curves.

    Raises:
        InputError: the folder is not of a run or a calibration.
    """

    def __init__(self, server: viser.ViserServer, folder: Path):
        self._server, self._folder, self._read = server, folder, {}
        self._is_run = (folder / CONFIG_FILE).exists()
        spec = spec_of(folder)
        set_the_scene(server, spec)
        straight_m = spec.at_springs(spec.geometry.section_length_m)
        Stage(server.scene, spec, Limits.of(spec)).show(look_at({"time_s": 0.0}, straight_m, spec))
        self._text = server.gui.add_html("", order=0.0)
        self._sets = server.gui.add_folder("Poses", order=0.5)
        self._boxes: dict[str, viser.GuiCheckboxHandle] = {}
        if self._is_run:
            self._curve = plot(server.gui, "tip error [mm] over env steps", list(CURVES.values()))

    def refresh(self) -> None:
        """Show the folder's files if they have changed."""
        if self._changed(POSES_FILE):
            sets = read_pose_pairs(self._folder)
            with self._server.atomic():
                for name, pairs in sets.items():
                    self._show(name, pairs)
            self._say("".join(_summary(name, pairs) for name, pairs in sets.items()))
        elif not self._boxes:
            missing = f"no {POSES_FILE} here: the logs had no poses, or an older version wrote this folder"
            self._say(f"<div>{'waiting for the first evaluation ...' if self._is_run else missing}</div>")
        if self._is_run and self._changed(METRICS_FILE):
            self._show_curves()

    def _changed(self, name: str) -> bool:
        """Return whether a file exists and was written since the last call."""
        path = self._folder / name
        written = path.stat().st_mtime_ns if path.exists() else None
        before, self._read[name] = self._read.get(name), written
        return written not in (None, before)

    def _show(self, name: str, pairs: PosePairs) -> None:
        target_m, pose_m = 1e-3 * pairs.target[:, :3], 1e-3 * pairs.pose[:, :3]
        if name not in self._boxes:
            node = self._server.scene.add_frame(f"/{name}", show_axes=False)
            with self._sets:
                self._boxes[name] = add_box(self._server.gui, name, True, node)
        colour = colours(pairs.error_mm)
        looks = {"point_size": _POINT_M, "point_shape": "circle"}
        scene = self._server.scene
        scene.add_point_cloud(f"/{name}/points", target_m, colour, **looks)
        lines = np.stack([target_m, pose_m], axis=1)  # (n, 2, 3)
        ends = np.repeat(colour[:, None], 2, axis=1)
        scene.add_line_segments(f"/{name}/lines", lines, ends, thickness=_LINE_M)
        if pairs.warned.any():
            looks |= {"point_size": 2 * _POINT_M, "point_shape": "diamond"}
            scene.add_point_cloud(f"/{name}/warned", target_m[pairs.warned], _WARNED, **looks)
        else:
            scene.remove_by_name(f"/{name}/warned")

    def _show_curves(self) -> None:
        rows = read_json_lines(self._folder / METRICS_FILE)
        evaluated = [row for row in rows if all(name in row for name in CURVES)]
        if evaluated:
            self._curve.data = tuple(
                np.array([row[name] for row in evaluated], float) for name in ("env_steps", *CURVES)
            )

    def _say(self, rows: str) -> None:
        stops = ", ".join(f"{css(c)} {100 * k / (len(SCALE) - 1):.0f}%" for k, c in enumerate(SCALE))
        marks = "".join(f"<span>{mm:g}</span>" for mm in SCALE_MM)
        bar = f"height:8px;border-radius:4px;background:linear-gradient(to right, {stops})"
        about = "a chamber saturated, or not settled" if self._is_run else "the network extrapolates"
        self._text.content = (
            "<div style='padding:0.5em 0.8em;font-size:12px;line-height:1.5'>"
            f"{rows}<div style='margin-top:0.5em;{bar}'></div>"
            f"<div style='display:flex;justify-content:space-between;color:{MUTED}'>{marks}</div>"
            f"<div style='color:{MUTED}'>error [mm]; diamonds: {about}</div></div>"
        )


def _summary(name: str, pairs: PosePairs) -> str:
    median, most = np.quantile(pairs.error_mm, (0.5, 0.95))
    poses = f"{len(pairs.target)} poses, {pairs.warned.sum()} marked"
    return f"<div><b>{name}</b>: median {median:.2f} mm, 95 % {most:.2f} mm; {poses}</div>"


def follow_errors(server: viser.ViserServer, folder: Path) -> NoReturn:
    """Serve the errors of a folder until Ctrl-C.

    Raises:
        InputError: the folder is not of a run or a calibration, or its poses cannot be read.
    """
    page = Errors(server, folder)
    while True:
        page.refresh()
        time.sleep(REFRESH_S)
