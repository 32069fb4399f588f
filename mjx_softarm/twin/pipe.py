"""The pipe around the twin: walls and containers, and the force of the walls on rings and gripper.

Walls are planks: the sides of a prism around each of the two cylinders. At their intersection both walls
end at |z - centre| = |x|, because at the same y both are equally far from their axes. The prisms lie
outside the cylinders, by 0.9 % of the radius at the edges, so a body with clearance in the pipe touches no
plank.

The arm's contact bodies are balls as wide as the rings. Near the tip a ball would reach past the gripper, so
the last rings are rounded rims instead. The arm touches the pipe, never itself.
"""

from __future__ import annotations

import itertools

import mujoco
import numpy as np

from mjx_softarm.mechanics.body import gripper_boxes, rim_points, ring_radius_m
from mjx_softarm.mechanics.pipe import CrossPipe
from mjx_softarm.spec import ArmSpec

N_PLANKS = 24  # planks around a branch; a multiple of four puts none across the plane of the two axes
THICKNESS_M = 0.04
OVERLAP_M = 0.02  # overlap of planks behind their faces: a body in a seam is pushed inwards
RIM_ROUNDING_M = 0.01
FLOOR_BELOW_M = 0.05  # height of the finger tips above a container's floor: room for an object
LEDGE_M = 0.02  # distance of the left and right floors from the crossing
END_HEIGHT_M = 0.05  # height of a side container's outer end, at the outlet, above its floor
SHEET_M = 0.02  # thickness of floors and ends
LEAST_WIDTH_M = 0.005  # half the width of a floor below which there is none

# Contacts: friction of plastics; a time constant of three time steps (MuJoCo wants two or more); impedances
# near 1, with which a wall yields to a load at rest by less than 1 mm.
FRICTION = 0.4
TIME_CONSTANT_S = 0.015
IMPEDANCE = (0.95, 0.99, 0.001, 0.5, 2.0)

WALL, CONTAINER = "wall", "container"  # prefixes of the names of geometries
_UNSEEN = 3  # group of geometries that pictures leave out
_WALL_COLOUR = [0.56, 0.58, 0.62, 1.0]
_CONTAINER_COLOURS = {
    "left": [0.25, 0.50, 0.80, 1.0],
    "right": [0.90, 0.55, 0.20, 1.0],
    "bottom": [0.35, 0.65, 0.35, 1.0],
}


def add_pipe(
    mjspec: mujoco.MjSpec, pipe: CrossPipe, spec: ArmSpec, base_m: np.ndarray, base_rotation: np.ndarray
) -> None:
    """Add a pipe to an arm's model from `build_spec`, and let the arm touch it.

    The model is in the frame of the arm's own base, at `base_m` (3,) with `base_rotation` (3, 3) in the
    base frame, which is motion capture's and the pipe's.
    """
    off = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    mjspec.option.disableflags &= ~int(off)
    mjspec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # the first force of a contact is the normal one
    mjspec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # faster, because most joints move most contacts
    for name, corner_m, colour, group in (*_walls(pipe), *_containers(pipe)):
        mesh = mjspec.add_mesh(name=name, uservert=((corner_m - base_m) @ base_rotation).ravel())
        solid = mjspec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)
        solid.rgba = colour
        solid.group = group
        _make_solid(solid, contype=1, conaffinity=0)
    _add_skin(mjspec, spec)


def _walls(pipe: CrossPipe):
    """Yield (name, corners (8, 3) [m], colour, group) of planks; pictures leave out the half with y < 0."""
    branches = {  # length, and the branch's (across, y, along) -> (x, y, z) from the centre
        "up": (pipe.top_z_m - pipe.centre_z_m, lambda a, y, s: (a, y, s)),
        "down": (pipe.branch_m, lambda a, y, s: (a, y, -s)),
        "right": (pipe.branch_m, lambda a, y, s: (s, y, a)),
        "left": (pipe.branch_m, lambda a, y, s: (-s, y, a)),
    }
    # A plank's corners across the wall, then at its two ends along the branch.
    reach = pipe.radius_m * np.tan(np.pi / N_PLANKS) + OVERLAP_M
    depth, aside = (x.ravel() for x in np.meshgrid([0.0, THICKNESS_M], [-reach, reach]))
    centre = np.array([0.0, 0.0, pipe.centre_z_m])
    for branch, (length, place) in branches.items():
        for k in range(N_PLANKS):
            angle = 2 * np.pi * (k + 0.5) / N_PLANKS
            cos, sin = np.cos(angle), np.sin(angle)
            inner = pipe.radius_m * cos - aside * sin  # across, at the plank's inner face
            across, y = inner + depth * cos, (pipe.radius_m + depth) * sin + aside * cos
            ends = np.sign(cos) * inner, np.full(4, length)
            corners = [np.stack(place(across, y, along), axis=-1) for along in ends]
            group = 0 if sin > 0.0 else _UNSEEN
            yield f"{WALL}_{branch}{k}", centre + np.concatenate(corners), _WALL_COLOUR, group


