"""Posture: arms that hang, lie and stand are described, observed and distinguished as they point."""

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.mdp.observation import POSE, ObsScale, observe
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.body import chamber_directions, shape
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.posture import base_rotation, hangs, posture, straight_pose
from mjx_softarm.sensing.pose import pose_from_frame, rotation_about
from mjx_softarm.spec import SpecError

SPEC = ArmSpec.default()
TURNS_DEG = {"lies": (90.0, 0.0, 0.0), "stands": (180.0, 0.0, 0.0), "aslant": (120.0, 30.0, 0.0)}


def turned(turn_deg):
    return SPEC.replace(mounting={"base_turn_deg": turn_deg})


def test_an_arm_that_stands_points_up_and_its_circle_is_above_its_base():
    spec = turned((180.0, 0.0, 0.0))
    np.testing.assert_allclose(straight_pose(spec), [0, 0, 600, 0, 0, 180], atol=1e-9)
    np.testing.assert_allclose(circle_poses(spec)[:, 2:], np.tile([575.0, 0, 0, 180], (40, 1)), atol=1e-4)


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (4.0, -3.0, 0.0), (0.0, 0.0, 90.0)])
def test_a_base_that_is_a_little_off_changes_neither_circle_nor_scale(turn_deg):
    spec = turned(turn_deg)
    assert hangs(spec)
    np.testing.assert_array_equal(posture(spec), np.eye(3))
    np.testing.assert_array_equal(circle_poses(spec), circle_poses(SPEC))
    np.testing.assert_allclose(straight_pose(spec), [0, 0, -600, 0, 0, 0], rtol=1e-12)


@pytest.mark.parametrize("turn_deg", TURNS_DEG.values(), ids=TURNS_DEG)
def test_small_motions_of_the_tip_are_small_changes_of_the_observation(turn_deg):
    spec = turned(turn_deg)
    scale, goal = ObsScale.from_spec(spec), straight_pose(spec)
    for axis_rad in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]):
        pose = pose_from_frame(1e-3 * goal[:3], rotation_about(axis_rad) @ posture(spec))
        seen = observe(pose, goal, scale, RewardConfig())[POSE]
        assert np.abs(seen).max() < 3e-3


@pytest.mark.parametrize("turn_deg", TURNS_DEG.values(), ids=TURNS_DEG)
def test_the_drawn_arm_goes_from_its_base_to_its_tip(turn_deg):
    spec = turned(turn_deg)
    rings = shape(spec, np.full(9, 0.2), np.full(6, np.nan)).rings
    np.testing.assert_allclose(1e3 * rings.position_m[-1], straight_pose(spec)[:3], atol=1e-6)


@pytest.mark.parametrize("turn_deg", [(0.0, 90.0, 0.0), (0.0, -90.0, 0.0)])
def test_a_straight_tip_in_gimbal_lock_is_refused_with_another_turn_of_the_same_arm(turn_deg):
    with pytest.raises(SpecError, match="base_turn_deg: got .* pitch of -?90 deg") as caught:
        ArmParams.from_spec(turned(turn_deg))
    text = str(caught.value)
    other = tuple(map(float, text[text.index("has [") + 5 : text.index("]")].split(",")))
    more_deg = float(text[text.index("], and ") + 7 :].split()[0])
    spec = SPEC.replace(
        mounting={"base_turn_deg": other},
        geometry={"first_chamber_deg": SPEC.geometry.first_chamber_deg + more_deg},
    )
    same, refused = (
        base_rotation(arm)[:, :2] @ chamber_directions(arm).reshape(-1, 2).T
        for arm in (spec, turned(turn_deg))
    )
    np.testing.assert_allclose(same, refused, atol=1e-6)
