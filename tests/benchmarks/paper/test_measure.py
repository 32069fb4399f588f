"""Errors, saturation, contact forces, picking and placing, and the figures of a trial, by hand."""

import numpy as np
import pytest

from benchmarks.harness.parallel import JobError
from benchmarks.paper.engine import load_arrays, save_arrays
from benchmarks.paper.measure import (
    GRASP_M,
    PACE_S,
    PLACE_M,
    Gripper,
    TrialOutcome,
    figures,
    finger_tips,
    measure,
    operate,
)
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.ending import Ending
from mjx_softarm.deploy.safety import Event, Fault
from mjx_softarm.deploy.session import Arrival, LoopRun
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.mechanics.pipe import APPLE_KG, BALL_KG
from mjx_softarm.sensing.estimator import estimate
from mjx_softarm.sensing.pose import frame_from_pose
from tests.benchmarks.paper.made_up import GRIPPER_M, SPEC, N, made_up, make_policy
from tests.linear_arm import CONTROLLER, FAR, GOALS, POLICY, LinearArm

DOWN = np.array([1.0, 0.0, 0.0, 0.0])  # quaternion of a gripper that hangs straight
NAMES = ("home", "pick right", "to place left 1", "place left", "pick bottom", "place right")
GOALS_M = np.array([[0, 0, -6], [2, 0, -6], [0, 0, -6], [-2, 0, -6], [0, 0, -8], [2, 0, -6]]) / 10


def test_errors_are_averaged_over_the_window_of_rest(make_arm_model):
    policy = make_policy(make_arm_model)
    controller = Controller.of(policy)
    window, n_rows = controller.window, 3 * controller.window
    goals = circle_poses(SPEC, 2).astype(float)
    tip_mm = np.tile(goals[1, :3] + [3.0, 4.0, 0.0], (n_rows, 1))
    tip_mm[:-window] += 500.0  # on its way: does not count
    noise = np.where(np.arange(window) % 2, 1.0, -1.0)
    tip_mm[-window:, 2] += noise - noise.mean()
    pressure_kpa = np.zeros((n_rows, N))
    pressure_kpa[:, 4], pressure_kpa[:, 5] = 19.97, -40.0
    spring_m, reference_m = np.full((n_rows, N), 0.2), np.full((n_rows, N), 0.2)
    reference_m[:, 4] += 0.005  # asked for longer than the greatest pressure makes it
    reference_m[:, 5] -= 0.0005  # within the tolerance
    reference_m[:, 6] += 0.005  # off, but not at a limit
    log = Log(
        source="made up",
        row=np.arange(n_rows),
        time_s=0.02 * np.arange(n_rows),
        readings=policy.sensor.readings(spring_m),
        pressure_kpa=pressure_kpa,
        tip_m=1e-3 * tip_mm,
        tip_quaternion=np.tile([np.cos(np.radians(5)), 0, 0, np.sin(np.radians(5))], (n_rows, 1)),
        reference_m=reference_m,
        goal=np.tile(goals[1], (n_rows, 1)),
        load_kg=np.linspace(0.0, 0.5, n_rows),
    )
    arrival = Arrival(goals[1], goals[1] + [1.0, 0, 0, 0, 0, 0], n_rows - 1, 1)
    events = (Event(Fault.SATURATED, ""), Event(Fault.SATURATED, ""))
    run = LoopRun(log, (arrival,), events, np.array([1e-4] * 10), Ending())
    outcome = measure(run, controller, goals)
    assert np.allclose(outcome.error[1], [3, 4, 0, 10, 0, 0], atol=1e-6)
    assert np.isnan(outcome.error[0]).all() and np.isnan(outcome.arrival_s[0])
    assert np.isclose(outcome.arrival_s[1], 0.02 * (n_rows - 1))
    assert np.isnan(outcome.load_estimate_g[0]) and outcome.load_estimate_g[1] == 500.0
    assert np.flatnonzero(outcome.saturated[1]).tolist() == [4]
    assert not outcome.saturated[0].any()
    row = figures(outcome)
    assert (row["measured"], row["points"], row["saturation_events"]) == (1, 2, 2)
    assert np.isclose(row["believed_mm"], 1.0) and row["load_estimate_g"] == 500.0


