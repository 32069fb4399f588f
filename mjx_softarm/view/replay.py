"""Logs in the browser: played at any speed, side by side, or as one file that plays without a server."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np
import viser

from mjx_softarm._support.errors import InputError
from mjx_softarm.logs.checks import late_rows
from mjx_softarm.logs.files import read_matrix
from mjx_softarm.spec import ArmSpec
from mjx_softarm.view.look import Look, looks
from mjx_softarm.view.panel import BLUE, Panel
from mjx_softarm.view.stage import Stage, open_server, set_the_scene

APART_M = 0.6  # distance between the bases of arms side by side
FRAME_S, TRACES_S = 0.04, 0.2  # time between frames, and between points of the traces
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4", "10", "30")
PATH_POINTS = 400  # points of the path that is asked for, about
SHARE_HZ, SHARE_FRAMES = 10.0, 600  # frame rate; largest number of frames, so a longer log plays faster


class Timeline:
    """One log on a time line that begins with its first row.

    Raises:
        LogError: the log cannot be understood, or has neither readings nor spring lengths.
        InputError: the log has no rows.
    """

    def __init__(self, path: Path, spec: ArmSpec):
        log = read_matrix(path, spec, one_of=("readings", "spring_m"))[0].log()
        log = log.take(np.isfinite(log.time_s))
        log = log.take(~late_rows(log.time_s))
        if not len(log):
            raise InputError(f"{path}: got no rows, expected some")
        self.name, self._time_s = path.name, log.time_s - log.time_s[0]
        self._look, self.end_s = looks(log, spec), float(self._time_s[-1])
        goal = np.zeros((0, 6)) if log.goal is None else log.goal[np.isfinite(log.goal).all(axis=1)]
        self.path_m = 1e-3 * goal[:: max(1, len(goal) // PATH_POINTS), :3]  # (k, 3) goals in their order

    def at(self, time_s: float) -> Look:
        """Return the last look before a time."""
        row = int(np.searchsorted(self._time_s, time_s, side="right")) - 1
        return self._look(max(row, 0))._replace(time_s=float(self._time_s[max(row, 0)]))


class ReplayPage:
    """Logs on a page, with a slider of time and a speed."""

    def __init__(self, server: viser.ViserServer, spec: ArmSpec, timelines: Sequence[Timeline]):
        self._server, self._timelines, self._traced_s = server, timelines, -np.inf
        self._stages, end_s = _stages(server, spec, timelines), max(timeline.end_s for timeline in timelines)
        gui = server.gui
        self._play = gui.add_checkbox("play", True, order=0.0)
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1", order=0.1)
        self._time = gui.add_slider("time [s]", 0.0, max(end_s, FRAME_S), FRAME_S / 2, 0.0, order=0.1)
        self._panels = []
        for timeline in timelines:
            with gui.add_folder(timeline.name):
                self._panels.append(Panel(gui, spec))
        self._shown_s, self._end_s = -1.0, end_s

    def refresh(self, passed_s: float) -> None:
        """Advance by a time [s] of the clock; show the moment if it has changed."""
        if self._play.value:
            later_s = self._time.value + passed_s * float(self._speed.value)
            self._time.value = later_s if later_s <= self._end_s else 0.0
        if self._time.value != self._shown_s:
            self._shown_s = self._time.value
            traced = abs(self._shown_s - self._traced_s) >= TRACES_S
            self._traced_s = self._shown_s if traced else self._traced_s
            with self._server.atomic():
                for timeline, stage, panel in zip(self._timelines, self._stages, self._panels, strict=True):
                    look = timeline.at(self._shown_s)
                    stage.show(look)
                    if traced:
                        panel.show_bars(look)
                        panel.show_traces(look)
                        panel.show_text(f"{look.time_s:.2f} s of {timeline.end_s:.1f} s", BLUE, look)


def replay(server: viser.ViserServer, spec: ArmSpec, timelines: Sequence[Timeline]) -> NoReturn:
    """Serve logs until Ctrl-C."""
    page, before_s = ReplayPage(server, spec, timelines), time.monotonic()
    while True:
        now_s = time.monotonic()
        page.refresh(now_s - before_s)
        before_s = now_s
        time.sleep(FRAME_S)


def share(path: Path, spec: ArmSpec, timelines: Sequence[Timeline]) -> int:
    """Write a page that plays logs without a server; return its speed, 1 or a larger integer."""
    end_s = max(timeline.end_s for timeline in timelines)
    speed = max(1, math.ceil(end_s * SHARE_HZ / SHARE_FRAMES))
    server = open_server("127.0.0.1", 8080, "")
    stages = _stages(server, spec, timelines)
    times_s = np.arange(0.0, end_s + 1e-9, speed / SHARE_HZ)
    recording = server.get_scene_serializer()
    for time_s in times_s:
        for timeline, stage in zip(timelines, stages, strict=True):
            stage.show(timeline.at(time_s))
        recording.insert_sleep(1.0 / SHARE_HZ)
    path.write_text(recording.as_html(), "utf-8")
    with contextlib.redirect_stdout(None):
        server.stop()
    return speed


def _stages(server: viser.ViserServer, spec: ArmSpec, timelines: Sequence[Timeline]) -> list[Stage]:
    """Set the scene; return a stage with a label for each log, side by side."""
    set_the_scene(server, spec, APART_M * (len(timelines) - 1))
    stages = []
    for k, timeline in enumerate(timelines):
        stages.append(Stage(server.scene, spec, f"/arm{k}", (0.0, k * APART_M, 0.0)))
        stages[-1].show_path(timeline.path_m)
        server.scene.add_label(f"/arm{k}/name", timeline.name, position=(0.0, 0.0, 0.09))
    return stages
