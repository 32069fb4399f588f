"""One arm in viser's scene: bellows, rings, springs, gripper, payload, tip, goal and trail.

All copies of a part are one batched mesh, so that a frame needs few messages.
"""

from __future__ import annotations

import contextlib
from collections import deque
from typing import Any

import numpy as np
import trimesh
import viser
from trimesh import creation

from mjx_softarm.mechanics.body import (
    COILS,
    FOLDS,
    SPRING_WIDTH_M,
    Copies,
    gripper_boxes,
    payload_radius_m,
    shape,
)
from mjx_softarm.posture import base_rotation, posture
from mjx_softarm.sensing.pose import quaternion_from_pose, quaternion_from_rotation
from mjx_softarm.spec import ArmSpec
from mjx_softarm.view.look import Look

SECTION_COLOURS = ((214, 90, 66), (235, 172, 70), (70, 140, 200))  # as in MuJoCo's pictures
SATURATED, GOAL, SEEN = (226, 38, 77), (40, 160, 96), (124, 77, 210)
_RING, _SPRING, _GRIPPER, _MOUNT = (62, 66, 74), (176, 182, 190), (52, 55, 62), (142, 147, 155)
_PAYLOAD, _TRAIL = (52, 150, 66), (245, 130, 32)
_TRAIL_POINTS, _TRAIL_STEP_M = 300, 2e-3
_RING_M, _WIRE_M, _MOUNT_M = 0.005, 7e-4, (0.095, 0.04)  # height; radius; radius and height


class Stage:
    """One arm in the scene, with its base at `place_m`; several arms can stand side by side."""

    def __init__(
        self,
        scene: viser.SceneApi,
        spec: ArmSpec,
        name: str = "/arm",
        place_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ):
        self._spec = spec
        self._trail: deque[np.ndarray] = deque(maxlen=_TRAIL_POINTS)
        self._marked: np.ndarray | None = None  # (n_chambers,) bool, chambers drawn as saturated
        scene.add_frame(name, show_axes=False, position=place_m)

        def solid(path: str, mesh: trimesh.Trimesh, colour, **options: Any):
            vertices, faces = mesh.vertices, mesh.faces
            return scene.add_mesh_simple(f"{name}/{path}", vertices, faces, color=colour, **options)

        def copies(path: str, mesh: trimesh.Trimesh, at: Copies, colour):
            batch = mesh.vertices, mesh.faces, at.quaternion, at.position_m
            colours = np.tile(np.array(colour, np.uint8), (len(at.scale), 1))
            looks = {"batched_scales": at.scale, "batched_colors": colours, "lod": "off"}
            return scene.add_batched_meshes_simple(f"{name}/{path}", *batch, **looks)

        def points(path: str, colour, size_m: float):
            looks = {"point_size": size_m, "point_shape": "circle", "visible": False}
            return scene.add_point_cloud(f"{name}/{path}", np.zeros((1, 3)), colour, **looks)

        # Bellows, rings and springs.
        length_m = spec.length_m / spec.structure.n_sections
        self._spring_m = spec.at_springs(spec.geometry.section_length_m)  # lengths in the last picture
        rest = shape(spec, self._spring_m, np.full(6, np.nan))
        turn = _coil(1.6 * SPRING_WIDTH_M, _WIRE_M, length_m / COILS)
        base = base_rotation(spec)
        behind = base @ (0.0, 0.0, _MOUNT_M[1] / 2) + spec.mounting.base_offset_m
        turned = quaternion_from_rotation(base)
        solid("mount", _disc(*_MOUNT_M), _MOUNT, position=behind, wxyz=turned)
        self._rings = copies("rings", _disc(1.0, _RING_M), rest.rings, _RING)
        self._folds = copies("bellows", _fold(), rest.folds, _RING)
        self._coils = copies("springs", turn, rest.coils, _SPRING)
        # Tip, seen tip and goal, each with a gripper; payload, markers and trail.
        self._tip = scene.add_frame(f"{name}/tip", show_axes=False)
        self._seen = scene.add_frame(f"{name}/seen", show_axes=False)
        self._goal = scene.add_frame(f"{name}/goal", show_axes=False)
        solid("tip/gripper", _gripper(spec), _GRIPPER, flat_shading=True)
        for path, colour in (("seen", SEEN), ("goal", GOAL)):
            solid(f"{path}/gripper", _gripper(spec), colour, opacity=0.4, flat_shading=True)
        self._payload = scene.add_icosphere(
            f"{name}/tip/payload", 1.0, color=_PAYLOAD, position=(0.0, 0.0, -spec.mass.gripper_length_m)
        )
        self._markers, self._path = points("markers", SEEN, 0.008), points("trail", _TRAIL, 0.003)
        self._asked = points("path", GOAL, 0.004)

    def show(self, look: Look) -> None:
        """Draw a moment."""
        self._spring_m = np.where(np.isnan(look.spring_m), self._spring_m, look.spring_m)
        now = shape(self._spec, self._spring_m, look.tip)
        for handle, copies in ((self._rings, now.rings), (self._folds, now.folds), (self._coils, now.coils)):
            handle.batched_positions, handle.batched_wxyzs = copies.position_m, copies.quaternion
            handle.batched_scales = copies.scale
        self._mark(look.saturated)
        self._tip.position, self._tip.wxyz = now.rings.position_m[-1], now.rings.quaternion[-1]
        self._payload.visible = look.payload_kg > 0.0
        self._payload.scale = payload_radius_m(look.payload_kg)
        for handle, pose in ((self._seen, look.seen), (self._goal, look.goal)):
            handle.visible = bool(np.isfinite(pose).all())
            if handle.visible:
                handle.position, handle.wxyz = 1e-3 * pose[:3], quaternion_from_pose(pose)
        if len(look.marker_m) and np.isfinite(look.marker_m).all():
            self._markers.points, self._markers.visible = look.marker_m, True
        self._follow(now.rings.position_m[-1])

    def show_path(self, position_m: np.ndarray) -> None:
        """Draw the path (k, 3) [m] that is asked for; nothing where it has no points."""
        if len(position_m):
            self._asked.points, self._asked.visible = position_m, True

    def _follow(self, tip_m: np.ndarray) -> None:
        if not self._trail or np.linalg.norm(tip_m - self._trail[-1]) > _TRAIL_STEP_M:
            self._trail.append(tip_m)
            self._path.points, self._path.visible = np.array(self._trail), True

    def _mark(self, saturated: np.ndarray) -> None:
        """Colour the bellows; send a message only if the colours change."""
        if self._marked is None or not np.array_equal(saturated, self._marked):
            self._marked = saturated
            colours = np.array(section_colours(self._spec, len(saturated)))
            colour = np.where(saturated[:, None], SATURATED, colours).astype(np.uint8)
            self._folds.batched_colors = np.repeat(colour, FOLDS, axis=0)


