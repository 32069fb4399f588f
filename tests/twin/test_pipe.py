"""The twin's pipe against the pipe's closed form, weights, and known loads in place of walls."""

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from mjx_softarm import ArmSpec
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.mechanics.drawing.render import RenderError
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.mjcf import build_spec
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.pipe import CrossPipe, body_clearance, clearance
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import Build
from mjx_softarm.twin.model import build_twin, draw_parts
from mjx_softarm.twin.pipe import CONTAINER, N_PLANKS, _walls, add_pipe, contact_force_n, is_wall
from tests.twin.conftest import KPA, hold

PIPE = CrossPipe(300.0)
R, Z = 0.15, -0.55
QUIET = Build(losses=0.0, noise=0.0)


def push(arm, body, force_n):
    arm._data.xfrc_applied[arm._model.body(body).id, :3] = force_n


def test_walls_enclose_the_pipe_without_a_hole():
    """Free points lie in no plank; points outside by 1 to 30 mm all lie in one."""
    rng = np.random.default_rng(0)
    point = np.array([0.0, 0.0, Z]) + rng.uniform(-1.0, 1.0, (60_000, 3)) * [0.29, 0.19, 0.29]
    x, y, z = (point - [0.0, 0.0, Z]).T
    vertical, horizontal = np.hypot(x, y) - R, np.hypot(z, y) - R  # outside, each
    free = clearance(PIPE, point) > 0.0
    edge = R / np.cos(np.pi / N_PLANKS) - R
    # beside the vertical pipe, or beside the horizontal one, or in the corner of both
    near = (vertical > edge) & (horizontal > edge) & (np.minimum(vertical, horizontal) < 0.03)
    solid = np.zeros(len(point), bool)
    for _, corner, _, _ in _walls(PIPE):
        faces = ConvexHull(corner).equations
        solid |= (point @ faces[:, :3].T + faces[:, 3] < 1e-9).all(axis=1)
    assert free.sum() > 10_000 and near.sum() > 5_000
    assert not solid[free].any()
    assert solid[near].all()


@pytest.mark.parametrize("diameter_mm", [300.0, 250.0])
def test_arm_touches_where_its_body_has_no_clearance(diameter_mm):
    """Bent at random, nominal; skin and planks differ from `body_clearance` by 2 mm at most."""
    parts = draw_parts(0, ArmSpec.default(), Build(gap=0.0))
    pipe, spec, rng = CrossPipe(diameter_mm), parts.spec, np.random.default_rng(0)
    section = np.concatenate(
        [rng.uniform(-0.006, 0.002, (200, 3, 1)), rng.normal(0.0, 0.018, (200, 3, 2))], -1
    )
    q = np.repeat(section, spec.structure.links_per_section, axis=1).reshape(200, -1)
    frames = jax.jit(jax.vmap(chain_kinematics(ArmParams.from_spec(spec))))(np.float32(q))
    free_m = np.asarray(body_clearance(pipe, frames.plate_position, frames.plate_rotation, spec))
    model = build_twin(parts, pipe)
    data, wall = mujoco.MjData(model), is_wall(model)
    touches = []
    for bent in q:
        data.qpos[:] = bent
        mujoco.mj_forward(model, data)
        touches.append(wall[data.contact.geom].any())
    touches = np.array(touches)
    assert (free_m > 0.002).sum() > 30 and (free_m < -0.002).sum() > 30
    assert not touches[free_m > 0.002].any() and touches[free_m < -0.002].all()


def test_pipe_stands_in_the_frame_of_the_motion_capture():
    """Not in the twin's own: its base is off and tilted."""
    arm = Twin(3, build=QUIET, pipe=PIPE)
    model, data = arm._model, arm._data
    assert np.abs(arm._parts.base_rotation - np.eye(3)).max() > 0.005
    for name, corner, _, _ in _walls(PIPE):
        geom = model.geom(name)
        mesh = model.mesh(geom.dataid[0])
        local = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
        here = data.geom_xpos[geom.id] + local @ data.geom_xmat[geom.id].reshape(3, 3).T
        there = arm._base_m + here @ arm._base_rotation.T
        gap = np.linalg.norm(there[:, None] - corner[None], axis=-1)
        assert len(there) == len(corner) == 8 and gap.min(axis=0).max() < 1e-6


