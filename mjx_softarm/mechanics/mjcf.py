"""ArmSpec -> MuJoCo model: links, chambers and springs, every object named.

Names: bodies `link{i}`, `gripper`, `payload`; joints `slide{i}`, `bend_x{i}`, `bend_y{i}`; tendons and
actuators `chamber{i}`, tendons `spring{i}`; site `tip`. Links count from 0 at the base, chambers and
springs from 0 section by section. All chambers come before all springs. An actuator's control is its
chamber's pressure in kPa.

Bonded chambers (see `mjx_softarm.mechanics.statics`) have tendons `bond{i}_{link}` as well, one for each
link, which come last. A chamber's own tendon then has the stiffness (1 - b) k, each of its n bonds b n k.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from mjx_softarm._support.lazy import mjx, mujoco
from mjx_softarm._support.xp import Array
from mjx_softarm.mechanics.body import SPRING_WIDTH_M, gripper_boxes, payload_radius_m, ring_radius_m
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.statics import GRAVITY_M_S2
from mjx_softarm.sensing.pose import quaternion_from_rotation
from mjx_softarm.spec import ArmSpec

MAX_TIMESTEP_S = 0.004
_SECTION_COLOURS = ([0.85, 0.33, 0.24, 1.0], [0.95, 0.68, 0.25, 1.0], [0.25, 0.55, 0.80, 1.0])
_RING_COLOUR = [0.25, 0.27, 0.30, 1.0]
_SPRING_COLOUR = [0.75, 0.77, 0.80, 1.0]
_GRIPPER_COLOUR = [0.15, 0.16, 0.18, 1.0]
_RING_HALF_HEIGHT_M = 0.002
_DRAWN_ONLY = {"mass": 0.0, "contype": 0, "conaffinity": 0}  # bodies have the masses; nothing touches
_BELLOWS_DRAWN = 0.45  # drawn width as a share of the outer diameter: convolutions are not drawn


def build_spec(spec: ArmSpec) -> mujoco.MjSpec:
    """Return the arm as an editable `mujoco.MjSpec`, for adding an environment before compiling."""
    # Options of the simulation: a whole number of time steps in a control period, no contacts
    params = ArmParams.from_spec(spec, np.float64)
    mjspec = mujoco.MjSpec()
    mjspec.modelname = spec.name
    mjspec.option.gravity = [0.0, 0.0, -GRAVITY_M_S2]
    period_s = 1.0 / spec.control.rate_hz
    mjspec.option.timestep = period_s / steps_per_period(period_s)
    mjspec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    mjspec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT

    # Light and sky
    mjspec.visual.global_.offwidth, mjspec.visual.global_.offheight = 1280, 960
    mjspec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    mjspec.visual.headlight.diffuse = [0.55, 0.55, 0.55]
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT}
    mjspec.add_texture(name="sky", width=64, height=384, rgb1=[1.0] * 3, rgb2=[0.82, 0.86, 0.9], **sky)

    # The chain from the base to the tools, mounted as the specification says, then its tendons
    world = body = mjspec.worldbody
    _add_ring(world, 0, [0.0, 0.0, 0.0], spec)
    _add_holes(world, 0, 0, np.zeros(3), params)
    for link in range(spec.n_links):
        body = _add_link(body, link, params, spec)
    _add_tools(body, params, spec)
    turn = quaternion_from_rotation(params.mount.base_rotation)
    base = world.add_frame(pos=params.mount.base_position_m, quat=turn)
    for part in (*world.geoms, *world.sites, *world.bodies):
        part.set_frame(base)
    for chamber in range(spec.n_chambers):
        _add_chamber(mjspec, chamber, params, spec)
    for spring in range(spec.n_springs):
        _add_spring(mjspec, spring, params, spec)
    for chamber in range(spec.n_chambers if spec.chambers.bonded_share else 0):
        _add_bonds(mjspec, chamber, params, spec)
    return mjspec


def steps_per_period(period_s: float) -> int:
    """Return the number of time steps in one control period: as few as `MAX_TIMESTEP_S` allows."""
    return math.ceil(period_s / MAX_TIMESTEP_S - 1e-9)


def chamber_lengths(data: Any, n_chambers: int) -> Array:
    """Return the chambers' lengths (n_chambers,) [m], a view, from the data of MuJoCo or MJX."""
    return data.ten_length[:n_chambers]


def spring_lengths(data: Any, n_chambers: int, n_springs: int) -> Array:
    """Return the springs' lengths (n_springs,) [m], a view, from the data of MuJoCo or MJX."""
    return data.ten_length[n_chambers : n_chambers + n_springs]


def build_model(spec: ArmSpec) -> mujoco.MjModel:
    """Return the compiled model of an arm."""
    return build_spec(spec).compile()


