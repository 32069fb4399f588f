"""A trial by hand: errors, saturation, picking and placing, and laps without a stop."""

import numpy as np
import pytest

from benchmarks.paper.trial import GRASP_M, PACE_S, PLACE_M, Gripper, finger_tips, force_figures, operate
from benchmarks.paper.trials import Trial
from mjx_softarm import ArmSpec
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.mechanics.pipe import APPLE_KG, BALL_KG
from mjx_softarm.sensing.estimator import estimate
from mjx_softarm.sensing.pose import frame_from_pose
from tests.linear_arm import CONTROLLER, FAR, GOALS, POLICY, LinearArm

GRIPPER_M = ArmSpec.default().mass.gripper_length_m
DOWN = np.array([1.0, 0.0, 0.0, 0.0])  # quaternion of a gripper that hangs straight
NAMES = ("home", "pick right", "to place left 1", "place left", "pick bottom", "place right")
GOALS_M = np.array([[0, 0, -6], [2, 0, -6], [0, 0, -6], [-2, 0, -6], [0, 0, -8], [2, 0, -6]]) / 10
PIPE = Trial("pipe", 0, 0, "as shown")


class Rod(LinearArm):
    """An arm whose tip is always seen in one place. It does not say where its tip truly is."""

    def motion_capture(self):
        return Capture(np.zeros(3), DOWN, np.zeros((0, 3)))


class Still(Rod):
    """An arm whose tip is always seen in one place, and is there."""

    def tip(self):
        return np.zeros(3), np.eye(3)


def test_an_arm_in_motion_passes_positions_on_its_way():
    names, goals = ["home", "to pick right 1", "to pick right 2", "pick right"], GOALS[[0, 1, 1, 0]]
    stopping, moving = (
        operate(Still(), CONTROLLER, goals, names, Trial("pipe", 0, 0, moves=moves))[0]
        for moves in (False, True)
    )
    assert (stopping["points"], moving["points"], moving["measured"]) == (4, 2, 2)
    assert 3 * PACE_S < moving["seconds"] < stopping["seconds"]


def test_a_lap_in_time_has_distances_from_the_goal_that_moves():
    goals = GOALS[[0, 1, 0]]
    row, log = operate(Still(), CONTROLLER, goals, [""] * 3, Trial("with", 0, 0, lap_s=4.0))
    assert row["points"] == 2 and row["seconds"] == log.time_s[-1]
    # The tip is seen at the origin, so its distance is that of the goal from there.
    away_mm = np.linalg.norm(log.goal[np.isfinite(log.goal[:, 0]), :3], axis=1)
    assert away_mm.min() < row["way_mm"] < row["way_max_mm"] <= away_mm.max() + 1e-6
    still, _ = operate(Still(), CONTROLLER, goals, [""] * 3, Trial("with", 0, 0, load_g=30))
    assert "way_mm" not in still and np.shape(still["at_stops"]["error"]) == (3, 6)
    assert still["load_off_g"] == pytest.approx(abs(still["load_estimate_g"] - 30.0))


def test_a_rod_is_measured_at_all_goals():
    row, _ = operate(Rod(), CONTROLLER, GOALS[[0, 1]], [""] * 2, Trial("with", 0, 0))
    assert row["measured"] == row["points"] == 2


def test_goals_that_are_all_refused_end_a_trial():
    with pytest.raises(InputError, match="goals: got 1 and no tick of the loop: all were refused"):
        operate(Still(), CONTROLLER, np.array([FAR]), ["home"], PIPE)


def test_figures_of_forces_and_operations_by_hand():
    operates, success = np.array([True, True, False]), np.array([True, False, False])
    wall_n = np.where(np.arange(100) < 3, 2.0, 0.0)
    figures = {"operations": 2, "done": 1, "calm_percent": 97.0, "wall_max_n": 2.0}
    assert force_figures(wall_n, operates, success) == figures


def test_finger_tips_are_below_the_tip():
    pose = np.array([[100.0, 0, -500, 0, 0, 0], [0, 0, -500, 0, 90, 0]])
    expected = [[0.1, 0.0, -0.5 - GRIPPER_M], [-GRIPPER_M, 0.0, -0.5]]  # pitch 90: z points along +x
    assert np.allclose(finger_tips(*frame_from_pose(pose), GRIPPER_M), expected)


