"""Accuracy on the linear arm, whose motion capture is off by what the test plants."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.deploy.ending import DONE, MISSED
from mjx_softarm.deploy.link import first_frame
from mjx_softarm.deploy.measure import (
    along,
    figures,
    grid_poses,
    measure,
    read_goals,
    ways_of,
    write_accuracy,
)
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.sensing.estimator import estimate
from mjx_softarm.sensing.pose import quaternion_from_pose
from tests.linear_arm import CONTROLLER, FAR, GOALS, POLICY, LinearArm, N, go

OFF_MM = np.array([1.0, -2.0, 2.0])


class Seen(LinearArm):
    """Motion capture that is off by OFF_MM, with noise, and misses frames."""

    def __init__(self, off_mm=OFF_MM):
        super().__init__()
        self.off_mm = off_mm

    def motion_capture(self):
        if self.tick % 5 == 0:
            raise OSError("frame dropped")
        pose = estimate(POLICY.estimator, self.spring_m[None], 0.0)[0].astype(float)
        tip_m = 1e-3 * (pose[:3] + self.off_mm + 0.2 * self._rng.standard_normal(3))
        return Capture(tip_m, quaternion_from_pose(pose), tip_m[None])


def test_error_is_that_by_motion_capture(tmp_path):
    lines = []
    run = go(Seen(), tell=lines.append)
    found = measure(run, CONTROLLER, GOALS)
    unseen = found.error[:, :3] - found.believed[:, :3]
    np.testing.assert_allclose(unseen.mean(axis=0), OFF_MM, atol=0.2)
    assert np.abs(found.error[:, 3:]).max() < 0.5 and np.abs(found.believed[:, :3]).max() < 0.5
    assert not found.saturated.any()
    assert len(lines) == 3 and all("mm off by motion capture" in line for line in lines[1:])
    numbers = figures(found, run.counts())
    assert numbers["measured"] == numbers["points"] == 2
    assert numbers["translation_mm"] == pytest.approx(3.0, abs=0.4) and run.status == DONE
    pytest.importorskip("matplotlib")
    assert write_accuracy(tmp_path, found, numbers) == "" and (tmp_path / "accuracy.png").stat().st_size > 0
    assert json.loads((tmp_path / "accuracy.json").read_text())["at"][1]["goal"] == GOALS[1].tolist()


def test_goal_that_comes_again_is_a_goal_of_its_own():
    goals = GOALS[[0, 1, 0]]
    found = measure(go(Seen(), goals=[FAR, *goals]), CONTROLLER, np.array([FAR, *goals]))
    assert np.isnan(found.error[0]).all() and np.isfinite(found.error[1:]).all()


class Dark(Seen):
    """Motion capture that misses its first frames."""

    def __init__(self, n_missed):
        super().__init__()
        self.n_missed = n_missed
        self.write_pressures(np.zeros(N))  # past a frame that is dropped

    def motion_capture(self):
        self.n_missed -= 1
        if self.n_missed >= 0:
            raise OSError("no camera")
        return super().motion_capture()


def test_motion_capture_is_looked_at_before_the_arm_moves(monkeypatch):
    monkeypatch.setattr("mjx_softarm.deploy.link.LOOK_S", 0.0)
    first_frame(Dark(3), "--arm")
    unseen = Dark(0)
    unseen.off_mm = np.nan * OFF_MM
    for arm, message in (
        (LinearArm(), "--arm: got an arm without the method motion_capture, expected a frame"),
        (Dark(10**6), "--arm: got no frame of motion capture: no camera, expected a frame"),
        (unseen, "--arm: got motion capture that does not see the tip, expected a frame"),
    ):
        with pytest.raises(InputError, match=message):
            first_frame(arm, "--arm")
    run = go(Dark(10**6), goals=GOALS[:1])
    assert run.arrivals
    with pytest.raises(InputError, match=r"motion capture: got no frame in [0-9]+ ticks"):
        measure(run, CONTROLLER, GOALS[:1])


def test_quantiles_and_rotation_by_hand():
    found = measure(go(Seen(), goals=GOALS[:1]), CONTROLLER, np.tile(GOALS[0], (21, 1)))
    found.error[:] = np.nan
    found.error[:20, :3] = np.arange(1.0, 21.0)[:, None] * [0.6, 0.0, 0.8]
    found.error[:20, 3:] = [2.0, -1.0, 2.0]
    numbers = figures(found, {Fault.SATURATED: 2})
    assert (numbers["points"], numbers["measured"], numbers["saturation_events"]) == (21, 20, 2)
    assert (numbers["translation_mm"], numbers["max_mm"]) == pytest.approx((10.5, 20.0))
    assert numbers["translation_95_mm"] == pytest.approx(19.05)
    assert (numbers["rotation_deg"], numbers["rotation_max_deg"]) == pytest.approx((3.0, 3.0))
    # Axes that goals do not ask for are in neither
    numbers = figures(found, {}, asked=(True, True, False, True, False, False))
    assert (numbers["max_mm"], numbers["rotation_deg"]) == pytest.approx((12.0, 2.0))
    assert np.isnan(figures(found, {}, asked=(True,) * 3 + (False,) * 3)["rotation_deg"])


@pytest.mark.parametrize(
    ("off_mm", "goals", "status"),
    [(0 * OFF_MM, GOALS[:1], DONE), (4 * OFF_MM, GOALS[:1], MISSED), (0 * OFF_MM, [FAR, GOALS[0]], MISSED)],
)
def test_goal_that_is_not_reached_has_an_exit_status(off_mm, goals, status):
    run = go(Seen(off_mm), goals=goals)
    assert run.status == status and [arrival.reached for arrival in run.arrivals] == [not off_mm.any()]
    assert go(Seen(off_mm), goals=goals, duration_s=0.5).status == MISSED


def test_stay_holds_the_last_goal_until_the_end():
    arm = LinearArm()
    run = go(arm, goals=GOALS[:1], stay=True, duration_s=30.0)
    assert run.status == DONE and run.log.time_s[-1] == pytest.approx(30.0, abs=0.1)
    held_kpa = np.asarray(run.log.pressure_kpa)[run.arrivals[0].row :]
    assert np.ptp(held_kpa, axis=0).max() < 1.0 and np.abs(held_kpa).max() > 5.0
    assert not arm.command_kpa.any()
    refused = go(LinearArm(), goals=[FAR], stay=True)
    assert len(refused.log) == 0 and refused.status == MISSED


def test_goals_by_name(tmp_path):
    np.testing.assert_allclose(read_goals("circle", POLICY, 8), circle_poses(POLICY.spec, 8), atol=1e-4)
    np.testing.assert_array_equal(read_goals("grid", POLICY, 30), grid_poses(POLICY.workspace, 30))
    file = tmp_path / "goals.csv"
    file.write_text("x [mm],y [mm],z [mm],yaw [deg],pitch [deg],roll [deg]\n80,0,-575,0,0,0\n1,2,3,4,5,6\n")
    np.testing.assert_array_equal(read_goals(str(file), POLICY, 1)[1], range(1, 7))
    file.write_text("x,y,z\n1,2,3\n")
    with pytest.raises(InputError, match=r"goals.csv: got x,y,z, expected the columns x \[mm\]"):
        read_goals(str(file), POLICY, 1)
    file.write_text("x [mm],y [mm],z [mm]\n80,0,-575\n1,,3\n")
    with pytest.raises(InputError, match=r"goals.csv: row 3: y \[mm\]: got nan, expected a finite number"):
        read_goals(str(file), POLICY, 1)


def test_a_policy_of_positions_takes_positions_for_goals(tmp_path):
    file = tmp_path / "goals.csv"
    file.write_text("x [mm],y [mm],z [mm]\n80,0,-575\n")
    with pytest.raises(InputError, match="got a position alone, expected X,Y,Z,YAW,PITCH,ROLL"):
        read_goals(str(file), POLICY, 1)
    positions = RewardConfig(axes=(1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
    [goal] = read_goals(str(file), dataclasses.replace(POLICY, reward=positions), 1)
    np.testing.assert_array_equal(goal, [80, 0, -575, 0, 0, 0])


def test_around_the_circle_the_plate_hangs_straight_not_the_frame_on_it():
    """An arm cannot twist itself by the turn of motion capture's frame."""
    turned = POLICY.spec.replace(mounting={"tip_turn_deg": (0.0, 0.0, 5.0)})
    goals = read_goals("circle", dataclasses.replace(POLICY, spec=turned), 8)
    turn = goals - circle_poses(POLICY.spec, 8)
    np.testing.assert_allclose(turn, [[0.0, 0.0, 0.0, 5.0, 0.0, 0.0]] * 8, atol=1e-4)