def test_floors_are_below_where_the_finger_tips_pick():
    model = Twin(0, build=Build(gap=0.0), pipe=PIPE)._model
    assert sum(model.geom(k).name.startswith(CONTAINER) for k in range(model.ngeom)) == 5
    for side, at in PIPE.containers().items():
        ray, hit = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        distance = mujoco.mj_ray(model, data, at, ray, None, 1, -1, hit)
        assert model.geom(hit[0]).name == f"{CONTAINER}_{side}_floor" and distance == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("at", "share"),
    [
        # on the lowest edge between two planks of the right branch
        ((R + 0.012, 0.0, Z - R + 0.009), 1.0 / np.cos(np.pi / N_PLANKS)),
        ((0.03, 0.02, Z - R - 0.06 - 0.05 + 0.009), 0.0),  # on the bottom container's floor
    ],
)
def test_walls_carry_the_weight_of_what_lies_on_them(at, share):
    spec = ArmSpec.default()
    mjspec = build_spec(spec)
    ball = mjspec.worldbody.add_body(name="ball", pos=at)
    ball.add_freejoint()
    ball.add_geom(name="ball", size=[0.008, 0.0, 0.0], mass=2.0, conaffinity=1, contype=0)
    add_pipe(mjspec, PIPE, spec, np.zeros(3), np.eye(3))
    model = mjspec.compile()
    model.geom_friction[:] = 0.0
    data = mujoco.MjData(model)
    for _ in range(1500):
        mujoco.mj_step2(model, data)
        force_n = contact_force_n(data, is_wall(model))
        mujoco.mj_step1(model, data)
    assert force_n == pytest.approx(2.0 * 9.81 * share, rel=2e-3, abs=1e-9)


@pytest.mark.parametrize("direction", [[0.0, 1.0, 0.0], [0.6, 0.8, 0.0], [1.0, 0.0, 0.0]])
def test_gripper_pressed_against_the_wall(direction):
    """By 20 N within 2 s; the third direction leads into a branch, and the arm against its edge."""
    arm, deepest_m = Twin(3, build=QUIET, pipe=PIPE), []
    for k in range(300):
        push(arm, "gripper", min(1.0, k / 100) * 20.0 * np.array(direction))
        hold(arm, 0.0, 0.02)
        deepest_m.append(-arm._data.contact.dist.min() if arm._data.ncon else 0.0)
    assert max(deepest_m) < 5e-3 and deepest_m[-1] < 1e-3
    assert 10.0 < arm.wall_force_n < 25.0


def test_force_is_that_of_the_last_period():
    arm = Twin(3, build=QUIET, pipe=PIPE)
    assert arm.wall_force_n == 0.0
    push(arm, "link14", [0.0, 30.0, 0.0])
    hold(arm, 0.0, 0.8)
    assert arm.wall_force_n > 1.0
    push(arm, "link14", 0.0)
    hold(arm, 0.0, 4.0)
    assert arm.wall_force_n == 0.0


def test_arm_that_touches_nothing_moves_as_without_a_pipe():
    tips_m = []
    for pipe in (None, PIPE):
        arm = Twin(7, build=Build(noise=0.0), pipe=pipe)
        hold(arm, KPA, 3.0)
        assert arm.wall_force_n == 0.0
        tips_m.append(arm.motion_capture().tip_m)
    np.testing.assert_allclose(*tips_m, atol=1e-9)


def test_survives_random_extremes_in_the_pipe():
    """Chambers at their limits, redrawn at random; only arm and pipe touch, and the arm stays inside."""
    pipe = CrossPipe(250.0)
    arm, rng, touched = Twin(0, pipe=pipe), np.random.default_rng(0), 0
    while arm.time_s < 16.0:
        arm.attach(rng.choice([0.0, 0.22]))
        ahead = np.cos(2 * np.pi * (np.arange(9) / 3 - rng.random()))  # bend to one side
        for _ in range(rng.integers(10, 100)):
            arm.write_pressures(np.where(ahead > 0.0, -40.0, 20.0))
            contact, bodies = arm._data.contact, arm._model.geom_bodyid[arm._data.contact.geom]
            touched += arm._data.ncon > 0
            assert ((bodies == 0).sum(axis=1) == 1).all()
            assert arm._data.ncon == 0 or contact.dist.min() > -0.02
            assert (clearance(pipe, arm.motion_capture().marker_m) > 0.04).all()
            assert np.isfinite(arm.wall_force_n).all()
    assert touched > 100


def test_arms_in_pipes_by_name():
    arm = open_arm("twin:7:pipe250")
    assert arm._pipe == CrossPipe(250.0) and open_arm("twin:7")._pipe is None
    in_pipe, loaded = open_arm("twin:7:pipe300"), open_arm("twin:7:pipe300:220g")
    assert in_pipe.wall_force_n == 0.0
    assert loaded.motion_capture().tip_m[2] < in_pipe.motion_capture().tip_m[2] - 1e-3
    # Floors of 200 mm would have no width, and MuJoCo compiles none on some twins
    assert all(open_arm(f"twin:{seed}:pipe200").wall_force_n == 0.0 for seed in (1, 4))


def test_picture_shows_what_the_arm_holds_in_the_pipe():
    arm = Twin(0, build=Build(gap=0.0), pipe=PIPE)
    try:
        with arm.renderer(140, 180) as renderer:
            hanging = arm.draw(renderer).astype(int)
            arm.attach(0.22)
            holding = arm.draw(renderer).astype(int)
    except RenderError as error:
        pytest.skip(str(error))
    assert 10 < (np.abs(holding - hanging).max(axis=-1) > 40).sum() < 400  # the ball alone