def _disc(radius_m: float, height_m: float) -> trimesh.Trimesh:
    """Return a flat cylinder about z."""
    return creation.cylinder(radius_m, height_m, sections=48)


def _fold() -> trimesh.Trimesh:
    """Return one convolution of a bellows about z, of radius and height 1."""
    height = np.linspace(-0.5, 0.5, 7)
    profile = np.stack([0.86 + 0.14 * np.cos(2 * np.pi * height), height], axis=-1)
    return creation.revolve(profile, sections=18)


def _coil(radius_m: float, wire_m: float, pitch_m: float) -> trimesh.Trimesh:
    """Return one turn of a spring about z, of height 1; stretched to the pitch, its wire is round."""
    n, n_wire = 13, 4  # points along the turn, and around the wire
    along, about = np.meshgrid(np.linspace(0, 2 * np.pi, n), 2 * np.pi * np.arange(n_wire) / n_wire)
    out = radius_m + wire_m * np.cos(about)
    height = along / (2 * np.pi) - 0.5 + wire_m / pitch_m * np.sin(about)
    vertices = np.stack([out * np.cos(along), out * np.sin(along), height], axis=-1)  # (n_wire, n, 3)
    here = np.arange(n_wire * n).reshape(n_wire, n)
    a, c = here[:, :-1], here[:, 1:]
    b, d = (np.roll(side, -1, axis=0) for side in (a, c))
    faces = np.concatenate([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)])
    return trimesh.Trimesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)


def _gripper(spec: ArmSpec) -> trimesh.Trimesh:
    """Return the gripper below the tip, in the tip's frame."""
    middle = np.array([0.0, 0.0, -spec.mass.gripper_length_m / 2])
    boxes = [
        creation.box(bounds=middle + centre_m + np.array([-half_m, half_m]))
        for half_m, centre_m in gripper_boxes(spec).values()
    ]
    return trimesh.util.concatenate(boxes)  # pyright: ignore[reportReturnType]


def section_colours(spec: ArmSpec, n: int) -> list[tuple[int, int, int]]:
    """Return the colours of n chambers or springs, by their sections."""
    return [SECTION_COLOURS[k * spec.structure.n_sections // n % len(SECTION_COLOURS)] for k in range(n)]


def add_workspace(scene: viser.SceneApi, pose: np.ndarray) -> viser.SceneNodeHandle:
    """Add the reachable poses (m, 6) [mm, deg], darker with depth; hidden."""
    depth = (pose[:, 2:3].max() - pose[:, 2:3]) / max(float(np.ptp(pose[:, 2])), 1.0)
    colours = (depth * (38, 84, 160) + (1 - depth) * (120, 200, 235)).astype(np.uint8)
    looks = {"point_size": 0.004, "point_shape": "circle", "visible": False}
    return scene.add_point_cloud("/workspace", 1e-3 * pose[:, :3], colours, **looks)


def open_server(host: str, port: int, label: str) -> viser.ViserServer:
    """Return a server that prints nothing.

    Raises:
        OSError: the server cannot listen at this address.
    """
    with contextlib.redirect_stdout(None):
        return viser.ViserServer(host, port, label=label, verbose=False)


def set_the_scene(server: viser.ViserServer, spec: ArmSpec, width_m: float = 0.0) -> None:
    """Set theme, floor and camera for arms side by side along y over a width [m]."""
    length_m = spec.length_m + spec.mass.gripper_length_m
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(36, 99, 168))
    server.scene.set_up_direction("+z")
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)  # the default map bleaches the colours
    server.scene.add_light_ambient("/light", intensity=1.2)
    beside, axis = np.array([0.0, width_m / 2, 0.0]), -posture(spec)[:, 2]
    middle = beside + 0.55 * length_m * axis
    floor = beside - [0.0, 0.0, (1.3 if axis[2] < 0.5 else 0.1) * length_m]  # an upright arm stands on it
    lines = {"cell_size": 0.1, "cell_color": (228, 231, 236), "section_color": (205, 210, 217)}
    server.scene.add_grid("/floor", 1.6, 1.6 + width_m, position=floor, section_size=0.4, **lines)
    away_m = 1.35 * length_m + 1.2 * width_m
    server.initial_camera.position = middle + [away_m, -0.5 * away_m, 0.25 * length_m]
    server.initial_camera.look_at = middle
