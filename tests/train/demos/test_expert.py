"""The expert's postures against C MuJoCo under the sensor-space law, and what it says when there is none."""

import itertools

import mujoco
import numpy as np
import pytest

from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.pipe import CrossPipe, body_clearance
from mjx_softarm.sensing.pose import pose_from_frame
from tests.mechanics.test_fidelity import FAST_GAINS, fast_model, stepped_to_rest
from train.demos import expert as module
from train.demos.expert import LIMIT_SHARE, MARGIN_KPA, MARGIN_M, SPRING_MARGIN_M, WAY, ExpertError
from train.demos.waypoints import FREE, SQUARE, TASKS, Waypoint, circle, task

PIPE = CrossPipe(300)


def hold(spec, reference_m):
    """C MuJoCo at rest under the sensor-space law."""
    rest, model = stepped_to_rest(fast_model(), reference_m, FAST_GAINS), build_model(spec)
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = rest.q, rest.pressure_kpa
    mujoco.mj_forward(model, data)
    return model, data


def plates(model, data, spec):
    """Positions (L + 1, 3) and rotations (L + 1, 3, 3) of the rings: half a link below each link's hinges."""
    links = slice(1, spec.n_links + 1)
    rotation = data.xmat[links].reshape(-1, 3, 3)
    position = data.xpos[links] - 0.5 * spec.link_length_m[:, None] * rotation[:, :, 2]
    return np.vstack([np.zeros((1, 3)), position]), np.concatenate([np.eye(3)[None], rotation])


def test_held_references_bring_the_arm_to_the_waypoints(spec, plan, waypoints, shift_mm):
    """Held by the law, the arm has finger tips, body and pressures as planned, and keeps all margins."""
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    for k, waypoint in enumerate(waypoints):
        model, data = hold(spec, plan.spring_m[k])
        tip_m, rotation = data.site("tip").xpos, data.site("tip").xmat.reshape(3, 3)
        finger_m = tip_m - spec.mass.gripper_length_m * rotation[:, 2]
        np.testing.assert_allclose(finger_m + 1e-3 * shift_mm, waypoint.finger_m, atol=1e-4)
        if waypoint.turn != FREE:
            np.testing.assert_allclose(rotation[:, 2], [0.0, 0.0, 1.0], atol=0.01)
        if waypoint.turn == SQUARE:
            np.testing.assert_allclose(rotation, np.eye(3), atol=0.01)
        pose = pose_from_frame(tip_m + 1e-3 * shift_mm, rotation)
        np.testing.assert_allclose(plan.pose[k], pose, atol=0.05)
        np.testing.assert_allclose(plan.pressure_kpa[k], data.ctrl, atol=0.05)
        room_kpa = np.minimum(data.ctrl - low, high - data.ctrl)
        assert room_kpa.min() > LIMIT_SHARE * MARGIN_KPA - 0.05
        room_m = np.minimum(
            plan.spring_m[k] - spec.springs.length_min_m, spec.springs.length_max_m - plan.spring_m[k]
        )
        assert room_m.min() > LIMIT_SHARE * SPRING_MARGIN_M
        position_m, turned = plates(model, data, spec)
        real_m = position_m + 1e-3 * np.linspace(0.0, 1.0, len(position_m))[:, None] * shift_mm
        clear_m = body_clearance(PIPE, real_m, turned, spec)
        assert clear_m > LIMIT_SHARE * MARGIN_M
        assert plan.clearance_m[k] == pytest.approx(clear_m, abs=2e-4)


def test_the_way_between_waypoints_is_short_and_clear(expert, plan):
    path_kpa = plan.pressure_kpa[:5]
    for before, after in itertools.pairwise(path_kpa):
        way = expert.look(np.stack([before + share * (after - before) for share in WAY]))
        assert way.clearance_m.min() > LIMIT_SHARE * MARGIN_M
    assert np.linalg.norm(np.diff(path_kpa, axis=0), axis=1).max() < 30.0  # 3 x 10 kPa


def test_look_tells_what_is_not_in_the_pipe(expert, spec):
    """Bent to one side without a thought of the wall, the arm is in it."""
    pressure_kpa = np.tile([20.0, -40.0, -40.0], 3)[None]
    posture = expert.look(pressure_kpa)
    assert posture.clearance_m[0] < -0.05 and posture.residual[0] < 2e-3


@pytest.mark.parametrize(
    ("finger_m", "message"),
    [
        ([0.4, 0.0, -0.6], r"waypoint 'far' at 400, 0, -600 mm: got at best .* mm off.* chamber \d at"),
        ([0.0, 0.13, -0.4], "waypoint 'far' .* got at best .* mm from the wall"),  # in the wall
    ],
)
def test_waypoint_that_cannot_be_met_is_named(expert, finger_m, message):
    with pytest.raises(ExpertError, match=message):
        expert.plan([Waypoint("far", np.array(finger_m))])


def test_gripper_that_cannot_hang_as_asked_hangs_a_little_otherwise(expert, spec):
    """The gripper turns where square it would meet the wall or the limits; its position is kept."""
    finger_m = np.array([0.12, 0.02, -0.66])
    found = expert.reach("edge", expert.target(Waypoint("edge", finger_m, SQUARE)), np.zeros(spec.n_chambers))
    turn = found.rotation.T - found.rotation
    turn_rad = np.linalg.norm([turn[2, 1], turn[0, 2], turn[1, 0]]) / 2
    assert module.TOLERANCE_RAD < turn_rad < module.TOLERANCE_RAD / module.EASED
    np.testing.assert_allclose(found.finger_m, finger_m, atol=5e-4)
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    assert np.minimum(found.pressure_kpa - low, high - found.pressure_kpa).min() >= LIMIT_SHARE * MARGIN_KPA
    assert found.clearance_m >= LIMIT_SHARE * MARGIN_M


def test_tasks_have_the_papers_positions(spec):
    tasks = {name: task(name, spec) for name in TASKS}
    n_waypoints = {name: len(waypoints) for name, (waypoints, _) in tasks.items()}
    assert n_waypoints == {"circle16": 16, "pipe300": 28, "pipe250": 37, "pipe200": 37}
    for name, stops in {
        "pipe300": ["pick right", "place left", "pick bottom", "place right"],
        "pipe250": ["pick left", "place bottom", "pick right", "place left"],
    }.items():
        waypoints, pipe = tasks[name]
        named = [waypoint for waypoint in waypoints if waypoint.name.startswith(("pick", "place"))]
        assert [waypoint.name for waypoint in named] == stops
        for waypoint in named:
            place = pipe.containers()[waypoint.name.split(" ")[1]]
            np.testing.assert_allclose(waypoint.finger_m, place, atol=1e-9)
        moves_m = np.linalg.norm(np.diff([waypoint.finger_m for waypoint in waypoints], axis=0), axis=1)
        assert moves_m.min() > 0.025 and moves_m.max() < 0.09


def test_circle_is_below_the_circles_poses(spec):
    for waypoint in circle(16, spec):
        assert np.hypot(*waypoint.finger_m[:2]) == pytest.approx(0.08, abs=1e-6)
        assert waypoint.finger_m[2] == pytest.approx(-0.675, abs=1e-6) and waypoint.turn == SQUARE
