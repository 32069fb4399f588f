"""Pictures of the arm: MuJoCo's renderer without a display, joint coordinates -> RGB.

    with Renderer(build_model(spec)) as renderer:
        Image.fromarray(renderer.draw(q)).save("arm.png")

Drawing off screen needs EGL (a GPU, or Mesa on the CPU) or OSMesa (Mesa on the CPU). The environment
variable `MUJOCO_GL` chooses one; while it is unset, EGL and OSMesa are tried in this order.
"""

from __future__ import annotations

import copy
import functools
import importlib
import os
import re
import subprocess
import sys
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context

from mjx_softarm._support.errors import InputError

_HEADLESS = ("egl", "osmesa")
_ADVICE = "Install EGL or OSMesa (Debian: libegl1, libosmesa6) and set MUJOCO_GL=egl or MUJOCO_GL=osmesa"
_MAX_GEOMS = 10_000
_FOLDS_PER_LINK = 4  # convolutions of a bellows between two rings
_CORE_RADIUS = 0.8  # radius between two convolutions as a share of the bellows'
_MOUNT_RADIUS_M = 0.095
_MOUNT_HALF_HEIGHT_M = 0.02
_MOUNT_COLOUR = (0.55, 0.57, 0.60, 1.0)
_PAYLOAD_COLOUR = (0.20, 0.60, 0.25, 1.0)


class RenderError(InputError):
    """Error of a machine that cannot draw; the message says what was tried and what to do."""


@dataclass(frozen=True)
class Camera:
    """A view of the arm. Lengths are in arm lengths, from the base to the middle of the gripper at rest."""

    azimuth_deg: float = 35.0  # 0 looks along +x; grows counter-clockwise seen from above
    elevation_deg: float = -8.0  # negative looks down
    height: float = 1.45  # height of the picture at the arm's distance
    centre: float = 0.57  # distance of the picture's middle from the base, along the straight arm


class Renderer:
    """Renderer of one model. It holds an OpenGL context while it is entered, so a film opens only one."""

    def __init__(self, model: mujoco.MjModel, width: int = 900, height: int = 1200):
        """Open the context for pictures of width x height pixels of a model of `mjx_softarm.mechanics.mjcf`.

        Raises:
            RenderError: there is no OpenGL to draw with.
        """
        self._model = copy.copy(model)
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = width, height
        self._model.vis.quality.offsamples = 8
        self._data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(self._model, self._data)
        base = self._data.geom("ring0")
        self._base_m, self._base_rotation = base.xpos.copy(), base.xmat.reshape(3, 3).copy()
        self._arm_length_m = float(np.linalg.norm(self._data.body("gripper").xpos - self._base_m))
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0
        self._renderer = _open_renderer(self._model, width, height)

    def draw(self, q: np.ndarray, camera: Camera | None = None, payload_radius_m: float = 0.0) -> np.ndarray:
        """Draw the arm at joint coordinates q (nq,) [m, rad]: RGB, (height, width, 3) uint8.

        A payload that the model does not draw by itself is a ball of `payload_radius_m` at the finger tips.

        Raises:
            ValueError: q has another shape, or is not finite.
        """
        if np.shape(q) != (self._model.nq,):
            raise ValueError(f"q: got shape {np.shape(q)}, expected ({self._model.nq},)")
        if not np.isfinite(q).all():
            raise ValueError("q: got numbers that are not finite, expected those of an arm that settled")

        # Scene at these joint coordinates, then parts that MuJoCo does not draw by itself
        self._data.qpos[:] = q
        mujoco.mj_forward(self._model, self._data)
        view = self._camera(camera or Camera())
        self._renderer.update_scene(self._data, view, self._option)
        scene = self._renderer.scene
        _draw_bellows(scene, self._model)
        _draw_mount(scene, self._base_m, self._base_rotation)
        if payload_radius_m > 0.0:
            held, size = self._data.body("payload").xpos, np.full(3, payload_radius_m)
            _append(scene, mujoco.mjtGeom.mjGEOM_SPHERE, size, held, np.eye(3), _PAYLOAD_COLOUR)
        _add_light(scene, np.radians(view.azimuth))
        return self._renderer.render()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def _camera(self, camera: Camera) -> mujoco.MjvCamera:
        view = mujoco.MjvCamera()
        view.azimuth, view.elevation = camera.azimuth_deg, camera.elevation_deg
        view.lookat[:] = self._base_m - camera.centre * self._arm_length_m * self._base_rotation[:, 2]
        half_angle = np.radians(self._model.vis.global_.fovy) / 2
        view.distance = camera.height * self._arm_length_m / (2 * np.tan(half_angle))
        return view