def test_grid_is_spread_over_the_workspace():
    cloud = np.random.default_rng(0).uniform(-100.0, 100.0, (5000, 6))
    chosen = grid_poses(cloud, 64)
    assert len(chosen) == 64 and all((cloud == pose).all(axis=1).any() for pose in chosen)
    away = np.linalg.norm(chosen[:, None, :3] - chosen[None, :, :3], axis=2) + 1e9 * np.eye(64)
    assert away.min() > 25.0  # cells are 50 mm wide
    assert len(grid_poses(cloud, 1)) == 1


def test_distance_and_lag_along_a_way(tmp_path):
    """A tip that does in each tick what the goal did 0.4 s before, 3 mm beside it; one frame is lost."""
    n, lag = 500, 20
    goal = np.tile([0.0, 0.0, -600.0, 0.0, 0.0, 0.0], (n + lag, 1))
    goal[:, 0] = np.arange(n + lag)
    tip_mm = goal[:n, :3] + [0.0, 3.0, 0.0]
    tip_mm[7] = np.nan
    run = SimpleNamespace(log=SimpleNamespace(goal=goal[lag:], tip_m=1e-3 * tip_mm), ways=(slice(0, n),))
    numbers = along(ways_of(run), 0.02)
    assert numbers["lag_s"] == pytest.approx(0.4) and numbers["way_without_lag_mm"] == pytest.approx(3.0)
    assert numbers["way_mm"] == pytest.approx(np.hypot(lag, 3.0)) and numbers["way_s"] == pytest.approx(10.0)
    pytest.importorskip("matplotlib")
    measured = measure(go(Seen(), goals=GOALS[:1]), CONTROLLER, GOALS[:1])
    assert write_accuracy(tmp_path, measured, numbers, ways_of(run)) == ""
    assert (tmp_path / "accuracy.png").stat().st_size > 0