def _containers(pipe: CrossPipe):
    """Yield (name, corners (k, 3) [m], colour, group) of the floors, and of the left and right outer ends."""
    places = pipe.containers()
    # Half the width of a side's floor. In a narrow pipe the wall itself is the floor.
    width = np.sqrt(max(pipe.radius_m**2 - (pipe.drop_m + FLOOR_BELOW_M) ** 2, 0.0))
    for side in ("left", "right") if width > LEAST_WIDTH_M else ():
        outwards = np.sign(places[side][0])
        floor_z = places[side][2] - FLOOR_BELOW_M
        for part, x, z in (
            ("floor", (pipe.radius_m + LEDGE_M, pipe.branch_m), (floor_z - SHEET_M, floor_z)),
            ("end", (pipe.branch_m, pipe.branch_m + SHEET_M), (floor_z - SHEET_M, floor_z + END_HEIGHT_M)),
        ):
            corners = [[outwards * a, b, c] for a, b, c in itertools.product(x, (-width, width), z)]
            yield f"{CONTAINER}_{side}_{part}", np.array(corners), _CONTAINER_COLOURS[side], 0
    rim = rim_points(pipe.radius_m, N_PLANKS) + places["bottom"] - [0.0, 0.0, FLOOR_BELOW_M]
    plate = np.concatenate([rim, rim - [0.0, 0.0, SHEET_M]])
    yield f"{CONTAINER}_bottom_floor", plate, _CONTAINER_COLOURS["bottom"], 0


def _add_skin(mjspec: mujoco.MjSpec, spec: ArmSpec) -> None:
    """Add the arm's contact bodies: balls or rims at the rings, and the gripper's boxes."""
    for link, radius in enumerate(ring_radius_m(spec)[1:]):
        rim = rim_points(radius - RIM_ROUNDING_M)
        below = spec.link_length_m[link + 1 :].sum()  # depth of the tip below this link's ring
        ring = mjspec.geom(f"ring{link + 1}").pos
        centres, size = (ring + rim, RIM_ROUNDING_M) if below < radius else (ring[None], radius)
        for k, centre in enumerate(centres):
            ball = mjspec.body(f"link{link}").add_geom(name=f"skin{link}_{k}", size=[size, 0.0, 0.0])
            ball.pos = centre
            ball.mass = 0.0
            ball.group = _UNSEEN
            _make_solid(ball, contype=0, conaffinity=1)
    for name in gripper_boxes(spec):
        _make_solid(mjspec.geom(f"gripper_{name}"), contype=0, conaffinity=1)


def _make_solid(geom: mujoco.MjsGeom, contype: int, conaffinity: int) -> None:
    geom.contype, geom.conaffinity, geom.condim = contype, conaffinity, 3
    geom.friction[0] = FRICTION
    geom.solref, geom.solimp = [TIME_CONSTANT_S, 1.0], IMPEDANCE


def is_wall(model: mujoco.MjModel) -> np.ndarray:
    """Mask (ngeom,) the geometries of walls."""
    return np.array([model.geom(k).name.startswith(WALL) for k in range(model.ngeom)])


def contact_force_n(data: mujoco.MjData, wall: np.ndarray) -> float:
    """Return the sum of the walls' normal forces [N] in the last time step; `wall` is from `is_wall`."""
    contact = data.contact
    touched = wall[contact.geom].any(axis=1) & (contact.efc_address >= 0)
    return float(data.efc_force[contact.efc_address[touched]].sum())
