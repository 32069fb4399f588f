"""Picking and placing, and the figures of a run, by hand; a policy operates a twin."""

from types import SimpleNamespace

import numpy as np

from benchmarks.paper.confined_measure import (
    GRASP_M,
    PLACE_M,
    THINGS_KG,
    Hands,
    figures,
    finger_tips,
    load_operated,
    operate,
    save_operated,
)
from benchmarks.paper.measure import Driven
from mjx_softarm.deploy.loop import Controller
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.pipe import APPLE_KG, BALL_KG
from mjx_softarm.mechanics.workspace import circle_poses
from mjx_softarm.policy.file import policy_from_actor
from mjx_softarm.twin.arm import Twin
from tests.benchmarks.paper.confined_runs import DOWN, GRIPPER_M, SPEC, N, made_up, pressing

NAMES = ("home", "pick right", "to place left 1", "place left", "pick bottom", "place right")


class Arm:
    """An arm whose finger tips are where one puts them."""

    def __init__(self):
        self.finger_m, self.did = np.zeros(3), []

    def motion_capture(self):
        return SimpleNamespace(tip_m=self.finger_m + [0.0, 0.0, GRIPPER_M], tip_quaternion=DOWN)

    def attach(self, kg):
        self.did.append(kg)

    def release(self):
        self.did.append("release")


GOALS_M = np.array([[0, 0, -6], [2, 0, -6], [0, 0, -6], [-2, 0, -6], [0, 0, -8], [2, 0, -6]]) / 10


def hands_after(off_m, objects="as shown", skip=()):
    """The hands and their arm, once at all positions but some; `off_m` has how far off, if it is."""
    arm = Arm()
    hands = Hands(arm, NAMES, GOALS_M, objects, GRIPPER_M)
    for k, goal_m in enumerate(GOALS_M):
        arm.finger_m = goal_m + [0.0, off_m.get(k, 0.0), 0.0]
        if k not in skip:
            hands.arrived(k)
    return hands.success.tolist(), arm.did


ALL = [False, True, False, True, True, True]


def test_things_are_taken_and_let_go():
    assert hands_after({}) == (ALL, [BALL_KG, "release", APPLE_KG, "release"])
    assert hands_after({}, "exchanged") == (ALL, [APPLE_KG, "release", BALL_KG, "release"])
    near = {1: 0.99 * GRASP_M, 3: 0.99 * PLACE_M}
    assert hands_after(near) == (ALL, [BALL_KG, "release", APPLE_KG, "release"])


def test_thing_out_of_reach_stays_where_it_is():
    missed = [False, False, False, False, True, True]
    assert hands_after({1: 1.01 * GRASP_M}) == (missed, [APPLE_KG, "release"])
    assert hands_after({}, skip=(1,)) == (missed, [APPLE_KG, "release"])


def test_thing_let_go_beside_its_place_is_lost():
    beside = [False, True, False, False, True, True]
    assert hands_after({3: 1.01 * PLACE_M}) == (beside, [BALL_KG, "release", APPLE_KG, "release"])


def test_full_hands_take_nothing_else():
    success, did = hands_after({}, skip=(3,))  # the ball comes to the bottom, and ends where the apple should
    assert success == [False, True, False, False, False, True]
    assert did == [BALL_KG, "release"]


def test_thing_lies_where_it_was_let_go():
    arm = Arm()
    hands = Hands(arm, ("pick right", "place left", "pick left"), GOALS_M[[1, 3, 3]], "as shown", GRIPPER_M)
    hands._lying.pop("left")  # as if there were one thing alone
    for k, off_m in enumerate((0.0, 0.03, 0.0)):
        arm.finger_m = GOALS_M[[1, 3, 3]][k] + [0.0, off_m, 0.0]
        hands.arrived(k)
    assert hands.success.tolist() == [True, True, False]  # 30 mm from there


