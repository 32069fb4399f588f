"""The page of the live view, served by a separate process."""

from __future__ import annotations

import signal
import time
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np
import viser

from mjx_softarm.policy.file import Policy
from mjx_softarm.sensing.pose import pose_from_quaternion, quaternion_from_pose
from mjx_softarm.view.channel import ChannelEnd
from mjx_softarm.view.look import Look
from mjx_softarm.view.panel import BLUE, MUTED, Panel, css
from mjx_softarm.view.stage import GOAL, SATURATED, Stage, add_workspace, open_server, set_the_scene

FRAME_S, BARS, TRACES = 0.02, 5, 10  # time between frames; frames between bars, and between traces
SILENT_S = 1.0  # silence of the loop after which the page says so
DRAG_S = 0.5  # time after a drag in which the gizmo follows the user alone


class Setup(NamedTuple):
    """Settings of the page's server."""

    policy: Policy
    arm: str  # name of the arm
    host: str
    port: int
    carries: bool = False  # a payload can be attached to the arm
    records: bool = False  # poses can be taken as demonstrations
    hint: str = ""  # line about what to try next


def serve(connection: Connection, setup: Setup) -> None:
    """Serve the page until the loop's process ends; the loop handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end = ChannelEnd(connection)
    try:
        server = open_server(setup.host, setup.port, setup.arm)
    except OSError as error:
        end.put(failed=f"--host, --port: got {setup.host}, {setup.port}: {error.strerror or error}")
        end.closed.wait()
        return
    page = Page(server, end, setup)
    end.put(url=f"http://{setup.host}:{server.get_port()}")
    while not end.closed.wait(FRAME_S):
        page.refresh()


class Page:
    """One arm with gizmo, buttons, bars and traces, the same for all browsers."""

    def __init__(self, server: viser.ViserServer, end: ChannelEnd, setup: Setup):
        self._server, self._end, self._hint = server, end, setup.hint
        self._known: dict[str, Any] = {"doing": "is not heard yet", "armed": False, "lines": ()}
        self._n_frames, self._heard_s, self._moved_s = 0, time.monotonic(), -DRAG_S
        self._at = np.full(6, np.nan)  # pose that the gizmo shows
        # Picture of the arm.
        spec = setup.policy.spec
        set_the_scene(server, spec)
        self._stage = Stage(server.scene, spec)
        points = add_workspace(server.scene, setup.policy.workspace)
        look = {"scale": 0.15, "depth_test": False, "visible": False}
        self._gizmo = server.scene.add_transform_controls("/gizmo", **look)
        # Panel beside it.
        icon, button = viser.Icon, self._button
        button("Stop", "hold", "Give up the goals, hold the arm where it is", icon.HAND_STOP, "orange")
        button("Vent", "vent", "Let the pressures go to zero; what it carries sinks", icon.WIND, "red")
        self._panel = Panel(server.gui, spec)
        with server.gui.add_folder("Move", order=0.5):
            button("Circle", "circle", "Go round the paper's circle, point by point", icon.CIRCLE)
            hint = "Fetch a mass on one side, put it down on the other, and back"
            button("Pick and place", "place", hint, icon.ARROWS_EXCHANGE)
            hint = "Follow the goal that is dragged in the picture"
            button("Drag the goal", "follow", hint, icon.ARROWS_MOVE)
            if setup.records:
                button("Take the pose", "take", "Take the pose at rest as a demonstration", icon.CAMERA)
            if setup.carries:
                self._add_payload(round(1e3 * spec.mass.largest_payload_kg))
            box = server.gui.add_checkbox("reachable poses", False, hint="Goals are kept near them")
            box.on_update(lambda _: setattr(points, "visible", box.value))
        self._listen()

    def _button(self, label: str, name: str, hint: str, icon: Any, colour: Any = None) -> None:
        order = 0.0 if colour else None
        button = self._server.gui.add_button(label, hint=hint, color=colour, icon=icon, order=order)

        @button.on_click
        async def _(_: Any) -> None:  # in the server's own thread, so that it waits for nobody
            self._end.put(**{name: True})

    def _add_payload(self, largest_g: int) -> None:
        hint, step_g = "Hung to the finger tips", max(largest_g // 20, 1)
        slider = self._server.gui.add_slider("payload [g]", 0, largest_g, step_g, 0, hint=hint)

        @slider.on_update
        async def _(_: Any) -> None:
            self._end.put(payload_kg=1e-3 * slider.value)

    def _listen(self) -> None:
        @self._gizmo.on_update
        async def _(_: Any) -> None:
            self._moved_s = time.monotonic()
            self._end.put(goal=pose_from_quaternion(self._gizmo.position, self._gizmo.wxyz))

        async def count(_: viser.ClientHandle) -> None:
            self._end.put(pages=len(self._server.get_clients()))

        self._server.on_client_connect(count)
        self._server.on_client_disconnect(count)

    def refresh(self) -> None:
        """Show the newest tick, if there is a new one."""
        news = self._end.take()
        self._known |= news
        if "look" in news:
            self._heard_s = time.monotonic()
            self._n_frames += 1
            look = news["look"]
            with self._server.atomic():
                self._stage.show(look)
                self._show_gizmo(look)
                if self._n_frames % BARS == 0:
                    self._panel.show_bars(look)
                if self._n_frames % TRACES == 0:
                    self._panel.show_traces(look)
        if self._n_frames % BARS == 0 or "look" not in news:
            self._show_text(time.monotonic() - self._heard_s)

    def _show_gizmo(self, look: Look) -> None:
        """Put the gizmo, unless a user drags it, at the loop's goal, where it was left, or at the tip."""
        armed = self._known["armed"]
        at = next((pose for pose in (look.goal, self._at) if armed and np.isfinite(pose).all()), look.tip)
        dragged = time.monotonic() - self._moved_s < DRAG_S
        self._gizmo.visible = armed
        if not dragged and np.isfinite(at).all() and not np.array_equal(at, self._at):
            self._at = at
            self._gizmo.position, self._gizmo.wxyz = 1e-3 * at[:3], quaternion_from_pose(at)

    def _show_text(self, silent_s: float) -> None:
        doing, lines, red = self._known["doing"], self._known["lines"], css(SATURATED)
        if "ended" in self._known:
            vented = "vented" if self._known["vented"] else "NOT VENTED, it may be under pressure"
            title, colour = f"The run has ended; the arm is {vented}", red
            lines = [*lines, self._known["ended"]]
        elif silent_s > SILENT_S:
            title, colour = f"The loop was not heard for {silent_s:.0f} s", red
        else:
            colours = {"moves": BLUE, "holds": css(GOAL)}
            title, colour = f"The arm {doing}", colours.get(doing.split()[0], MUTED)
        self._panel.show_text(
            title, colour, self._known.get("look"), [*filter(None, [self._hint]), *lines[::-1]]
        )
