"""The loop on arms of four and six chambers a section and on a tapered one; springs answer linearly."""

import numpy as np
import pytest

from mjx_softarm.deploy.belief import stuck_springs
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.drivers.names import check_arm
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.deploy.session import follow
from mjx_softarm.policy.reach import followed
from mjx_softarm.sensing.estimator import estimate
from mjx_softarm.twin.arm import Twin
from tests.arms import FOUR_CHAMBERS
from tests.linear_arm import Leaking, LinearArm, gain_of, make_policy


def controller_of(spec, spring_m):
    """A loop whose policy asks for the springs of a goal at once, whatever the goal."""
    return Controller.of(make_policy(spec), lambda pose, goal, springs_m, sensed: spring_m)


def springs_at(spec, pressure_kpa):
    return spec.at_springs(spec.geometry.section_length_m) + gain_of(spec) @ pressure_kpa


def test_goal_is_reached_and_no_pressure_is_spent_in_vain(other_arm):
    rng = np.random.default_rng(3)
    spring_m = springs_at(other_arm, rng.uniform(-15.0, 8.0, other_arm.n_chambers))
    controller = controller_of(other_arm, spring_m)
    goal = np.asarray(estimate(controller.policy.estimator, spring_m, 0.0), float)
    arm = LinearArm(spec=other_arm)
    check_arm(arm, controller, "test")
    run = follow(arm, controller, [goal])
    assert run.status == 0 and [arrival.reached for arrival in run.arrivals] == [True]
    row = run.arrivals[0].row
    assert run.log.readings.shape[1] == other_arm.n_springs
    assert run.log.pressure_kpa.shape[1] == other_arm.n_chambers
    held_m = controller.policy.sensor.lengths(run.log.readings[row]).length_m
    np.testing.assert_allclose(held_m, spring_m, atol=5e-4)
    allocation = controller.policy.gains.allocation
    if allocation is not None:
        np.testing.assert_allclose(allocation.redundant @ run.log.pressure_kpa[row], 0.0, atol=0.1)
    np.testing.assert_array_equal(arm.written[-1], 0.0)


def test_lost_chamber_is_told_from_the_springs(other_arm):
    """Its section cannot hold the references, even where others take over what they can."""
    pressure_kpa = np.zeros(other_arm.n_chambers)
    near = other_arm.structure.chambers_per_section // 3
    pressure_kpa[3 : 3 + near] = -30.0
    spring_m = springs_at(other_arm, pressure_kpa)
    controller = controller_of(other_arm, spring_m)
    goal = np.asarray(estimate(controller.policy.estimator, spring_m, 0.0), float)
    whole = follow(LinearArm(spec=other_arm), controller, [goal], stay=True, duration_s=8.0)
    assert Fault.CHAMBER_LOST not in whole.counts()
    run = follow(Leaking(100, other_arm), controller, [goal], stay=True, duration_s=20.0)
    assert run.counts()[Fault.CHAMBER_LOST] == 1
    assert "chamber lost its pressure: chamber3: at -40.0 kPa" in run.ending.cause


@pytest.mark.parametrize(
    ("saturated", "moved_mm"),
    [
        ([], [15.0, 10.0, 5.0, 10.0]),  # the plane through the references
        ([0], [15.0, 10.0, 5.0, 10.0]),  # the other three move the section alone
        ([0, 1], [2.5, -2.5, 5.0, 10.0]),  # two follow, the others move as little as these allow
        ([0, 1, 2, 3], [0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_redundant_chambers_follow_for_saturated_ones(saturated, moved_mm):
    policy, mask = make_policy(FOUR_CHAMBERS), np.isin(np.arange(12), saturated)
    mean_m, beside_m = np.full(12, 0.2), 1e-3 * np.array([1.0, -1.0, 1.0, -1.0])  # beside any plane
    asked_m = mean_m + np.append(1e-3 * np.array([15.0, 10.0, 5.0, 10.0]) + beside_m, np.zeros(8))
    got_m = followed(asked_m, mean_m, asked_m, mask, policy)
    np.testing.assert_allclose(1e3 * (got_m - mean_m), [*moved_mm, *np.zeros(8)], atol=5e-3)
    back_m = followed(mean_m - (asked_m - mean_m), mean_m, asked_m, mask, policy)  # away from the limits
    np.testing.assert_allclose(1e3 * (back_m - mean_m), [-15.0, -10.0, -5.0, -10.0, *np.zeros(8)], atol=5e-3)


def test_spring_is_stuck_if_the_chamber_beside_it_is_driven():
    """Spring 4 of the six-chamber arm stands beside chamber 8; chamber 9 has no spring."""
    spring_m = 0.2 + 1e-4 * np.random.default_rng(0).normal(size=(25, 9))
    spring_m[:, 4], pressure_kpa = 0.2, np.zeros((25, 18))
    for driven, expected in ((9, []), (8, [4])):
        pressure_kpa[:, driven] = np.linspace(0.0, 5.0, 25)
        assert np.flatnonzero(stuck_springs(spring_m, pressure_kpa, 3)).tolist() == expected
    spring_m[:, 5] += np.linspace(0.0, 3e-3, 25)  # a spring of the same section
    assert np.flatnonzero(stuck_springs(spring_m, np.zeros((25, 18)), 3)).tolist() == [4]


def test_twin_is_led_to_a_goal(other_arm):
    """Springs that a twin has at some pressures, redundant ones among them, come back under the law."""
    kpa = np.random.default_rng(0).uniform(-20.0, 0.0, other_arm.n_chambers)
    pressed, twin = Twin(1, other_arm, 0.0), Twin(1, other_arm, 0.0)
    for tick in range(150):
        pressed.write_pressures(kpa * min(1.0, tick / 50))
    spring_m = other_arm.spring_sensor.lengths(pressed.read_sensors()).length_m
    controller = controller_of(other_arm, spring_m)
    check_arm(twin, controller, "twin")
    run = follow(twin, controller, [np.asarray(estimate(controller.policy.estimator, spring_m, 0.0), float)])
    tip_m = run.log.tip_m[run.arrivals[0].row - 25 :].mean(axis=0)
    assert not run.events and np.linalg.norm(tip_m - pressed.motion_capture().tip_m) < 2e-3
