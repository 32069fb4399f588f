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
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_softarm.mechanics.mjcf import build_spec
from mjx_softarm.mechanics.pipe import CrossPipe
from mjx_softarm.mechanics.statics import GRAVITY_M_S2
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import N_CHAMBERS_PER_SECTION, ArmSpec
from mjx_softarm.twin.instruments import Build, drawn
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
    hole_m: dict[str, np.ndarray]  # "chamber", "spring" -> (n, 2) in the section's frame
    twist_rad: np.ndarray  # (n_sections,)
    backbone: np.ndarray  # (n_sections,) factor of the stiffness
    link_mass: np.ndarray  # (n_links,) factor
    hysteresis: np.ndarray  # (n,) factor
    base_position_m: np.ndarray  # (3,)
    base_tilt_rad: np.ndarray  # (3,) rotation vector


def draw_parts(seed: int, spec: ArmSpec, build: Build) -> Parts:
    """Draw the parts of a twin from its seed; they do not depend on the scales of noise and losses."""
    rng = np.random.default_rng(seed)
    length = length_ratio(spec)
    std = Tolerances(
        **{
            name: build.gap * x * (length if name.endswith("_m") else 1.0)
            for name, x in dataclasses.asdict(Tolerances()).items()
        }
    )
    n, n_sections, off = spec.n_chambers, spec.structure.n_sections, partial(drawn, rng)

    def per_chamber(value, deviation: float) -> tuple[float, ...]:
        return tuple(np.array(spec.per_chamber(value)) * (1.0 + off(deviation, n)))

    # Chambers, springs and masses.
    chambers, sensor = spec.chambers, spec.sensor
    area_factor = 1.0 + off(std.chamber_area, n)
    delta_m = np.array(spec.per_chamber(sensor.delta_m)) + off(std.spring_delta_m, n)
    offset_m = np.array(spec.per_chamber(chambers.length_offset_m)) + off(std.chamber_length_m, n)
    perturbed = spec.replace(
        structure={"links_per_section": build.per_section or LINKS_PER_SECTION},
        chambers={
            "stiffness_n_per_m": per_chamber(chambers.stiffness_n_per_m, std.chamber_stiffness),
            "area_m2": tuple(area_factor * spec.per_chamber(chambers.area_m2)),
            "area_slope_m": tuple(area_factor * spec.per_chamber(chambers.area_slope_m)),
            "length_offset_m": tuple(offset_m),
        },
        mounting={"base_turn_deg": (0.0,) * 3, "base_offset_m": (0.0,) * 3, "section_roll_deg": ()},
        mass={"gripper_kg": spec.mass.gripper_kg * (1.0 + off(std.gripper_mass)), "payload_kg": 0.0},
    )
    beta = np.array(per_chamber(sensor.beta, std.spring_beta))
    # Holes in the rings, and the base.
    ring_m = np.repeat(off(std.ring_offset_m, n_sections, 2), N_CHAMBERS_PER_SECTION, axis=0)
    angle = np.radians(spec.geometry.first_chamber_deg) + 2 * np.pi * np.arange(n) / N_CHAMBERS_PER_SECTION
    hole_m = {}
    radii_m = {"chamber": spec.geometry.chamber_radius_m, "spring": spec.geometry.spring_radius_m}
    for kind, radius_m in radii_m.items():
        turned = angle + np.radians(off(std.hole_angle_deg, n))
        on_circle = np.stack([np.cos(turned), np.sin(turned)], axis=-1)
        hole_m[kind] = (radius_m + off(std.hole_radius_m, n))[:, None] * on_circle + ring_m
    # The base is not turned about z, because the twist of the first section does it.
    tilt_rad = np.radians(off(std.base_tilt_deg, 3)) * [1.0, 1.0, 0.0]
    return Parts(
        spec=perturbed,
        sensor=dataclasses.replace(spec.spring_sensor, beta=beta, delta_m=delta_m),
        hole_m=hole_m,
        twist_rad=np.radians(off(std.section_twist_deg, n_sections)),
        backbone=1.0 + off(std.backbone_stiffness, n_sections),
        link_mass=1.0 + off(std.link_mass, perturbed.n_links),
        hysteresis=1.0 + off(std.chamber_hysteresis, n),
        base_position_m=off(std.base_offset_m, 3),
        base_tilt_rad=tilt_rad,
    )


def length_ratio(spec: ArmSpec) -> float:
    """Return the length of an arm's sections over that of the paper's arm."""
    return spec.geometry.section_length_m / ArmSpec.default().geometry.section_length_m


def build_twin(parts: Parts, pipe: CrossPipe | None = None) -> mujoco.MjModel:
    """Compile the model in the frame of the arm's own base, with a pipe if there is one.

    Besides the objects of `mjx_softarm.mechanics.mjcf` it has an actuator `loss{i}` on each chamber's
    tendon, whose control is a force [N]. Pressures are not clipped, because the regulators do it.
    """
    # Time step, and gravity in the tilted base.
    spec, per_section = parts.spec, parts.spec.structure.links_per_section
    mjspec = build_spec(spec)
    period_s = 1.0 / spec.control.rate_hz
    mjspec.option.timestep = period_s / math.ceil(period_s / MAX_TIMESTEP_S - 1e-9)
    mjspec.option.gravity = -GRAVITY_M_S2 * rotation_matrix(parts.base_tilt_rad)[2]
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
    for chamber in range(spec.n_chambers):
        _mount(mjspec, chamber, parts, per_section)
        mjspec.actuator(f"chamber{chamber}").ctrllimited = False
        loss = mjspec.add_actuator(name=f"loss{chamber}", target=f"chamber{chamber}")
        loss.trntype = mujoco.mjtTrn.mjTRN_TENDON
    if pipe is not None:
        add_pipe(mjspec, pipe, spec, parts.base_position_m, rotation_matrix(parts.base_tilt_rad))
    return mjspec.compile()


def _mount(mjspec: mujoco.MjSpec, chamber: int, parts: Parts, per_section: int) -> None:
    """Move the holes of a chamber and of its spring; the section's twist does not turn its first plate."""
    section = chamber // N_CHAMBERS_PER_SECTION
    cos, sin = np.cos(parts.twist_rad[section]), np.sin(parts.twist_rad[section])
    for kind, hole_m in parts.hole_m.items():
        x, y = hole_m[chamber]
        for k in range(per_section + 1):
            site = mjspec.site(f"{kind}{chamber}_plate{section * per_section + k}")
            at = [cos * x - sin * y, sin * x + cos * y] if k == 0 else [x, y]
            site.pos = [*at, site.pos[2]]


def rotation_matrix(vector_rad: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) about a vector (3,) by its length [rad]."""
    angle, quaternion, matrix = float(np.linalg.norm(vector_rad)), np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quaternion, vector_rad / max(angle, np.finfo(float).tiny), angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