class Still(LinearArm):
    """An arm whose tip is always seen in one place."""

    def motion_capture(self):
        return Capture(np.zeros(3), DOWN, np.zeros((0, 3)))

    def tip(self):
        return np.zeros(3), np.eye(3)


def test_an_arm_in_motion_passes_what_is_on_its_way():
    names, goals = ["home", "to pick right 1", "to pick right 2", "pick right"], GOALS[[0, 1, 1, 0]]
    stopping, moving = (operate(Still(), CONTROLLER, goals, names, moves=moves) for moves in (False, True))
    assert stopping.name.tolist() == names and moving.name.tolist() == ["home", "pick right"]
    assert np.isfinite(moving.arrival_s).all()
    assert moving.arrival_s[1] - moving.arrival_s[0] > 3 * PACE_S
    assert moving.time_s[-1] < stopping.time_s[-1]
    cut = operate(
        Still(), CONTROLLER, goals[:3], names[:3], moves=True
    )  # the last goal is a stop whatever its name
    assert cut.name.tolist() == [names[0], names[2]] and np.isfinite(cut.arrival_s).all()


def test_goals_that_are_all_refused_are_told():
    with pytest.raises(InputError, match="goals: got 1 and no tick of the loop: all were refused"):
        operate(Still(), CONTROLLER, np.array([FAR]), ["home"])


def test_figures_of_a_circle_by_hand():
    outcome = made_up("with", saturated=[(0, 1), (0, 2), (1, 2)], missed=range(2, 6))
    outcome.error[:2] = [[3, 4, 0, 1, -2, 0], [0, 0, 1, -3, 0, 3]]
    row = figures(outcome)
    assert np.isclose(row["translation_mm"], 3.0)
    assert np.isclose(row["rmse_mm"], np.sqrt(13.0))
    assert row["max_mm"] == 5.0
    assert (row["yaw_deg"], row["pitch_deg"], row["roll_deg"]) == (2.0, 1.0, 1.5)
    assert (row["saturated_points"], row["saturated_chambers_max"]) == (2, 2)
    assert (row["measured"], row["points"], row["operations"]) == (2, 6, 0)


def test_figures_of_a_task_by_hand():
    outcome = made_up("pipe", (1.0, -2.0, 2.0), reported=3, fails=(3,), pressed=0.03, missed=(1, 2, 3))
    outcome.error[0, :3] = 4.0, 0.0, 0.0
    row = figures(outcome)
    assert (row["points"], row["measured"], row["operations"], row["done"]) == (28, 25, 4, 3)
    assert np.allclose([row["x_mm"], row["y_mm"], row["z_mm"]], [28 / 25, 48 / 25, 48 / 25])
    assert np.isclose(row["translation_mm"], (4 + 24 * 3) / 25)
    assert np.isclose(row["calm_percent"], 97.0)
    assert row["wall_max_n"] == 2.0
    assert row["events"] == {Fault.SATURATED.value: 3}


def test_outcome_comes_back_from_its_file(tmp_path):
    outcome = made_up("pipe", saturated=[(0, 3)], fails=(1,), missed=(2,))
    save_arrays(tmp_path / "run.npz", outcome)
    for name, value in load_arrays(TrialOutcome, tmp_path / "run.npz")._asdict().items():
        expected = getattr(outcome, name)
        assert np.array_equal(value, expected, equal_nan=value.dtype.kind == "f"), name
    np.savez(tmp_path / "run.npz", told_g=0.0)  # of an older version
    with pytest.raises(JobError, match=r"run.npz: got no .*load_estimate_g.*, expected the arrays"):
        load_arrays(TrialOutcome, tmp_path / "run.npz")


def test_finger_tips_are_below_the_tip():
    pose = np.array([[100.0, 0, -500, 0, 0, 0], [0, 0, -500, 0, 90, 0]])
    expected = [[0.1, 0.0, -0.5 - GRIPPER_M], [-GRIPPER_M, 0.0, -0.5]]  # pitch 90: z points along +x
    assert np.allclose(finger_tips(pose, GRIPPER_M), expected)


class Arm:
    """An arm whose finger tips are where one puts them."""

    def __init__(self):
        self.finger_m, self.did = np.zeros(3), []

    def tip(self):
        return self.finger_m + [0.0, 0.0, GRIPPER_M], np.eye(3)

    def attach(self, kg):
        self.did.append(kg)

    def release(self):
        self.did.append("release")