def test_forces_of_every_tick_are_noted():
    ticks = iter([(0.0, 1.0), (2.0, 0.0)])
    twin = SimpleNamespace(write_pressures=lambda p: None, wall_force_n=lambda: next(ticks), time_s=3.0)
    forces = []
    driven = Driven(twin, lambda: forces.append(twin.wall_force_n()))
    for _ in range(2):
        driven.write_pressures(np.zeros(N))
    assert forces == [(0.0, 1.0), (2.0, 0.0)]
    assert driven.time_s == 3.0


def test_finger_tips_are_below_the_tip():
    pose = np.array([[100.0, 0, -500, 0, 0, 0], [0, 0, -500, 0, 90, 0]])
    expected = [[0.1, 0.0, -0.5 - GRIPPER_M], [-GRIPPER_M, 0.0, -0.5]]  # pitch 90: z points along +x
    assert np.allclose(finger_tips(pose, GRIPPER_M), expected)


def test_figures_of_a_run_by_hand():
    run = pressing(made_up("pipe", (1.0, -2.0, 2.0), fails=(3,)), 0.03, 7.5)
    run.error[0, :3] = 4.0, 0.0, 0.0
    run.error[1:4] = np.nan
    run.saturated[5, [1, 2]] = True
    row = figures(run)
    assert (row["positions"], row["reached"], row["operations"], row["done"]) == (28, 25, 4, 3)
    assert np.allclose([row["x_mm"], row["y_mm"], row["z_mm"]], [28 / 25, 48 / 25, 48 / 25])
    assert np.isclose(row["translation_mm"], (4 + 24 * 3) / 25)
    assert (row["max_mm"], row["saturated_positions"]) == (4.0, 1)
    assert np.isclose(row["calm_percent"], 97.0)
    assert (row["wall_max_n"], row["container_max_n"]) == (7.5, 5.0)
    assert row["events"] == {"not settled": 3}


def test_run_without_an_arrival_has_no_error():
    run = made_up("pipe")
    run.error[:] = np.nan
    row = figures(run)
    assert np.isnan(row["x_mm"]) and np.isnan(row["max_mm"]) and row["reached"] == 0


def test_result_comes_back_from_its_file(tmp_path):
    run = made_up("pipe", fails=(1,))
    save_operated(tmp_path / "run.npz", run)
    for name, value in load_operated(tmp_path / "run.npz")._asdict().items():
        assert np.array_equal(value, getattr(run, name)), name


def test_policy_operates_a_twin(make_arm_model):
    """A policy whose actor always asks for the middle of its range picks what happens to lie there."""
    dense = {"head": {"kernel": np.zeros((18, 2 * N)), "bias": np.zeros(2 * N)}}
    goals = circle_poses(1).astype(float)
    everywhere = np.float32(np.random.default_rng(0).uniform(-1e4, 1e4, (50, 6)))  # so no goal is refused
    model = make_arm_model(N)._replace(workspace=everywhere)
    policy = policy_from_actor({"params": dense}, SPEC, RewardConfig(), model, {})
    run = operate(Twin(0), Controller.of(policy), goals, ["pick right"], "as shown")
    assert run.operation.tolist() == [True] and run.success.tolist() == [False]
    assert len(run.wall_n) == len(run.container_n) == len(run.finger_m) == len(run.time_s)
    assert not run.wall_n.any()
    at = round(run.arrival_s[0] / 0.02)
    tip = goals[0] + run.error[0]
    assert np.allclose(run.finger_m[at], finger_tips(tip, GRIPPER_M), atol=2e-3)
    twin = Twin(0)
    run = operate(twin, Controller.of(policy), np.array([tip]), ["pick right"], "exchanged")
    assert not np.isnan(run.arrival_s).any()
    assert run.success.tolist() == [True] and np.linalg.norm(run.error[0, :3]) < 3.0
    assert twin._model.body("payload").mass[0] == THINGS_KG["exchanged"][0]
