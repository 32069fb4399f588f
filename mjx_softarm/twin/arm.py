"""The twin: a simulated arm in place of a real one, reached only through `ArmIO` and logs.

Its model is finer than training's: inexact parts, drawn from a seed, chambers with hysteresis, joints with
friction, pumped air and noisy sensors.

Hysteresis and friction are stop operators: springs, each in series with a slider. A stop follows the
displacement x elastically until its force reaches its limit, then slides:

    f'  = clip(f + k (x' - x), -limit, limit)

The sum of several is the Prandtl-Ishlinskii model. It is passive: a slider only dissipates energy, and a
spring returns the energy that it stored. A single stop is Coulomb friction with an elastic start.

Source: Brokate, Sprekels, "Hysteresis and Phase Transitions", Springer 1996, chapter 2.

Clock: simulated time passes only in `write_pressures`, by one control period of the specification. So a loop
that reads, computes and writes runs at the control rate on any machine.
"""

from __future__ import annotations

import functools
from typing import Any

import mujoco
import numpy as np

from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.mechanics.body import payload_radius_m
from mjx_softarm.mechanics.mjcf import chamber_lengths, spring_lengths
from mjx_softarm.mechanics.pipe import CrossPipe
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin.instruments import (
    AS_BUILT,
    EVALUATION_SESSION,
    MARKERS_PER_SECTION,
    Build,
    InstrumentedArm,
)
from mjx_softarm.twin.model import build_twin, draw_parts
from mjx_softarm.twin.pipe import contact_force_n, is_wall

# Losses of the paper's arm.
# Chambers: four stops of equal force; together 3 % of the elastic force of the shortest chamber.
HYSTERESIS_LIMIT_N = 1.5
HYSTERESIS_STROKES_M = (0.003, 0.006, 0.012, 0.024)
# Joints of a link (slide, hinges): Coulomb friction, and the displacement at which the joint slides.
FRICTION_LIMIT = (0.3, 0.01, 0.01)  # [N, N m, N m]
FRICTION_STROKE = (2e-4, 5e-3, 5e-3)  # [m, rad, rad]

REST_S = 4.0  # time for which the arm rests at atmospheric pressure before its clock starts


class StopOperators:
    """Rate-independent hysteresis: m stop operators in parallel on each of n displacements."""

    def __init__(self, stiffness: np.ndarray, limit: np.ndarray, x: np.ndarray):
        """Start without force at displacements x (n,), with springs (n, m) and limits of sliders (n, m)."""
        self._stiffness, self._low, self._high = stiffness, -limit, limit
        self._x = np.array(x, float)
        self._force = np.zeros(np.shape(limit))

    def move(self, x: np.ndarray) -> np.ndarray:
        """Move to x (n,); return the resisting force (n,), positive where the displacement has grown."""
        trial = self._force + self._stiffness * (x - self._x)[:, None]
        self._force = np.minimum(np.maximum(trial, self._low), self._high)
        self._x = np.array(x, float)
        return self._force.sum(axis=1)