def _open_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """Open MuJoCo's renderer with the OpenGL that MUJOCO_GL names, or with a headless one that works."""
    name = os.environ.get("MUJOCO_GL", "").lower().strip()
    if not name and sys.platform == "linux":
        name = _working_library()
    try:
        if name in _HEADLESS:
            gl_context.GLContext = importlib.import_module(f"mujoco.{name}").GLContext
        return mujoco.Renderer(model, height, width, _MAX_GEOMS)
    except Exception as error:  # each OpenGL library raises errors of its own
        message = " ".join(f"{type(error).__name__}: {error}".split())
        raise RenderError(
            f"MUJOCO_GL: got {name!r} ({message}), expected OpenGL to draw with. {_ADVICE}"
        ) from error


@functools.cache
def _working_library() -> str:
    """Return the first headless library that draws.

    Each is tried in a process of its own: once one is loaded, even in vain, the others fail.
    """
    program = (
        "import mujoco; gl = mujoco.GLContext(8, 8); gl.make_current();"
        "model = mujoco.MjModel.from_xml_string('<mujoco/>');"
        "context = mujoco.MjrContext(model, 150); context.free(); gl.free()"
    )
    tried = []
    for name in _HEADLESS:
        environment = {**os.environ, "MUJOCO_GL": name}
        probe = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False
        )
        if probe.returncode == 0:
            return name
        error = re.search(r"^[\w.]+(Error|Exception)\b.*", probe.stderr, re.MULTILINE)
        tried.append(f"{name}: {error[0] if error else 'failed'}")
    raise RenderError(f"MUJOCO_GL: got {'; '.join(tried)}; expected OpenGL to draw with. {_ADVICE}")


def _append(scene: mujoco.MjvScene, kind: mujoco.mjtGeom, size, position, rotation, rgba) -> None:
    """Add a shape to a scene, unless the scene is full."""
    if scene.ngeom < scene.maxgeom:
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, size, position, np.ravel(rotation), np.asarray(rgba, np.float32))
        scene.ngeom += 1


def _draw_bellows(scene: mujoco.MjvScene, model: mujoco.MjModel) -> None:
    """Replace the plain tubes that MuJoCo draws for the chambers' tendons by convolutions."""
    for k in range(scene.ngeom):
        tube = scene.geoms[k]
        is_tendon = tube.objtype == mujoco.mjtObj.mjOBJ_TENDON
        if not (is_tendon and model.tendon(tube.objid).name.startswith("chamber")):
            continue
        radius, half = float(tube.size[0]), float(tube.size[2])
        centre, rotation = np.array(tube.pos), np.array(tube.mat).reshape(3, 3)
        tube.size[:2] = _CORE_RADIUS * radius
        pitch = 2 * half / _FOLDS_PER_LINK
        for fold in range(_FOLDS_PER_LINK):
            position = centre + rotation[:, 2] * ((fold + 0.5) * pitch - half)
            size = np.array([radius, radius, 0.6 * pitch])
            _append(scene, mujoco.mjtGeom.mjGEOM_ELLIPSOID, size, position, rotation, tube.rgba)


def _draw_mount(scene: mujoco.MjvScene, base_m: np.ndarray, base_rotation: np.ndarray) -> None:
    """Draw the disc that the arm is mounted on, behind its base at (3,) [m] with the axes (3, 3)."""
    size = np.array([_MOUNT_RADIUS_M, _MOUNT_HALF_HEIGHT_M, 0.0])
    position = base_m + _MOUNT_HALF_HEIGHT_M * base_rotation[:, 2]
    _append(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, size, position, base_rotation, _MOUNT_COLOUR)


def _add_light(scene: mujoco.MjvScene, azimuth: float) -> None:
    """Add a lamp over the camera's left shoulder, which gives the round parts their shape."""
    light = scene.lights[scene.nlight]
    light.headlight, light.castshadow, light.type = 0, 0, mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    heading = azimuth - np.radians(40.0)
    light.dir[:] = [0.8 * np.cos(heading), 0.8 * np.sin(heading), -0.6]
    light.pos[:] = -3.0 * light.dir
    light.ambient[:], light.diffuse[:], light.specular[:] = 0.0, 0.4, 0.2
    light.attenuation[:] = [1.0, 0.0, 0.0]
    scene.nlight += 1
