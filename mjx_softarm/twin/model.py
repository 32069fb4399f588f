"""The twin's body: a perturbed arm, drawn from a seed, as a MuJoCo model.

Training's model has four links per section and ideal parts. The twin has ten links per section, and each
part deviates by its own draw from `Tolerances`: chambers, rings and holes, the sections' mounting, the
base, masses, springs. One number, `GAP`, multiplies all standard deviations.

How `GAP` was set: the sensor-space law on twins 0 to 5, with calibrated springs and no sim-to-real network,
was given the spring lengths that bring training's model to the 40 points of the paper's circle within 0.01
mm. The mean tip error is 21 mm, the root mean square that the paper reports. `GAP` has not been changed
since.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_softarm._support.fields import PerChamber, scaled
from mjx_softarm.mechanics.mjcf import build_spec
from mjx_softarm.mechanics.pipe import CrossPipe
from mjx_softarm.mechanics.statics import GRAVITY_M_S2
from mjx_softarm.sensing.pose import rotation_about
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin.instruments import Build, drawn, scaled_tolerances
from mjx_softarm.twin.pipe import add_pipe

LINKS_PER_SECTION = 10
MAX_TIMESTEP_S = 0.005  # tip within 0.13 mm RMS of steps of 0.00125 s, over 30 s of random commands


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of the paper's arm at a gap of 1; a field without a unit is relative.

    Those of other arms are as large relative to their sections' length.
    """

    chamber_stiffness: float = 0.03  # per chamber
    chamber_area: float = 0.015  # per chamber
    chamber_length_m: float = 0.001  # per chamber: rest length
    chamber_hysteresis: float = 0.1  # per chamber
    backbone_stiffness: float = 0.05  # per section
    link_mass: float = 0.05  # per link
    gripper_mass: float = 0.02
    hole_angle_deg: float = 2.0  # per chamber, and per spring
    hole_radius_m: float = 0.0015  # per chamber, and per spring
    ring_offset_m: float = 0.002  # per section and axis: offset of the rings' centre from the section's axis
    section_twist_deg: float = 1.75  # per section, against the section above
    base_tilt_deg: float = 0.9  # per axis, against motion capture's frame
    base_offset_m: float = 0.003  # per axis
    spring_beta: float = 0.01  # per spring
    spring_delta_m: float = 0.00075  # per spring


class Parts(NamedTuple):
    """Random parts of one twin."""

    spec: ArmSpec  # specification with the drawn chambers, springs and masses
    sensor: Sensor  # sensors with the drawn beta and delta of each spring
    hole_m: dict[str, np.ndarray]  # "chamber": (n_chambers, 2), "spring": (n_springs, 2), in section frames
    twist_rad: np.ndarray  # (n_sections,)
    backbone: np.ndarray  # (n_sections,) factor of the stiffness
    link_mass: np.ndarray  # (n_links,) factor
    hysteresis: np.ndarray  # (n_chambers,) factor
    base_position_m: np.ndarray  # (3,)
    base_rotation: np.ndarray  # (3, 3)


def draw_parts(seed: int, spec: ArmSpec, build: Build) -> Parts:
    """Draw the parts of a twin from its seed; they do not depend on the scales of noise and losses."""
    rng = np.random.default_rng(seed)
    std = scaled_tolerances(Tolerances(), build.gap, spec)
    n = spec.n_chambers
    n_springs = spec.n_springs
    n_sections = spec.structure.n_sections
    off = partial(drawn, rng)

    # Chambers, springs and masses.
    chambers, sensor = spec.chambers, spec.spring_sensor

    def scattered(value: PerChamber, deviation: float) -> tuple[float, ...]:
        return tuple(np.array(spec.per_chamber(value)) * (1.0 + off(deviation, n)))

    area_factor = 1.0 + off(std.chamber_area, n)
    delta_m = sensor.delta_m + off(std.spring_delta_m, n_springs)
    offset_m = np.array(spec.per_chamber(chambers.length_offset_m)) + off(std.chamber_length_m, n)
    perturbed = spec.replace(
        structure={"links_per_section": build.per_section or LINKS_PER_SECTION},
        chambers={
            "stiffness_n_per_m": scattered(
                scaled(chambers.stiffness_n_per_m, 1.0 - build.softening), std.chamber_stiffness
            ),
            "area_m2": tuple(area_factor * spec.per_chamber(chambers.area_m2)),
            "area_slope_m": tuple(area_factor * spec.per_chamber(chambers.area_slope_m)),
            "length_offset_m": tuple(offset_m),
        },
        mounting={"base_turn_deg": (0.0,) * 3, "base_offset_m": (0.0,) * 3, "section_roll_deg": ()},
        mass={"gripper_kg": spec.mass.gripper_kg * (1.0 + off(std.gripper_mass)), "payload_kg": 0.0},
    )
    beta = sensor.beta * (1.0 + off(std.spring_beta, n_springs))
    hole_m = _draw_holes(off, spec, std)
    # The base is not turned about z, because the twist of the first section does it.
    mounting = spec.mounting
    tilt_rad = np.radians(off(std.base_tilt_deg, 3)) * [1.0, 1.0, 0.0]
    return Parts(
        spec=perturbed,
        sensor=dataclasses.replace(sensor, beta=beta, delta_m=delta_m),
        hole_m=hole_m,
        twist_rad=np.radians(off(std.section_twist_deg, n_sections)),
        backbone=1.0 + off(std.backbone_stiffness, n_sections),
        link_mass=1.0 + off(std.link_mass, perturbed.n_links),
        hysteresis=1.0 + off(std.chamber_hysteresis, n),
        base_position_m=mounting.base_offset_m + off(std.base_offset_m, 3),
        base_rotation=rotation_about(np.radians(mounting.base_turn_deg)) @ rotation_about(tilt_rad),
    )