class Twin(InstrumentedArm):
    """One arm with its pump, sensors and cameras; an `ArmIO` with motion capture.

    Example: `twin = Twin(7)`, then `twin.read_sensors()` and `twin.write_pressures(p)` in turn.
    """

    def __init__(
        self,
        seed: int,
        spec: ArmSpec | None = None,
        payload_kg: float = 0.0,
        session: int = EVALUATION_SESSION,
        build: Build = AS_BUILT,
        pipe: CrossPipe | None = None,
    ):
        """Hang the arm up, unpressurised, and wait until it is at rest.

        Args:
            seed: integer >= 0 that chooses the twin.
            spec: nominal arm that the twin deviates from, by default the paper's; its payload is ignored.
            payload_kg: payload at the start.
            session: integer that chooses the noise.
            build: scales of the deviations from an ideal arm.
            pipe: pipe around the arm, in the motion capture's frame; without a pipe the arm touches nothing.
        """
        # Draw the parts and compile the model.
        spec = spec or ArmSpec.default()
        self._parts = draw_parts(seed, spec, build)
        self._build = build
        super().__init__(self._parts.spec, self._parts.sensor, seed, session, build)
        self._pipe = pipe
        self._model = build_twin(self._parts, pipe)
        self._data = mujoco.MjData(self._model)
        self._wall = is_wall(self._model)
        self.wall_force_n = 0.0  # largest contact force of the walls in the last control period
        self._base_m = self._parts.base_position_m
        self._base_rotation = self._parts.base_rotation
        # Start clock, losses and air.
        self._steps = round(1.0 / (spec.control.rate_hz * self._model.opt.timestep))
        mujoco.mj_step1(self._model, self._data)
        self._start_losses(spec)
        now_m = chamber_lengths(self._data, spec.n_chambers)
        self._air = self._spec.pneumatics(now_m, self._model.opt.timestep)
        # Let the arm come to rest.
        self.attach(payload_kg)
        for _ in range(round(REST_S * spec.control.rate_hz)):
            self.write_pressures(np.zeros(spec.n_chambers))
        self.time_s = 0.0

    def _start_losses(self, spec: ArmSpec) -> None:
        """Start hysteresis and friction; they scale with the sections' lengths and stiffnesses."""
        # Lengths, forces and torques of the nominal arm's sections over those of the paper's (n_sections,)
        paper = ArmSpec.default()
        n_sections = spec.structure.n_sections
        length = np.array(spec.per_section(spec.geometry.section_length_m)) / np.mean(
            paper.geometry.section_length_m
        )
        chambers = np.reshape(spec.per_chamber(spec.chambers.stiffness_n_per_m), (n_sections, -1))
        force = length * (chambers.mean(axis=1) / np.mean(paper.chambers.stiffness_n_per_m))
        bending = np.array(spec.per_section(spec.backbone.bending_stiffness_nm_per_rad))
        torque = bending / np.mean(paper.backbone.bending_stiffness_nm_per_rad)

        # Joints (nq, 1), link by link
        links = self._spec.structure.links_per_section
        ones = np.ones(n_sections)
        limit = FRICTION_LIMIT * np.stack([force, torque, torque], axis=-1)
        stroke = FRICTION_STROKE * np.stack([length, ones, ones], axis=-1)
        limit, stroke = (np.repeat(x, links, axis=0).reshape(-1, 1) for x in (limit, stroke))
        limit = self._build.losses * limit
        self._friction = StopOperators(limit / stroke, limit, self._data.qpos)

        # Chambers (n_chambers, stops)
        at_chambers = functools.partial(np.repeat, repeats=spec.structure.chambers_per_section)
        strokes = at_chambers(length)[:, None] * HYSTERESIS_STROKES_M
        scale = (at_chambers(force) * self._build.losses * self._parts.hysteresis)[:, None]
        limit = scale * np.full(len(HYSTERESIS_STROKES_M), HYSTERESIS_LIMIT_N / len(HYSTERESIS_STROKES_M))
        now_m = chamber_lengths(self._data, spec.n_chambers)
        self._hysteresis = StopOperators(limit / strokes, limit, now_m)

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Command pressures (n,) [kPa], then let one control period pass; see `ArmIO`."""
        self._air.command(self._commands(pressure_kpa))
        self.wall_force_n = 0.0
        for _ in range(self._steps):
            self._step()
        if self._data.warning.number.any():  # MuJoCo would reset the state by itself
            got = f"an unstable state at {self.time_s:g} s"
            raise FloatingPointError(f"twin: got {got}, expected a stable one")
        self.time_s += self._steps * self._model.opt.timestep

    def _lengths_m(self) -> np.ndarray:
        return spring_lengths(self._data, self._spec.n_chambers, self._spec.n_springs)

    def tip(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the true place (3,) [m] and rotation (3, 3) of the tip, in motion capture's frame."""
        site = self._data.site("tip")
        return (
            self._base_m + self._base_rotation @ site.xpos,
            self._base_rotation @ site.xmat.reshape(3, 3),
        )

    def motion_capture(self) -> Capture:
        """Return the tip, and markers on the rings at each third of a section, from the base to the tip."""
        spec, data = self._spec, self._data
        n_markers = MARKERS_PER_SECTION * spec.structure.n_sections
        thirds = np.arange(1, n_markers + 1) * spec.structure.links_per_section / MARKERS_PER_SECTION
        bodies = np.round(thirds).astype(int)  # link k is body k + 1, its ring at its lower end
        down = 0.5 * spec.link_length_m[bodies - 1, None] * data.xmat[bodies, 2::3]
        marker_m = self._base_m + (data.xpos[bodies] - down) @ self._base_rotation.T
        tip_m, rotation = self.tip()
        return self._capture(tip_m, self._capture_turn() @ rotation, marker_m)

    def _hang(self, payload_kg: float) -> None:
        body = self._model.body("payload").id
        self._model.body_mass[body] = payload_kg
        self._model.body_inertia[body] = payload_kg * self._spec.mass.gripper_length_m**2 / 12
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))
        mujoco.mj_step1(self._model, self._data)

    def renderer(self, width: int, height: int) -> Any:
        """Return a `mjx_softarm.mechanics.drawing.render.Renderer` of this twin, for `draw`.

        Raises:
            RenderError: OpenGL is missing.
        """
        from mjx_softarm.mechanics.drawing.render import Renderer

        return Renderer(self._model, width, height)

    def draw(self, renderer: Any) -> np.ndarray:
        """Return a picture of the twin: RGB, (height, width, 3) uint8.

        A pipe is cut open and seen from the front, along +y. A payload is a ball at the finger tips.
        """
        from mjx_softarm.mechanics.drawing.render import Camera

        payload_kg = float(self._model.body("payload").mass[0])
        return renderer.draw(
            self._data.qpos,
            Camera(azimuth_deg=90.0, height=1.7, centre=0.66) if self._pipe else None,
            payload_radius_m(payload_kg) if payload_kg else 0.0,
        )

    def _step(self) -> None:
        """Take one time step; afterwards the data hold the lengths and positions at its end."""
        data, n = self._data, self._spec.n_chambers
        length_m = chamber_lengths(data, n)
        data.ctrl[:n] = self._air.step(length_m)
        data.ctrl[n:] = -self._hysteresis.move(length_m)
        data.qfrc_applied[:] = -self._friction.move(data.qpos)
        mujoco.mj_step2(self._model, data)
        if self._pipe is not None:
            self.wall_force_n = max(self.wall_force_n, contact_force_n(data, self._wall))
        mujoco.mj_step1(self._model, data)