def loaded(model: mjx.Model, link_mass_kg: Array, tool_mass_kg: Array) -> mjx.Model:
    """Return a model on the device with the masses of `ArmParams`."""
    mass = jnp.concatenate([jnp.zeros(1), link_mass_kg, tool_mass_kg])
    scale = jnp.where(model.body_mass > 0, mass / jnp.maximum(model.body_mass, 1e-9), 0.0)
    return model.replace(body_mass=mass, body_inertia=model.body_inertia * scale[:, None])


def episode_model(model: mjx.Model, params: ArmParams) -> mjx.Model:
    """Return a model on the device with the masses and the tendons' stiffnesses of `params`."""
    model = loaded(model, params.link_mass_kg, params.tool_mass_kg)
    chambers, springs, share = params.chamber_stiffness, params.spring_stiffness, params.bonded_share
    if share is None:
        return model.replace(tendon_stiffness=jnp.concatenate([chambers, springs]))
    links = len(params.link_length_m) // params.n_sections
    bonds = jnp.repeat(links * share * chambers, links)
    return model.replace(tendon_stiffness=jnp.concatenate([(1.0 - share) * chambers, springs, bonds]))


def _add_link(parent, link: int, params: ArmParams, spec: ArmSpec):
    """Add one link: a slide along the parent plate's -z, then two hinges half a link below it."""
    # Body and its inertia, that of a solid cylinder about its centre
    per_section = spec.structure.links_per_section
    section = link // per_section
    half = 0.5 * spec.link_length_m[link]
    offset = -half if link == 0 else -half - 0.5 * spec.link_length_m[link - 1]
    mass = float(params.link_mass_kg[link])
    radius = spec.per_section(spec.geometry.spring_radius_m)[section]
    sideways = mass * (3 * radius**2 + (2 * half) ** 2) / 12
    inertia = [sideways, sideways, mass * radius**2 / 2]
    body = _add_body(parent, f"link{link}", offset, mass, inertia)

    # Joints: a section's backbone is `links_per_section` links in series
    axial = spec.per_section(spec.backbone.axial_damping_ns_per_m)[section]
    bending = spec.per_section(spec.backbone.bending_damping_nms_per_rad)[section]
    slide = ("slide", mujoco.mjtJoint.mjJNT_SLIDE, [0.0, 0.0, -1.0], axial)
    bend_x = ("bend_x", mujoco.mjtJoint.mjJNT_HINGE, [1.0, 0.0, 0.0], bending)
    bend_y = ("bend_y", mujoco.mjtJoint.mjJNT_HINGE, [0.0, 1.0, 0.0], bending)
    hinges = (bend_y, bend_x) if link % 2 else (bend_x, bend_y)  # the order of `mechanics.kinematics`
    for k, (name, kind, axis, damping) in enumerate((slide, *hinges)):
        linear = {"stiffness": params.joint_stiffness[3 * link + k], "damping": damping * per_section}
        body.add_joint(name=f"{name}{link}", type=kind, axis=axis, **linear)

    # Plate: its ring has the holes of two sections where one ends and the next begins
    plate = np.array([0.0, 0.0, -half])
    _add_ring(body, link + 1, plate, spec)
    for part in sorted({section, min((link + 1) // per_section, spec.structure.n_sections - 1)}):
        _add_holes(body, link + 1, part, plate, params)
    return body


def _add_body(parent, name: str, z_m: float, mass_kg: float, inertia: list[float]):
    """Add a body at (0, 0, z_m) in the parent's axes, with its centre of mass at its origin."""
    mass = {"mass": mass_kg, "inertia": inertia, "ipos": [0.0, 0.0, 0.0], "explicitinertial": True}
    return parent.add_body(name=name, pos=[0.0, 0.0, z_m], **mass)


def _add_ring(body, plate: int, position, spec: ArmSpec) -> None:
    size = [ring_radius_m(spec)[plate], _RING_HALF_HEIGHT_M, 0.0]
    kind = mujoco.mjtGeom.mjGEOM_CYLINDER
    body.add_geom(name=f"ring{plate}", type=kind, size=size, pos=position, rgba=_RING_COLOUR, **_DRAWN_ONLY)


def _add_holes(body, plate: int, section: int, position, params: ArmParams) -> None:
    """Add the sites that the chambers and springs of `section` pass on a plate."""
    for kind, site_m in (("chamber", params.chamber_site_m), ("spring", params.spring_site_m)):
        n = site_m.shape[1]
        for k, place in enumerate(site_m[section]):
            name = f"{kind}{section * n + k}_plate{plate}"
            body.add_site(name=name, pos=position + [*place, 0.0], size=[0.001] * 3)


def _add_tools(last, params: ArmParams, spec: ArmSpec) -> None:
    """Add gripper and payload below the last plate, and the measured tip on it."""
    half = 0.5 * spec.link_length_m[-1]
    tip_m = np.subtract(params.mount.tip_offset_m, [0.0, 0.0, half])
    turn = quaternion_from_rotation(params.mount.tip_rotation)
    last.add_site(name="tip", pos=tip_m, quat=turn, size=[0.004] * 3, rgba=[0.9, 0.1, 0.1, 1.0])
    tools = zip(("gripper", "payload"), params.tool_offset_m, params.tool_mass_kg, strict=True)
    gripper, payload = (
        _add_body(last, name, -half - offset_m, mass, [mass * spec.mass.gripper_length_m**2 / 12] * 3)
        for name, offset_m, mass in tools
    )
    for box, (size, position) in gripper_boxes(spec).items():
        drawn = {"type": mujoco.mjtGeom.mjGEOM_BOX, "rgba": _GRIPPER_COLOUR, **_DRAWN_ONLY}
        gripper.add_geom(name=f"gripper_{box}", size=size, pos=position, **drawn)
    if spec.mass.payload_kg > 0:
        size = [payload_radius_m(spec.mass.payload_kg), 0.0, 0.0]
        payload.add_geom(name="payload", size=size, rgba=[0.2, 0.6, 0.25, 1.0], **_DRAWN_ONLY)


def _add_chamber(mjspec: mujoco.MjSpec, index: int, params: ArmParams, spec: ArmSpec) -> None:
    """Add a chamber's tendon and its pressure actuator.

    The actuator's force on the tendon is pressure * (a + b length): MuJoCo's affine gain.
    """
    name, section = f"chamber{index}", index // spec.structure.chambers_per_section
    tendon = mjspec.add_tendon(
        name=name,
        stiffness=(1.0 - spec.chambers.bonded_share) * params.chamber_stiffness[index],
        damping=spec.per_chamber(spec.chambers.damping_ns_per_m)[index],
        springlength=[params.chamber_rest_m[index]] * 2,
        width=_BELLOWS_DRAWN * spec.per_section(spec.geometry.chamber_diameter_m)[section],
        rgba=_SECTION_COLOURS[section % len(_SECTION_COLOURS)],
    )
    _wrap_section(tendon, section, spec)
    slope = params.area_slope[index]
    mjspec.add_actuator(
        name=name,
        target=name,
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        gaintype=mujoco.mjtGain.mjGAIN_AFFINE,
        gainprm=[params.area[index] - slope * params.section_length_m[section], slope, *[0.0] * 8],
        biastype=mujoco.mjtBias.mjBIAS_NONE,
        ctrllimited=True,
        ctrlrange=[params.pressure_min_kpa[index], params.pressure_max_kpa[index]],
    )


def _add_spring(mjspec: mujoco.MjSpec, index: int, params: ArmParams, spec: ArmSpec) -> None:
    """Add a spring's tendon."""
    section = index // spec.springs_per_section
    tendon = mjspec.add_tendon(
        name=f"spring{index}",
        stiffness=params.spring_stiffness[index],
        damping=spec.per_section(spec.springs.damping_ns_per_m)[section],
        springlength=[params.spring_rest_m[index]] * 2,
        width=SPRING_WIDTH_M,
        rgba=_SPRING_COLOUR,
    )
    _wrap_section(tendon, section, spec)


def _add_bonds(mjspec: mujoco.MjSpec, chamber: int, params: ArmParams, spec: ArmSpec) -> None:
    """Add the tendons that a chamber is from ring to ring where it is bonded; its own tendon is drawn."""
    links = spec.structure.links_per_section
    stiffness = links * spec.chambers.bonded_share * params.chamber_stiffness[chamber]
    rest_m = params.chamber_rest_m[chamber] / links
    first = chamber // spec.structure.chambers_per_section * links
    for plate in range(first, first + links):
        bond = {"stiffness": stiffness, "springlength": [rest_m] * 2, "rgba": [0.0] * 4}
        tendon = mjspec.add_tendon(name=f"bond{chamber}_{plate}", **bond)
        tendon.wrap_site(f"chamber{chamber}_plate{plate}")
        tendon.wrap_site(f"chamber{chamber}_plate{plate + 1}")


def _wrap_section(tendon: mujoco.MjsTendon, section: int, spec: ArmSpec) -> None:
    """Lead a tendon through its holes in all rings of a section."""
    links = spec.structure.links_per_section
    for plate in range(section * links, (section + 1) * links + 1):
        tendon.wrap_site(f"{tendon.name}_plate{plate}")