def _draw_holes(off: Callable[..., np.ndarray], spec: ArmSpec, std: Tolerances) -> dict[str, np.ndarray]:
    """Draw the places (n, 2) of the rings' holes for chambers and for springs."""
    geometry = spec.geometry
    n_sections = spec.structure.n_sections
    ring_m = off(std.ring_offset_m, n_sections, 2)
    first = np.radians(np.array(spec.per_section(geometry.first_chamber_deg)) + spec.section_roll_deg)
    hole_m = {}
    for kind, per_section, radius_m in (
        ("chamber", spec.structure.chambers_per_section, geometry.chamber_radius_m),
        ("spring", spec.springs_per_section, geometry.spring_radius_m),
    ):
        each = partial(np.repeat, repeats=per_section, axis=0)
        n = n_sections * per_section
        angle = each(first) + 2 * np.pi * np.arange(n) / per_section
        turned = angle + np.radians(off(std.hole_angle_deg, n))
        on_circle = np.stack([np.cos(turned), np.sin(turned)], axis=-1)
        radius = each(spec.per_section(radius_m)) + off(std.hole_radius_m, n)
        hole_m[kind] = radius[:, None] * on_circle + each(ring_m)
    return hole_m


def build_twin(parts: Parts, pipe: CrossPipe | None = None) -> mujoco.MjModel:
    """Compile the model in the frame of the arm's own base, with a pipe if there is one.

    Besides the objects of `mjx_softarm.mechanics.mjcf` it has an actuator `loss{i}` on each chamber's
    tendon, whose control is a force [N]. Pressures are not clipped, because the regulators do it.
    """
    # Time step, and gravity in the tilted base.
    spec = parts.spec
    per_section = parts.spec.structure.links_per_section
    mjspec = build_spec(spec)
    period_s = 1.0 / spec.control.rate_hz
    mjspec.option.timestep = period_s / math.ceil(period_s / MAX_TIMESTEP_S - 1e-9)
    mjspec.option.gravity = -GRAVITY_M_S2 * parts.base_rotation[2]
    # Masses, stiffnesses and twists of the links.
    for link in range(spec.n_links):
        section, first = divmod(link, per_section)
        body = mjspec.body(f"link{link}")
        factor = parts.link_mass[link]
        body.mass, body.inertia = body.mass * factor, body.inertia * factor
        for name in ("slide", "bend_x", "bend_y"):
            joint = mjspec.joint(f"{name}{link}")
            joint.stiffness = joint.stiffness * parts.backbone[section]
        if first == 0:
            half = parts.twist_rad[section] / 2
            body.quat = [np.cos(half), 0.0, 0.0, np.sin(half)]
    # Holes, and actuators for the losses.
    for kind, hole_m in parts.hole_m.items():
        _mount(mjspec, kind, hole_m, parts)
    for chamber in range(spec.n_chambers):
        mjspec.actuator(f"chamber{chamber}").ctrllimited = False
        loss = mjspec.add_actuator(name=f"loss{chamber}", target=f"chamber{chamber}")
        loss.trntype = mujoco.mjtTrn.mjTRN_TENDON
    if pipe is not None:
        add_pipe(mjspec, pipe, spec, parts.base_position_m, parts.base_rotation)
    return mjspec.compile()


def _mount(mjspec: mujoco.MjSpec, kind: str, hole_m: np.ndarray, parts: Parts) -> None:
    """Move the holes (n, 2) of chambers or springs; a section's twist does not turn its first plate."""
    per_section = parts.spec.structure.links_per_section
    sections = np.repeat(np.arange(len(parts.twist_rad)), len(hole_m) // len(parts.twist_rad))
    for index, (section, (x, y)) in enumerate(zip(sections, hole_m, strict=True)):
        cos, sin = np.cos(parts.twist_rad[section]), np.sin(parts.twist_rad[section])
        for k in range(per_section + 1):
            site = mjspec.site(f"{kind}{index}_plate{section * per_section + k}")
            place = [cos * x - sin * y, sin * x + cos * y] if k == 0 else [x, y]
            site.pos = [*place, site.pos[2]]
