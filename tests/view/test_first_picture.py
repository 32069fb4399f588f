"""The first picture: the twin of the view's default, moved by the policy that ships for it."""

import numpy as np
import pytest

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.deploy.session import follow
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.policy.file import SHIPPED, SHIPPED_TWIN, load_policy
from mjx_softarm.sensing.pose import seen_error

view = pytest.importorskip("mjx_softarm.view.__main__", reason="needs viser", exc_type=ImportError)


def test_the_twin_goes_round_the_circle_and_tells_its_payload():
    pytest.importorskip("mujoco")
    arm, controller = open_arm(view.Steered().arm), Controller.of(load_policy(view.Steered().file))
    goals = circle_poses(controller.policy.spec)[:4]
    run = follow(arm, controller, goals, arrived=lambda goal: arm.attach(0.5 * (goal == 1)))
    errors, told_kg = [], []
    for arrival in run.arrivals:
        rows = slice(arrival.row - controller.window, arrival.row + 1)
        errors.append(seen_error(run.log.tip_m[rows], run.log.tip_quaternion[rows], arrival.goal)[:3])
        told_kg.append(run.log.load_kg[arrival.row])
    assert np.linalg.norm(errors[:2], axis=1).max() < 2.0
    assert told_kg[2] - told_kg[1] == pytest.approx(0.5, abs=0.2)  # hung at the second arrival
    assert len(errors) == 4


def test_other_arms_and_a_switch_get_the_policy_of_the_paper_s_arm():
    assert view.Steered("my_arm:Arm").file == SHIPPED
    assert view.Steered("twin:1").file == view.Steered("twin:0@sopra").file == SHIPPED
    assert view.Steered("twin:0:500g").file == view.Steered().file == SHIPPED_TWIN
    assert view.Steered(policy=SHIPPED).file == SHIPPED