def gripped(off_m, objects="as shown", skip=(), order=range(6)):
    """Success and deeds of a gripper, once at the goals in an order; `off_m` has how far off, if it is.

    It is lifted after each goal.
    """
    arm, order = Arm(), list(order)
    gripper = Gripper(arm, [NAMES[k] for k in order], GOALS_M[order], objects, GRIPPER_M)
    for at, k in enumerate(order):
        arm.finger_m = GOALS_M[k] + [0.0, off_m.get(at, 0.0), 0.0]
        if k not in skip:
            gripper.arrived(at)
        arm.finger_m = arm.finger_m + [0.0, 0.0, 0.1]
        gripper.driven()
    return gripper.success.tolist(), arm.did


ALL = [False, True, False, True, True, True]


def test_objects_are_picked_and_placed():
    assert gripped({}) == (ALL, [BALL_KG, "release", APPLE_KG, "release"])
    assert gripped({}, "exchanged") == (ALL, [APPLE_KG, "release", BALL_KG, "release"])
    near = {1: 0.99 * GRASP_M, 3: 0.99 * PLACE_M}
    assert gripped(near) == (ALL, [BALL_KG, "release", APPLE_KG, "release"])


def test_object_out_of_reach_stays_where_it_is():
    missed = [False, False, False, False, True, True]
    assert gripped({1: 1.01 * GRASP_M}) == (missed, [APPLE_KG, "release"])
    assert gripped({}, skip=(1,)) == (missed, [APPLE_KG, "release"])


def test_object_released_beside_its_place_is_lost():
    beside = [False, True, False, False, True, True]
    assert gripped({3: 1.01 * PLACE_M}) == (beside, [BALL_KG, "release", APPLE_KG, "release"])


def test_full_gripper_picks_nothing_else():
    success, did = gripped({}, skip=(3,))  # the ball comes to the bottom, and ends where the apple should
    assert success == [False, True, False, False, False, True]
    assert did == [BALL_KG, "release"]


@pytest.mark.parametrize(
    "name, off_m, hung_kg",
    [
        ("pick right", (0.0, 0.0, 0.0), 0.0),  # the floor carries the ball where it is picked
        ("place left", (0.0, 0.0, 0.0), 0.0),  # and where it is to be placed
        ("place left", (0.0, 0.0, 0.001), 0.022),  # an apple sinks in by 10 mm, so 1 mm carries 22 g
        ("place left", (0.0, 0.0, 0.05), BALL_KG),  # above the floor
        ("place left", (0.0, 0.0, -0.01), 0.0),
        ("place left", (1.1 * PLACE_M, 0.0, 0.0), BALL_KG),  # beside it
        ("home", (0.0, 0.0, -0.01), BALL_KG),  # there is no floor
    ],
)
def test_a_container_s_floor_carries_the_object_before_the_gripper_opens(name, off_m, hung_kg):
    arm = Arm()
    gripper = Gripper(arm, NAMES, GOALS_M, "as shown", GRIPPER_M)
    arm.finger_m = GOALS_M[1]
    gripper.driven()
    assert not arm.did  # nothing is held
    gripper.arrived(1)
    arm.finger_m = GOALS_M[NAMES.index(name)] + off_m
    gripper.driven()
    assert arm.did == ([pytest.approx(hung_kg, abs=1e-9)] if hung_kg else [])
    n = len(arm.did)
    gripper.driven()  # the mass is as before
    assert len(arm.did) == n


class Grasping(Still):
    """An arm whose tip is where its springs put it, and which notes what hangs there."""

    def __init__(self):
        super().__init__()
        self.hung_kg = []

    def tip(self):
        return frame_from_pose(estimate(POLICY.estimator, self.spring_m, 0.0).astype(float))

    def attach(self, kg):
        self.hung_kg.append(kg)

    def release(self):
        self.hung_kg.append(0.0)


def test_an_arm_on_its_way_carries_what_it_holds():
    names, goals = ["pick right", "to place left 1", "place left"], GOALS[[0, 1, 0]]
    outcome = operate(arm := Grasping(), CONTROLLER, goals, names, "as shown")
    assert outcome.success.tolist() == [True, False, True]
    assert max(arm.hung_kg) == BALL_KG and arm.hung_kg[-1] == 0.0