class Arm:
    """An arm whose finger tips are where one puts them."""

    def __init__(self):
        self.finger_m, self.did = np.zeros(3), []

    def tip(self):
        return self.finger_m + [0.0, 0.0, GRIPPER_M], np.eye(3)

    def attach(self, kg):
        self.did.append(kg)


ALL = [False, True, False, True, True, True]
BOTH = [BALL_KG, 0.0, APPLE_KG, 0.0]


@pytest.mark.parametrize(
    ("off_m", "objects", "skip", "success", "did"),
    [
        ({}, "as shown", (), ALL, BOTH),
        ({}, "exchanged", (), ALL, [APPLE_KG, 0.0, BALL_KG, 0.0]),
        ({1: 0.99 * GRASP_M, 3: 0.99 * PLACE_M}, "as shown", (), ALL, BOTH),
        # Out of reach, or not arrived at, it stays where it is.
        ({1: 1.01 * GRASP_M}, "as shown", (), [False] * 4 + [True] * 2, [APPLE_KG, 0.0]),
        ({}, "as shown", (1,), [False] * 4 + [True] * 2, [APPLE_KG, 0.0]),
        # Released beside its place it is lost.
        ({3: 1.01 * PLACE_M}, "as shown", (), [False, True, False, False, True, True], BOTH),
        # A full gripper picks nothing else: the ball ends where the apple should.
        ({}, "as shown", (3,), [False, True, False, False, False, True], [BALL_KG, 0.0]),
    ],
)
def test_objects_are_picked_and_placed(off_m, objects, skip, success, did):
    arm = Arm()
    gripper = Gripper(arm, NAMES, GOALS_M, objects, GRIPPER_M)
    for k, goal_m in enumerate(GOALS_M):
        arm.finger_m = goal_m + [0.0, off_m.get(k, 0.0), 0.0]
        if k not in skip:
            gripper.operate(k)
        arm.finger_m = arm.finger_m + [0.0, 0.0, 0.1]  # lifted
        gripper.hang()
    assert (gripper.success.tolist(), arm.did) == (success, did)


@pytest.mark.parametrize(
    "name, off_m, hung_kg",
    [
        ("pick right", (0.0, 0.0, 0.0), 0.0),  # the floor carries the ball where it is picked
        ("place left", (0.0, 0.0, 0.0), 0.0),  # and where it is to be placed
        ("place left", (0.0, 0.0, 0.001), 0.022),  # an apple sinks in by 10 mm, so 1 mm carries 22 g
        ("place left", (0.0, 0.0, 0.05), BALL_KG),  # above the floor
        ("place left", (1.1 * PLACE_M, 0.0, 0.0), BALL_KG),  # beside it
        ("home", (0.0, 0.0, -0.01), BALL_KG),  # there is no floor
    ],
)
def test_a_container_s_floor_carries_the_object_before_the_gripper_opens(name, off_m, hung_kg):
    arm = Arm()
    gripper = Gripper(arm, NAMES, GOALS_M, "as shown", GRIPPER_M)
    arm.finger_m = GOALS_M[1]
    gripper.operate(1)
    arm.finger_m = GOALS_M[NAMES.index(name)] + off_m
    gripper.hang()
    gripper.hang()  # the mass is as before
    assert arm.did == ([pytest.approx(hung_kg, abs=1e-9)] if hung_kg else [])


class Grasping(Still):
    """An arm whose tip is where its springs put it, and which notes what hangs there."""

    def __init__(self):
        super().__init__()
        self.hung_kg = []

    def tip(self):
        return frame_from_pose(estimate(POLICY.estimator, self.spring_m, 0.0).astype(float))

    def attach(self, kg):
        self.hung_kg.append(kg)


def test_an_arm_on_its_way_carries_what_it_holds():
    names, goals = ["pick right", "to place left 1", "place left"], GOALS[[0, 1, 0]]
    row, _ = operate(arm := Grasping(), CONTROLLER, goals, names, PIPE)
    assert (row["operations"], row["done"]) == (2, 2)
    assert max(arm.hung_kg) == BALL_KG and arm.hung_kg[-1] == 0.0
